"""Scores of detections, counts and widths against the exact ground truth of synthetic plots, rendered on the fly.

plot -> pairs -> detections -> sightings -> stalks       as in `pipeline.run`, without files
     -> true boxes, count and diameters             from the plot itself
"""

import dataclasses
import functools
import math
import time
from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.band import Band
from jaxrl_vis.stalks.phenotyping.detector.finder import Detection
from jaxrl_vis.stalks.phenotyping.evaluation.perfect import perfect_detections
from jaxrl_vis.stalks.phenotyping.evaluation.thesis import count_by_length, mean_widths, measure_pair_as_thesis
from jaxrl_vis.stalks.phenotyping.measure.stalk import Method
from jaxrl_vis.stalks.phenotyping.track.follow import track_stalks
from jaxrl_vis.stalks.phenotyping.track.heights import stalk_widths
from jaxrl_vis.stalks.phenotyping.track.pairing import view_pair
from jaxrl_vis.stalks.phenotyping.track.sightings import Find, Sighting
from jaxrl_vis_envs.plants import Family, Stalk, draw
from jaxrl_vis_envs.plants.pairs import Sequence
from jaxrl_vis_envs.plants.truth import HEIGHTS, StalkInView, stalks_in_view

MIN_VISIBLE = 0.3
IOU = 0.5
_DEVIATIONS_95 = 1.96  # half-width of a 95 % interval in standard errors
PERSON_SD = 1.45  # mm, of one person with calipers: from the mean absolute difference of 1.639 mm between two, in the thesis


@dataclasses.dataclass(frozen=True)
class PlotScore:
    """Score of one plot.

    Attributes:
        seed: Seed of the plot.
        true, counted: True and counted number of stalks.
        widths: Measured and true diameter at 12 inches of each stalk that was counted and identified, [N, 2] float64, mm.
        errors: Standard error of each measured diameter at 12 inches, [N] float64, mm.
        upper: Measured and true diameter at 24 inches, [M, 2] float64, mm.
        seconds: Median time of detection and measurement per pair, images in memory, without the first pair, which includes
            compilation; NaN for a single pair.
        thesis: Score of the thesis's methods on the same detections; None if they were not evaluated.
        detections: Score of each detection, and 1 for a true or 0 for a false positive, [K, 2] float64; matches of mostly
            occluded stalks are left out, and so are those of stalks that stereo places behind the row.
        stalks: Number of detectable stalks (ground-truth positives), summed over all pairs.
    """

    seed: int
    true: int
    counted: int
    widths: np.ndarray
    detections: np.ndarray
    stalks: int
    upper: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 2)))
    seconds: float = math.nan
    thesis: "ThesisScore | None" = None
    errors: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))


@dataclasses.dataclass(frozen=True)
class ThesisScore:
    """Count and widths from the same detections by the thesis's methods.

    Attributes:
        counted: Estimated number of stalks, from the mean number per metre of image.
        widths: Measured diameter, and true one at 12 inches, of each identified stalk, [N, 2] float64, mm.
    """

    counted: float
    widths: np.ndarray


def score_plot(
    family: Family,
    seed: int,
    find: Find | None,
    method: Method = "strip",
    min_score: float = 0.4,
    with_thesis: bool = False,
) -> PlotScore:
    """Render a plot, run the whole pipeline on it, and score the results.

    Args:
        family: Family that the plot is sampled from.
        seed: Seed of the plot.
        find: Stalk detector, which should also return detections with low scores; None for ground-truth boxes and masks.
        method: Method of measuring widths.
        min_score: Minimum score of a detection that counts.
        with_thesis: If true, also score the thesis's methods on the same detections.
    """
    sequence = Sequence.of(draw(family, seed))
    drive, plot = sequence.drive, sequence.plot
    frames: list[list[Sighting]] = []
    outcomes: list[tuple[list[Detection], list[int], list[StalkInView]]] = []
    as_thesis: list[list[Sighting]] = []
    total, seconds = 0, []
    for pair in sequence:
        left, right, instance = np.asarray(pair.left), np.asarray(pair.right), np.asarray(pair.instance)
        stalks = stalks_in_view(plot, pair.pose, drive.true, instance, np.asarray(pair.depth))
        started = time.monotonic()
        finder = find or functools.partial(_true_detections, stalks, instance)
        view = view_pair(finder, left, right, drive.stated, method, min_score=min_score)
        selected = [place for place, detection in enumerate(view.detections) if detection.score >= min_score]
        frames.append(view.sightings)
        seconds.append(time.monotonic() - started)
        if with_thesis:
            likely = [view.detections[place] for place in selected]
            as_thesis.append(measure_pair_as_thesis(likely, left, right, drive.stated))
        total += sum(stalk.band_box is not None and stalk.band_visible >= MIN_VISIBLE for stalk in stalks)
        outcomes.append((view.detections, selected, stalks))
    tracks, path = track_stalks(frames, drive.odometry, drive.stated)
    owners: list[list[int | None]] = []
    scored_detections: list[tuple[float, float]] = []
    all_behind = {sighting for track in tracks if path.is_behind_row(track) for sighting in track.sightings}
    for frame, (detections, selected, stalks) in enumerate(outcomes):
        behind = {place for number, place in enumerate(selected) if (frame, number) in all_behind}
        others = [place for place in range(len(detections)) if place not in behind]
        matched, scored = match_detections([detections[place] for place in others], stalks)
        owner = dict(zip(others, matched))
        owners.append([owner.get(place) for place in selected])
        scored_detections += scored
    widths, upper, errors = [], [], []
    counted = [track for track in tracks if track.counted]
    for track, measured in zip(counted, stalk_widths(frames, counted)):
        names = [owners[frame][place] for frame, place in track.sightings]
        known = [name for name in names if name is not None]
        if not known:
            continue
        stalk = plot.stalks[max(sorted(set(known)), key=known.count)]
        if measured.lower is not None:
            widths.append((measured.lower.mm, true_diameter(stalk)))
            errors.append(measured.lower.error)
        if measured.upper is not None:
            upper.append((measured.upper.mm, true_diameter(stalk, HEIGHTS[1])))
    return PlotScore(
        seed,
        len(plot.measured),
        len(counted),
        np.array(widths).reshape(-1, 2),
        np.array(scored_detections).reshape(-1, 2),
        total,
        np.array(upper).reshape(-1, 2),
        float(np.median(seconds[1:])) if len(seconds) > 1 else math.nan,
        _thesis_score(as_thesis, owners, sequence) if with_thesis else None,
        np.array(errors, float),
    )


def _true_detections(
    stalks: list[StalkInView], instance: np.ndarray, image: np.ndarray, pixels_per_metre: float | None, band: Band | None
) -> list[Detection]:
    """Return ground-truth detections, with the signature of a detector; the image and its resolution are ignored."""
    return perfect_detections(map(dataclasses.asdict, stalks), instance, MIN_VISIBLE)


def _thesis_score(frames: list[list[Sighting]], owners: list[list[int | None]], sequence: Sequence) -> ThesisScore:
    plot, stated = sequence.plot, sequence.drive.stated
    widths = [(width, true_diameter(plot.stalks[name])) for name, width in mean_widths(frames, owners).items()]
    counted = count_by_length(frames, stated, plot.family.layout.plot_length)
    return ThesisScore(counted, np.array(widths).reshape(-1, 2))


def true_diameter(stalk: Stalk, height: float = HEIGHTS[0]) -> float:
    """Return the true diameter in mm, as the cameras face it, at a height in m.

    Less than 1 cm from a node, return the mean 2 cm above and below.
    """
    offsets = (0.02, -0.02) if stalk.node_distance(height) < 0.01 else (0.0,)
    return 1e3 * float(np.mean([stalk.diameter(height + offset) for offset in offsets]))


def match_detections(
    detections: list[Detection], stalks: list[StalkInView]
) -> tuple[list[int | None], list[tuple[float, float]]]:
    """Match detections with stalks as COCO does: greedily by descending score, each stalk once, at an IoU of at least 0.5.

    Args:
        detections: Detections in an image.
        stalks: Stalks in view of it.

    Returns:
        Index of each detection's stalk, None if unmatched; and the score of each detection with 1.0 if it is matched, else 0.0,
        by descending score and without matches of stalks that are occluded too much to count.
    """
    there = [stalk for stalk in stalks if stalk.band_box is not None]
    clear = np.array([stalk.band_visible >= MIN_VISIBLE for stalk in there], bool)
    boxes = np.array([stalk.band_box for stalk in there], float).reshape(-1, 4)
    owners: list[int | None] = [None] * len(detections)
    scored: list[tuple[float, float]] = []
    free = np.ones(len(there), bool)
    for place in sorted(range(len(detections)), key=lambda number: -detections[number].score):
        overlaps = iou_with_boxes(np.array(detections[place].box), boxes)
        fitting = free & (overlaps >= IOU)
        of_clear = np.where(fitting & clear, overlaps, 0.0)
        best = int(np.argmax(of_clear)) if of_clear.any() else None
        if best is None and (fitting & ~clear).any():
            best = int(np.argmax(np.where(fitting & ~clear, overlaps, 0.0)))
        if best is not None:
            owners[place], free[best] = there[best].stalk, False
        if best is None or clear[best]:
            scored.append((detections[place].score, float(best is not None)))
    return owners, scored


def iou_with_boxes(box: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Compute the intersection over union [N] of a box [4] with boxes [N, 4] (left, top, right, bottom)."""
    low, high = np.maximum(box[:2], boxes[:, :2]), np.minimum(box[2:], boxes[:, 2:])
    common = np.prod(np.clip(high - low, 0.0, None), axis=1)
    areas = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)
    return common / np.maximum(np.prod(box[2:] - box[:2]) + areas - common, 1e-9)


def average_precision(detections: np.ndarray, stalks: int) -> float:
    """Compute COCO's average precision: the mean over 101 recall levels of the maximum precision at that recall or higher.

    It is 0 without detections or stalks.

    Args:
        detections: Score of each detection, and 1 if it is correct, else 0, [K, 2].
        stalks: Number of stalks to detect.
    """
    if not stalks or not len(detections):
        return 0.0
    success = detections[np.argsort(-detections[:, 0], kind="stable"), 1]
    hits = np.cumsum(success)
    precision = np.maximum.accumulate((hits / np.arange(1, len(hits) + 1))[::-1])[::-1]
    recall = hits / stalks
    place = np.searchsorted(recall, np.linspace(0.0, 1.0, 101))
    return float(np.where(place < len(precision), precision[np.minimum(place, len(precision) - 1)], 0.0).mean())


def summarize_scores(scores: Iterable[PlotScore], min_score: float = 0.4) -> dict[str, Any]:
    """Summarize the scores of plots.

    Args:
        scores: Scores of the plots.
        min_score: Minimum score of a detection for ``precision``, ``recall`` and ``f1``.

    Returns:
        ``count_r2`` (1 - SSE / SST against y = x), ``count_mae``, ``count_bias`` (relative to the true number),
        ``width_mae_mm``, ``width_bias_mm``, ``width_mae_two_people_mm`` (against the simulated mean of two people with
        calipers), ``width_coverage_95`` (fraction of true widths in the stated 95 % interval), errors of widths at 24 inches,
        ``ap50``, ``precision``, ``recall``, ``f1``, the best F1 and the minimum score that gives it, ``seconds_per_pair``, the
        numbers of samples, and, if evaluated, metrics of the thesis's methods. NaN if there are no samples.
    """
    scores = list(scores)
    true = np.array([score.true for score in scores], float)
    counted = np.array([score.counted for score in scores], float)
    widths = np.concatenate([score.widths for score in scores]) if scores else np.zeros((0, 2))
    detections = np.concatenate([score.detections for score in scores]) if scores else np.zeros((0, 2))
    stalks = sum(score.stalks for score in scores)
    error = widths[:, 0] - widths[:, 1]
    stated = np.concatenate([score.errors for score in scores]) if scores else np.zeros(0)
    upper = np.concatenate([score.upper for score in scores]) if scores else np.zeros((0, 2))
    upper_error = upper[:, 0] - upper[:, 1]
    people = np.random.default_rng(0).normal(0.0, PERSON_SD, (len(error), 2)).mean(axis=1)
    selected = detections[detections[:, 0] >= min_score]
    hits = float(selected[:, 1].sum())
    best, best_score = _best_f1(detections, stalks)
    return {
        "plots": len(scores),
        "count_true": int(true.sum()),
        "count_r2": _agreement(counted, true),
        "count_mae": _mean(np.abs(counted - true)),
        "count_bias": float(counted.sum() / true.sum() - 1.0) if true.sum() else float("nan"),
        "widths": len(error),
        "width_mae_mm": _mean(np.abs(error)),
        "width_bias_mm": _mean(error),
        "width_mae_two_people_mm": _mean(np.abs(error - people)),
        "width_coverage_95": _mean(np.abs(error) <= _DEVIATIONS_95 * stated) if len(stated) == len(error) else float("nan"),
        "widths_24in": len(upper),
        "width_24in_mae_mm": _mean(np.abs(upper_error)),
        "width_24in_bias_mm": _mean(upper_error),
        "finds": len(selected),
        "stalks_in_view": stalks,
        "ap50": average_precision(detections, stalks),
        "precision": hits / len(selected) if len(selected) else float("nan"),
        "recall": hits / stalks if stalks else float("nan"),
        "f1": 2.0 * hits / (len(selected) + stalks) if len(selected) + stalks else float("nan"),
        "f1_best": best,
        "f1_best_least_score": best_score,
        "seconds_per_pair": _mean(np.array([score.seconds for score in scores if math.isfinite(score.seconds)])),
        **_thesis_summary(scores),
    }


def _best_f1(detections: np.ndarray, stalks: int) -> tuple[float, float]:
    """Return the maximum F1 over all score thresholds, and that threshold; ``detections`` [K, 2] as in `PlotScore`."""
    if not len(detections) or not stalks:
        return float("nan"), float("nan")
    order = np.argsort(-detections[:, 0], kind="stable")
    hits = np.cumsum(detections[order, 1])
    f1 = 2.0 * hits / (np.arange(1, len(hits) + 1) + stalks)
    best = int(np.argmax(f1))
    return float(f1[best]), float(detections[order[best], 0])


def _thesis_summary(scores: list[PlotScore]) -> dict[str, float]:
    """Summarise the thesis's methods over the plots on which they were evaluated; empty if there are none."""
    both = [(score, score.thesis) for score in scores if score.thesis is not None]
    if not both:
        return {}
    true, counted = np.array([(score.true, thesis.counted) for score, thesis in both]).T
    widths = np.concatenate([thesis.widths for _, thesis in both])
    return {
        "thesis_count_r2": _agreement(counted, true),
        "thesis_count_mae": _mean(np.abs(counted - true)),
        "thesis_count_bias": float(counted.sum() / true.sum() - 1.0) if true.sum() else float("nan"),
        "thesis_width_mae_mm": _mean(np.abs(widths[:, 0] - widths[:, 1])),
        "thesis_width_bias_mm": _mean(widths[:, 0] - widths[:, 1]),
    }


def _agreement(counted: np.ndarray, true: np.ndarray) -> float:
    """Compute the coefficient of determination 1 - SSE / SST of counts against y = x; NaN if all true counts are equal."""
    spread = float(((true - true.mean()) ** 2).sum()) if len(true) else 0.0
    return 1.0 - float(((counted - true) ** 2).sum()) / spread if spread > 0 else float("nan")


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else float("nan")
