"""An evaluation of many plots, as `evaluation_pool` goes through them: what is done with one, and what is kept of it.

    Task, seed -> evaluate_plot -> record -> `RecordFile`: the file, written after each plot -> scores_of -> summary

A score is rounded when it is made, so that what the file keeps is what was scored. Which process scores a plot does not matter.
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import jaxrl_vis
import jaxrl_vis.phenotyping
import jaxrl_vis_envs.plants
from jaxrl_vis.evaluation_pool import Record, code_digest
from jaxrl_vis.phenotyping.evaluate import PlotScore, ThesisScore, score_plot, summary
from jaxrl_vis.phenotyping.measure import Method
from jaxrl_vis.provenance import device_name, revision
from jaxrl_vis_envs.plants import Family

SCHEMA = 2
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
        workers: How many processes share the machine; what is kept says so, as it bears on the time that a pair takes.
    """

    family: Family
    weights: Path | None
    method: Method = "strip"
    least_score: float = 0.5
    thesis: bool = False
    workers: int = 1


_FINDERS: dict[tuple[Path, str], Any] = {}


def evaluate_plot(task: Task, seed: int) -> Record:
    """What is kept of one plot; networks are read once in each process.

    Args:
        task: For all plots.
        seed: Of the plot.
    """
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
    where = {"device": device_name(), "workers": task.workers, "revision": revision()}
    return {**where, **_record(score, task.family.rig.frames)}


def evaluate_job(tasks: Sequence[Task], jobs: Sequence[tuple[int, int]], number: int) -> Record:
    """The same for one of several evaluations: job ``number`` is a task and a seed."""
    task, seed = jobs[number]
    return evaluate_plot(tasks[task], seed)


def fingerprint(weights: Path) -> str:
    """What tells weights apart: 12 hexadecimal digits."""
    return hashlib.sha256(weights.read_bytes()).hexdigest()[:12]


def conditions(task: Task) -> dict[str, Any]:
    """All that the scores of a plot depend on beside its seed: those of equal conditions belong together."""
    import jax

    return {
        "synthetic": True,
        "family": task.family.name,
        "schema": SCHEMA,
        "version": jaxrl_vis.__version__,
        # What trains networks and draws figures changes no score.
        "code": code_digest(jaxrl_vis_envs.plants, jaxrl_vis.phenotyping, leave_out=("training", "figures.py")),
        "platform": jax.default_backend(),
        "family_digest": hashlib.sha256(json.dumps(dataclasses.asdict(task.family), sort_keys=True).encode()).hexdigest()[:12],
        "weights": None if task.weights is None else fingerprint(task.weights),
        "method": task.method,
        "least_score": task.least_score,
        "thesis": task.thesis,
    }


def scores_of(records: Iterable[Record]) -> list[PlotScore]:
    """The scores that records hold."""
    return [_read(each) for each in records]


def summary_of(least_score: float, records: Iterable[Record]) -> dict[str, Any]:
    """What the records of plots say together, see `summary`."""
    return summary(scores_of(records), least_score)


def _record(score: PlotScore, pairs: int) -> Record:
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


def _read(record: Record) -> PlotScore:
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
