"""An evaluation of many plots: side by side in processes of their own, and kept in a file from which it goes on.

    Task -> score_plots: one plot after the other, or several at a time        -> PlotScore of each
         -> conditions, write_evaluation: the file, written after each plot     <- read_scores

A score is rounded when it is made, so that what the file keeps is what was scored. Which process scores a plot does not matter.
"""

import contextlib
import dataclasses
import hashlib
import json
import math
import multiprocessing
import os
import tempfile
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np

import jaxrl_vis
import jaxrl_vis_envs.plants
from jaxrl_vis.devices import list_devices
from jaxrl_vis.errors import RequestError
from jaxrl_vis.files import write_atomically
from jaxrl_vis.phenotyping.evaluate import PlotScore, ThesisScore, score_plot, summary
from jaxrl_vis.phenotyping.measure import Method
from jaxrl_vis_envs.plants import Family

SCHEMA = 1
KEPT_SCORE = 0.05
"""Finds of lower scores are not kept: they matter for nothing but the far end of the precision curve."""


@dataclasses.dataclass(frozen=True)
class Task:
    """What is scored, and how; the same for all plots of an evaluation.

    Attributes:
        family: What plots are drawn from.
        weights: File of the networks' weights; None for true boxes and masks.
        method: How widths are taken.
        least_score: What counts as a find.
        thesis: Score the thesis's ways on the same finds, too.
    """

    family: Family
    weights: Path | None
    method: Method = "strip"
    least_score: float = 0.5
    thesis: bool = False


class Scorers:
    """Scores plots: in this process, or in several that share the devices. A context manager; processes end with it."""

    def __init__(self, workers: int = 1) -> None:
        """Starts no process yet.

        Args:
            workers: How many processes; with 1, all is done in this one.
        """
        self._workers = workers
        self._pool: ProcessPoolExecutor | None = None
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> "Scorers":
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def scores(self, task: Task, seeds: Iterable[int]) -> Iterator[PlotScore]:
        """Scores of plots with these seeds, in the order in which they are ready."""
        if self._workers == 1:
            yield from (_score(task, seed) for seed in seeds)
            return
        seeds = list(seeds)
        if self._pool is None:
            self._pool = self._start()
            if seeds:
                # One process compiles; the others read what it compiled, so that all run the same programs, and sooner.
                self._pool.submit(_score, _short(task), seeds[0]).result()
        waiting = [self._pool.submit(_score, task, seed) for seed in seeds]
        try:
            for done in as_completed(waiting):
                yield done.result()
        finally:
            for each in waiting:
                each.cancel()

    def _start(self) -> ProcessPoolExecutor:
        import jax

        devices = [dict(each.environment) for each in list_devices()]
        spawning = multiprocessing.get_context("spawn")
        number = spawning.Value("i", 0)
        pins = jax.default_backend() == "cpu"
        compiled = jax.config.jax_compilation_cache_dir or self._stack.enter_context(tempfile.TemporaryDirectory())
        about = (number, self._workers, devices, pins, compiled)
        pool = ProcessPoolExecutor(self._workers, spawning, _prepare, about)
        self._stack.callback(pool.shutdown, wait=True, cancel_futures=True)
        return pool


def share_devices() -> None:
    """Makes this process leave the memory of its devices to others; to be called before JAX starts."""
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"


def _short(task: Task) -> Task:
    """The same with two pairs a plot: it needs all programs, and takes little more than their compilation."""
    rig = dataclasses.replace(task.family.rig, frames=min(task.family.rig.frames, 2))
    return dataclasses.replace(task, family=dataclasses.replace(task.family, rig=rig))


def _prepare(number: Any, workers: int, devices: list[dict[str, str]], pins: bool, compiled: str) -> None:
    """In a new process: a device of its own where there are several, and no more threads than its share of the cores.

    Args:
        number: Counts the processes.
        workers: How many there will be.
        devices: Environment variables that name each device.
        pins: Whether the cores are divided among the processes.
        compiled: Folder in which they share compiled programs.
    """
    with number.get_lock():
        own, number.value = number.value, number.value + 1
    share_devices()
    os.environ.update(devices[own % len(devices)])
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    if pins and hasattr(os, "sched_setaffinity"):
        # What computes on a CPU takes as many threads as it may use cores.
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, cores[own % len(cores) :: workers])
    import cv2
    import jax

    cv2.setNumThreads(1)
    jax.config.update("jax_compilation_cache_dir", compiled)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


_FINDERS: dict[tuple[Path, str], Any] = {}


def _score(task: Task, seed: int) -> PlotScore:
    """One plot; networks are read once in each process."""
    find = None
    if task.weights is not None:
        from jaxrl_vis.phenotyping.detector.finder import Finder
        from jaxrl_vis.phenotyping.detector.weights import read_weights

        key = task.weights, fingerprint(task.weights)
        if key not in _FINDERS:
            params, settings, _ = read_weights(task.weights)
            _FINDERS[key] = Finder(params, settings, KEPT_SCORE)
        find = _FINDERS[key]
    score = score_plot(task.family, seed, find, task.method, task.least_score, task.thesis)
    return _read(_record(score, task.family.rig.frames))


def fingerprint(weights: Path) -> str:
    """What tells weights apart: 12 hexadecimal digits."""
    return hashlib.sha256(weights.read_bytes()).hexdigest()[:12]


def conditions(task: Task) -> dict[str, Any]:
    """All that the scores of a plot depend on beside its seed: those of equal conditions belong together."""
    import jax

    return {
        "schema": SCHEMA,
        "version": jaxrl_vis.__version__,
        "code": _code(),
        "platform": jax.default_backend(),
        "family": hashlib.sha256(json.dumps(dataclasses.asdict(task.family), sort_keys=True).encode()).hexdigest()[:12],
        "weights": None if task.weights is None else fingerprint(task.weights),
        "method": task.method,
        "least_score": task.least_score,
        "thesis": task.thesis,
    }


def _code() -> str:
    """What tells apart versions of the code that draws, finds and measures: 12 hexadecimal digits."""
    digest = hashlib.sha256()
    for module in (jaxrl_vis_envs.plants, jaxrl_vis.phenotyping):
        folder = Path(str(module.__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            # What trains networks and draws figures changes no score.
            if "training" not in path.parts and path.name != "figures.py":
                digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def read_scores(path: Path, same: dict[str, Any]) -> list[PlotScore]:
    """Scores that a file holds; none if there is no such file.

    Args:
        path: Of `write_evaluation`.
        same: Of `conditions`.

    Raises:
        RequestError: The file holds something else, or an evaluation under other conditions.
    """
    if not path.exists():
        return []
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        there = data["conditions"]
        differ = sorted(name for name in {*same, *there} if same.get(name) != there.get(name))
        scores = [] if differ else [_read(each) for each in data["each"]]
    except OSError as error:
        raise RequestError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RequestError(f"{path} is there and holds no evaluation to go on with: name another file with --json") from error
    if differ:
        raise RequestError(
            f"{path} holds an evaluation with another {', '.join(differ)}: name another file with --json, or remove that one"
        )
    return scores


def write_evaluation(path: Path, about: dict[str, Any], same: dict[str, Any], scores: list[PlotScore], task: Task) -> None:
    """Writes the figures of all plots together and what is known of each; a line for each plot.

    Args:
        path: The file, .json.
        about: What else it says.
        same: Of `conditions`.
        scores: Of the plots.
        task: What was scored.
    """
    figures = {name: value if math.isfinite(value) else None for name, value in summary(scores, task.least_score).items()}
    head = json.dumps({"synthetic": True, **about, "family": task.family.name, **figures, "conditions": same}, indent=2)
    rows = ",\n".join("    " + json.dumps(_record(each, task.family.rig.frames)) for each in scores)
    write_atomically(path, head[: head.rindex("\n")] + f',\n  "each": [\n{rows}\n  ]\n}}\n')


def _record(score: PlotScore, pairs: int) -> dict[str, Any]:
    """What JSON keeps of a plot."""
    thesis = score.thesis
    return {
        "seed": score.seed,
        "true": score.true,
        "counted": score.counted,
        "widths_mm": score.widths.round(4).tolist(),
        "widths_24in_mm": score.upper.round(4).tolist(),
        "seconds_per_pair": None if math.isnan(score.seconds) else round(score.seconds, 4),
        "pairs": pairs,
        "stalks_in_view": score.stalks,
        "scores": score.finds[:, 0].round(4).tolist(),
        "right": "".join("1" if each else "0" for each in score.finds[:, 1]),
        "thesis": thesis and {"counted": round(thesis.counted, 4), "widths_mm": thesis.widths.round(4).tolist()},
    }


def _read(record: dict[str, Any]) -> PlotScore:
    """The inverse of `_record`."""

    def pairs(values: list[list[float]]) -> np.ndarray:
        return np.array(values, float).reshape(-1, 2)

    thesis = record["thesis"]
    return PlotScore(
        seed=record["seed"],
        true=record["true"],
        counted=record["counted"],
        widths=pairs(record["widths_mm"]),
        finds=np.stack([np.array(record["scores"], float), np.array([each == "1" for each in record["right"]], float)], axis=1),
        stalks=record["stalks_in_view"],
        upper=pairs(record["widths_24in_mm"]),
        seconds=math.nan if record["seconds_per_pair"] is None else record["seconds_per_pair"],
        thesis=thesis and ThesisScore(thesis["counted"], pairs(thesis["widths_mm"])),
    )
