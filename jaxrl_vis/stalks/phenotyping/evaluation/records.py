"""Evaluation of many plots in parallel processes, with a record per plot that lets an interrupted evaluation continue.

    Task, seed -> evaluate_plot -> record -> `RecordFile`: the file, written after each plot -> read_scores -> summary

Records are rounded when they are made, so results computed from the file and in memory are the same. They do not depend on
which process evaluates a plot.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import jaxrl_vis
import jaxrl_vis.stalks.phenotyping
import jaxrl_vis_envs.plants
from jaxrl_vis.host.provenance import device_name, revision
from jaxrl_vis.host.worker_pool import Record, RecordFile, code_digest, evaluate_all
from jaxrl_vis.stalks.digests import file_digest, value_digest
from jaxrl_vis.stalks.phenotyping.evaluation.scoring import PlotScore, ThesisScore, score_plot, summarize_scores
from jaxrl_vis.stalks.phenotyping.measure.stalk import Method
from jaxrl_vis_envs.plants import Family

SCHEMA = 3
MIN_RECORDED_SCORE = 0.05
"""Minimum score of recorded detections: lower ones affect only the far end of the precision-recall curve."""


@dataclasses.dataclass(frozen=True)
class Task:
    """Settings common to all plots of an evaluation.

    Attributes:
        family: Family that plots are sampled from.
        weights: File of the networks' weights; None for ground-truth boxes and masks.
        finder: Name of the networks, or ``truth``.
        method: Method of measuring widths.
        min_score: Minimum score of a detection that counts.
        thesis: If true, also score the thesis's methods on the same detections.
        workers: Number of processes on the machine; stored in the records, as it affects the time per pair.
    """

    family: Family
    weights: Path | None
    finder: str = "truth"
    method: Method = "strip"
    min_score: float = 0.4
    thesis: bool = False
    workers: int = 1


def evaluate_plot(task: Task, seed: int) -> Record:
    """Evaluate one plot and return its record. The networks are loaded once per process.

    Args:
        task: Settings of the evaluation.
        seed: Seed of the plot.

    Raises:
        RequestError: The weights cannot be read.
    """
    find = None
    if task.weights is not None:
        from jaxrl_vis.stalks.phenotyping.detector.loading import load_finder

        find = load_finder(task.weights, MIN_RECORDED_SCORE)
    score = score_plot(task.family, seed, find, task.method, task.min_score, task.thesis)
    where = {"device": device_name(), "workers": task.workers, "revision": revision()}
    return {**where, **_make_record(score, task.family.rig.frames)}


def conditions(task: Task) -> dict[str, Any]:
    """Return all conditions that the scores of a plot depend on besides its seed; only records with equal ones are combined."""
    import jax

    return {
        "synthetic": True,
        "family": task.family.name,
        "schema": SCHEMA,
        "version": jaxrl_vis.__version__,
        # Code of training and figures does not affect scores.
        "code": code_digest(jaxrl_vis_envs.plants, jaxrl_vis.stalks.phenotyping, leave_out=("training", "figures.py")),
        "platform": jax.default_backend(),
        "family_digest": value_digest(dataclasses.asdict(task.family)),
        "finder": task.finder,
        "weights": None if task.weights is None else file_digest(task.weights),
        "method": task.method,
        "least_score": task.min_score,
        "thesis": task.thesis,
    }


def evaluate_plots(
    task: Task, seeds: Sequence[int], path: Path | None, started: Callable[[int], None], done: Callable[[Record], None]
) -> dict[str, Any]:
    """Evaluate plots in parallel processes, and return the summary of all, see `scoring.summarize_scores`.

    Args:
        task: Settings of the evaluation.
        seeds: Seeds of the plots.
        path: JSON file, written after each plot; None for no file. Plots that it already holds are not evaluated again.
        started: Called once with the number of plots that the file already holds.
        done: Called with the record of each plot.

    Raises:
        RequestError: The file holds records of another evaluation, or cannot be read.
        WorkerError: A process was killed from outside.
    """
    summarize_plots = functools.partial(summarize, task.min_score)
    table = RecordFile(path, conditions(task), summarize_plots)
    missing = [seed for seed in seeds if seed not in table]
    started(len(seeds) - len(missing))

    def keep(seed: int, record: Record) -> None:
        table.add(seed, record)
        done(table.records[seed])

    evaluate_all(functools.partial(evaluate_plot, task), missing, task.workers, keep)
    return summarize_plots([table.records[seed] for seed in seeds])


def read_scores(records: Iterable[Record]) -> list[PlotScore]:
    """Convert records to scores, in the same order."""
    return [_read_score(record) for record in records]


def summarize(min_score: float, records: Iterable[Record]) -> dict[str, Any]:
    """Summarize the records of plots, see `summarize_scores`."""
    return summarize_scores(read_scores(records), min_score)


def _make_record(score: PlotScore, pairs: int) -> Record:
    """Convert a plot's score to a record of JSON types."""
    thesis = score.thesis
    return {
        "seed": score.seed,
        "true": score.true,
        "counted": score.counted,
        "widths_mm": score.widths.round(4).tolist(),
        "width_errors_mm": score.errors.round(4).tolist(),
        "widths_24in_mm": score.upper.round(4).tolist(),
        "seconds_per_pair": None if math.isnan(score.seconds) else round(score.seconds, 4),
        "pairs": pairs,
        "stalks_in_view": score.stalks,
        "scores": score.detections[:, 0].round(4).tolist(),
        "right": "".join("1" if right else "0" for right in score.detections[:, 1]),
        "thesis": thesis and {"counted": round(thesis.counted, 4), "widths_mm": thesis.widths.round(4).tolist()},
    }


def _read_score(record: Record) -> PlotScore:
    """Convert a record to a score, the inverse of `_make_record`."""

    def pairs(values: list[list[float]]) -> np.ndarray:
        return np.array(values, float).reshape(-1, 2)

    thesis = record["thesis"]
    right = np.array([digit == "1" for digit in record["right"]], float)
    return PlotScore(
        seed=record["seed"],
        true=record["true"],
        counted=record["counted"],
        widths=pairs(record["widths_mm"]),
        detections=np.stack([np.array(record["scores"], float), right], axis=1),
        stalks=record["stalks_in_view"],
        upper=pairs(record["widths_24in_mm"]),
        errors=np.array(record["width_errors_mm"], float),
        seconds=math.nan if record["seconds_per_pair"] is None else record["seconds_per_pair"],
        thesis=thesis and ThesisScore(thesis["counted"], pairs(thesis["widths_mm"])),
    )
