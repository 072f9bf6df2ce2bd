"""Scores of masks, stitches and grasp points against the exact ground truth of synthetic rows, rendered for this purpose.

row -> five pairs -> perception -> grasp points         as `run` does, without files
    -> true stalks, poses and masks                     from the row itself

Stalks count if they stand within the 0.5 m that the robot drives along, at the preferred height. A grasp point hits the stalk
that it is matched with, one to one, if it lies within 30 mm of that stalk's centre at its own height.
"""

import dataclasses
import math
from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from jaxrl_vis.stalks.grasping.masks.examples import true_mask
from jaxrl_vis.stalks.grasping.perception.cloud import Mount
from jaxrl_vis.stalks.grasping.perception.lines import PREFERRED
from jaxrl_vis.stalks.grasping.perception.perceive import DEFAULT_VARIANT, Mask, Perception, Variant, View, perceive
from jaxrl_vis.stalks.grasping.perception.stitch import Motion
from jaxrl_vis_envs.plants import Drive, Family, Plot, Pose, draw
from jaxrl_vis_envs.plants.pairs import Sequence

RADIUS = 0.03
"""Maximum distance between a grasp point and its matched stalk, m: half the mean spacing."""


@dataclasses.dataclass(frozen=True)
class MaskScore:
    """Agreement of masks with the truth, over the pairs of a run.

    Attributes:
        hits, painted, true: Numbers of true positive, predicted, and true pixels of stalks.
        boundary: Mean distance between the outlines of both masks, in both directions, pixels; NaN without outlines.
    """

    hits: int
    painted: int
    true: int
    boundary: float


@dataclasses.dataclass(frozen=True)
class RunScore:
    """Score of one run's perception.

    Attributes:
        seed: Seed of the row.
        true: Number of stalks in the stretch.
        detected: Number of grasp points that are matched with a stalk in the stretch, or with none and lie in it.
        errors: [K] float64, horizontal distance of each matched grasp point from its stalk, mm.
        stitches: [S] float64, horizontal error of each stitch, mm.
        refused: Number of stitches that were refused.
        seconds: Time per pair, by stage, s.
        mask: Agreement of masks with the truth; None for true masks.
        notes: Irregularities, in words.
    """

    seed: int
    true: int
    detected: int
    errors: np.ndarray
    stitches: np.ndarray
    refused: int
    seconds: dict[str, float]
    mask: MaskScore | None
    notes: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Scene:
    """Rendered images and ground truth of one synthetic run.

    Attributes:
        plot: Plants of the row.
        drive: Trajectory and calibration of the cameras.
        mount: Nominal mount of the cameras.
        views: Stereo pairs.
        masks: [F, H, W] bool, true masks of the left images.
    """

    plot: Plot
    drive: Drive
    mount: Mount
    views: tuple[View, ...]
    masks: np.ndarray


def draw_scene(family: Family, seed: int) -> Scene:
    """Sample a row from a family and render its pairs and true masks."""
    sequence = Sequence.of(draw(family, seed))
    views, masks = [], []
    for pair in sequence:
        driven = float(sequence.drive.odometry[pair.frame])
        views.append(View(pair.frame, np.asarray(pair.left), np.asarray(pair.right), driven))
        masks.append(true_mask(pair.instance, len(sequence.plot.measured)))
    return Scene(sequence.plot, sequence.drive, Mount.of(family.rig), tuple(views), np.stack(masks))


def score_scene(scene: Scene, mask: Mask | None = None, variant: Variant = DEFAULT_VARIANT) -> tuple[RunScore, Perception]:
    """Run the perception on a scene and score it against the ground truth.

    Args:
        scene: Pairs and ground truth of the run.
        mask: Function from a left image and the number of its pair to the image's mask, see `Mask`; None for true masks.
        variant: Steps that follow the thesis.

    Returns:
        The score, and the perception itself.
    """
    painted: dict[int, np.ndarray] = {}

    def record_mask(image: np.ndarray, number: int) -> np.ndarray:
        painted[number] = scene.masks[number] if mask is None else mask(image, number)
        return painted[number]

    perception = perceive(scene.views, record_mask, scene.drive.stated, scene.mount, variant)
    targets = points_in_plot(perception, scene)
    true, detected, errors = match_stalks(targets, scene.plot)
    poses = scene.drive.poses
    errors_of_stitches = [
        stitch_error(stitch.motion, poses[index], poses[index + 1], scene.mount)
        for index, stitch in enumerate(perception.stitches)
    ]
    count = len(scene.views)
    score = RunScore(
        seed=scene.plot.seed,
        true=true,
        detected=detected,
        errors=1e3 * errors,
        stitches=1e3 * np.array(errors_of_stitches),
        refused=sum(bool(stitch.refused) for stitch in perception.stitches),
        seconds={name: value / count for name, value in perception.seconds.items()},
        mask=None if mask is None else _mask_score([(painted[number], scene.masks[number]) for number in painted]),
        notes=perception.notes,
    )
    return score, perception


def points_in_plot(perception: Perception, scene: Scene) -> np.ndarray:
    """Return grasp points [B, 3] in the plot's frame, m, by the true pose at the last pair and the nominal mount."""
    points = np.array([point.point for point in perception.points]).reshape(-1, 3)
    return scene.drive.poses[-1].to_world(scene.mount.pose.to_camera(points))


def driven_stretch(plot: Plot) -> tuple[float, float]:
    """Return the two ends of the stretch of the row that the robot drives along, m."""
    length = plot.family.layout.plot_length
    stretch = plot.family.rig.stretch or length
    return 0.5 * (length - stretch), 0.5 * (length + stretch)


def match_stalks(targets: np.ndarray, plot: Plot) -> tuple[int, int, np.ndarray]:
    """Match grasp points with stalks of the near row, one to one.

    Args:
        targets: [B, 3], grasp points in the plot's frame, m.
        plot: Plants of the row.

    Returns:
        Number of stalks in the stretch; number of grasp points that are matched with one of them, or with no stalk and lie in
        the stretch; and horizontal distances [K] float64 between matched points and stalks in the stretch, m.
    """
    low, high = driven_stretch(plot)
    inside = np.array([low <= stalk.at_height(PREFERRED)[0][0] <= high for stalk in plot.measured], bool)
    distance = np.array(
        [[math.dist(target[:2], stalk.at_height(target[2])[0][:2]) for stalk in plot.measured] for target in targets]
    ).reshape(len(targets), len(plot.measured))
    rows, columns = linear_sum_assignment(np.minimum(distance, RADIUS))
    near = distance[rows, columns] < RADIUS
    of_target = dict(zip(rows[near].tolist(), columns[near].tolist()))
    errors = [distance[row, column] for row, column in of_target.items() if inside[column]]
    false = sum(row not in of_target and low <= target[0] <= high for row, target in enumerate(targets))
    return int(inside.sum()), len(errors) + int(false), np.array(errors)


def true_motion(first: Pose, second: Pose, mount: Mount) -> Motion:
    """Return the true motion from the robot frame of one pair to that of another, by the poses of their cameras."""
    nominal = mount.pose
    rotation = nominal.rotation.T @ second.rotation @ first.rotation.T @ nominal.rotation
    origin = nominal.to_world(second.to_camera(first.to_world(nominal.to_camera(np.zeros(3)))))
    return Motion(rotation, origin)


def stitch_error(motion: Motion, first: Pose, second: Pose, mount: Mount) -> float:
    """Return the mean horizontal error of a stitch over points of the row, m.

    Args:
        motion: Estimated motion from the robot frame of the first pair to that of the second.
        first, second: True poses of the left camera at both pairs, in the plot's frame.
        mount: Nominal mount of the cameras.
    """
    away = float(0.5 * (first.position[1] + second.position[1]))
    places = np.array([[x, -away, z] for x in (-0.2, 0.0, 0.2) for z in (0.5, 0.75, 1.0)])
    difference = motion(places) - true_motion(first, second, mount)(places)
    return float(np.linalg.norm(difference[:, :2], axis=1).mean())


def _mask_score(masks: list[tuple[np.ndarray, np.ndarray]]) -> MaskScore:
    """Score pairs of predicted and true masks, each [H, W] bool."""
    far = [_mean_outline_distance(*both) for both in masks]
    return MaskScore(
        hits=int(sum((painted & true).sum() for painted, true in masks)),
        painted=int(sum(painted.sum() for painted, _ in masks)),
        true=int(sum(true.sum() for _, true in masks)),
        boundary=float(np.nanmean(far)) if np.isfinite(far).any() else math.nan,
    )


def _mean_outline_distance(painted: np.ndarray, true: np.ndarray) -> float:
    """Return the mean distance of the outlines of two masks, in both directions, pixels; NaN if either has none."""
    outlines = [mask.astype(np.uint8) - cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) for mask in (painted, true)]
    if not all(outline.any() for outline in outlines):
        return math.nan
    far = [cv2.distanceTransform(1 - outline, cv2.DIST_L2, 5) for outline in outlines]
    return 0.5 * float(far[0][outlines[1] > 0].mean() + far[1][outlines[0] > 0].mean())


def summarize_scores(scores: Iterable[RunScore]) -> dict[str, Any]:
    """Summarize the scores of runs.

    Returns:
        ``f1``, ``precision`` and ``recall`` of stalks, ``point_median_mm`` and ``point_p95_mm``, ``stitch_median_mm`` and
        ``stitch_p95_mm``, ``stitches_refused``, ``seconds_per_pair`` and its parts, for networks ``mask_f1`` and
        ``mask_boundary_px``, and the counts that they are computed from. NaN if there is nothing to average.
    """
    scores = list(scores)
    true, detected = sum(score.true for score in scores), sum(score.detected for score in scores)
    errors = np.concatenate([score.errors for score in scores] or [np.zeros(0)])
    stitches = np.concatenate([score.stitches for score in scores] or [np.zeros(0)])
    hits = len(errors)
    seconds = {
        name: float(np.median([score.seconds[name] for score in scores])) for name in (scores[0].seconds if scores else ())
    }
    metrics = {
        "runs": len(scores),
        "stalks": true,
        "grasp_points": detected,
        "hits": hits,
        "precision": hits / detected if detected else math.nan,
        "recall": hits / true if true else math.nan,
        "f1": 2.0 * hits / (true + detected) if true + detected else math.nan,
        "point_median_mm": _quantile(errors, 0.5),
        "point_p95_mm": _quantile(errors, 0.95),
        "stitches": len(stitches),
        "stitches_refused": sum(score.refused for score in scores),
        "stitch_median_mm": _quantile(stitches, 0.5),
        "stitch_p95_mm": _quantile(stitches, 0.95),
        "seconds_per_pair": float(np.median([sum(score.seconds.values()) for score in scores])) if scores else math.nan,
        **{f"seconds_{name}": value for name, value in seconds.items()},
    }
    masks = [score.mask for score in scores if score.mask is not None]
    if masks:
        painted, wanted = sum(mask.painted for mask in masks), sum(mask.true for mask in masks)
        metrics["mask_f1"] = 2.0 * sum(mask.hits for mask in masks) / (painted + wanted) if painted + wanted else math.nan
        metrics["mask_boundary_px"] = float(np.nanmean([mask.boundary for mask in masks]))
    return metrics


def _quantile(values: np.ndarray, fraction: float) -> float:
    return float(np.quantile(values, fraction)) if values.size else math.nan
