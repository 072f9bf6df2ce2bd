"""Perception of a run, from stereo pairs to grasp points: stereo matching, masks, stitching, and detection.

pair -> disparity -> organised cloud, with the mask of the stalks
     -> stitched to the robot frame of the last pair, where the robot begins to grasp
     -> grasp points: a line per stalk, or the thesis's slices
"""

import contextlib
import dataclasses
import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np

from jaxrl_vis.stalks.grasping.perception.cloud import Cloud, Mount, build_cloud, compute_disparity
from jaxrl_vis.stalks.grasping.perception.lines import GraspPoint, detect_grasp_points
from jaxrl_vis.stalks.grasping.perception.slices import detect_by_slice
from jaxrl_vis.stalks.grasping.perception.stalk_segments import extract_stalk_segments, join_segments
from jaxrl_vis.stalks.grasping.perception.stitch import DEFAULT, THESIS, DownsampledCloud, Motion, Stitch, stitch
from jaxrl_vis.stalks.grasping.perception.visibility import Visibility
from jaxrl_vis_envs.plants import Calibration

Mask = Callable[[np.ndarray, int], np.ndarray]
"""Function from a left image [H, W, 3] uint8 and the number of its pair to the mask of the near row's stalks, [H, W] bool."""


@dataclasses.dataclass(frozen=True)
class View:
    """Images and odometry of one stereo pair.

    Attributes:
        number: Index of the pair in the run.
        left, right: [H, W, 3] uint8, rectified.
        driven: Distance driven so far, by odometry, m; None if unknown.
    """

    number: int
    left: np.ndarray
    right: np.ndarray
    driven: float | None


@dataclasses.dataclass(frozen=True)
class Perception:
    """Perception of a run.

    Attributes:
        clouds: Cloud of each pair used, in its own robot frame.
        stitches: Stitch of each pair but the last to the next one.
        to_last: Motion of each cloud to the robot frame of the last pair.
        points: Grasp points, in the robot frame of the last pair, from left to right.
        seconds: Time spent in each stage, over all pairs, s.
        notes: Irregularities, one line each.
    """

    clouds: tuple[Cloud, ...]
    stitches: tuple[Stitch, ...]
    to_last: tuple[Motion, ...]
    points: list[GraspPoint]
    seconds: dict[str, float]
    notes: tuple[str, ...]

    def stalk_points(self) -> np.ndarray:
        """Return the points [N, 3] of stalks of all pairs, in the robot frame of the last one, m."""
        return np.concatenate([motion(cloud.stalk_points()) for motion, cloud in zip(self.to_last, self.clouds)])


@dataclasses.dataclass(frozen=True)
class Variant:
    """Choice of the steps that follow the thesis instead of the default.

    Attributes:
        stitch: If true, clouds are stitched as in the thesis.
        points: If true, grasp points are detected as in the thesis.
    """

    stitch: bool = False
    points: bool = False

    def __str__(self) -> str:
        if self.stitch == self.points:
            return "thesis" if self.stitch else "default"
        return f"{'stitches' if self.stitch else 'grasp points'} of the thesis"


DEFAULT_VARIANT, THESIS_VARIANT = Variant(), Variant(True, True)


def perceive(
    views: Iterable[View], mask: Mask, calibration: Calibration, mount: Mount, variant: Variant = DEFAULT_VARIANT
) -> Perception:
    """Detect the grasp points of a run.

    If any pair lacks odometry, only the last one is used, unless clouds are stitched as in the thesis.

    Args:
        views: Pairs in the order in which they were taken; at least one.
        mask: Function that returns the mask of an image.
        calibration: Stated calibration of the pair.
        mount: Mount of the pair.
        variant: Steps that follow the thesis.

    Raises:
        ValueError: There is no pair.
    """
    seconds: dict[str, float] = {name: 0.0 for name in ("match", "mask", "stitch", "points")}
    clock = _Clock(seconds)
    views = list(views)
    if not views:
        raise ValueError("there is no pair to perceive anything in")
    notes = []
    if not variant.stitch and len(views) > 1 and any(view.driven is None for view in views):
        views, notes = views[-1:], ["no odometry: only the last pair was used"]
    with _threads(len(views)) as side_by_side:
        with clock("match"):
            matched = side_by_side(lambda view: compute_disparity(view.left, view.right, calibration, mount), views)
            # Matching runs in threads while the network computes masks, perhaps on an accelerator.
            with clock("mask"):
                painted = [mask(view.left, view.number) for view in views]
            clouds = list(
                side_by_side(lambda disparity, red: build_cloud(disparity, red, calibration, mount), matched, painted)
            )
        with clock("stitch"):
            method = THESIS if variant.stitch else DEFAULT
            thinned = list(side_by_side(lambda cloud: DownsampledCloud.of(cloud, method), clouds))
            driven = [_distance_driven(*neighbours) for neighbours in itertools.pairwise(views)]
            stitches = list(
                side_by_side(lambda here, there, far: stitch(here, there, far, method), thinned[:-1], thinned[1:], driven)
            )
        notes += [
            f"pair {views[index].number} does not stitch to the next, odometry was used: {step.refused}"
            for index, step in enumerate(stitches)
            if step.refused
        ]
        to_last = [Motion.along(0.0)]
        for step in reversed(stitches):
            to_last.insert(0, to_last[0].after(step.motion))
        with clock("points"):
            if variant.points:
                points = detect_by_slice(
                    np.concatenate([motion(cloud.stalk_points()) for motion, cloud in zip(to_last, clouds)])
                )
            else:
                segments = side_by_side(
                    lambda cloud, frame: extract_stalk_segments(cloud, calibration, mount, frame), clouds, range(len(clouds))
                )
                parts = [dataclasses.replace(part, middle=motion(part.middle)) for motion, part in zip(to_last, segments)]
                points = detect_grasp_points(
                    join_segments(parts), Visibility(tuple(clouds), tuple(to_last), calibration, mount)
                )
    if not points:
        notes.append("no stalk was found")
    return Perception(tuple(clouds), tuple(stitches), tuple(to_last), points, seconds, tuple(notes))


def _distance_driven(view: View, next_view: View) -> float:
    """Return the distance that the robot drove between two pairs, m; 0 if it is not known."""
    return 0.0 if view.driven is None or next_view.driven is None else next_view.driven - view.driven


@contextlib.contextmanager
def _threads(pairs: int) -> Iterator[Callable[..., Iterator[Any]]]:
    """Yield a `map` over pairs that runs in as many threads as OpenCV may use, or the built-in one for one thread.

    The threaded one submits its calls immediately.
    """
    threads = min(cv2.getNumThreads(), pairs)
    if threads < 2:
        yield map
        return
    with ThreadPoolExecutor(threads) as pool:
        yield pool.map


class _Clock:
    """Timer that accumulates the time spent in named stages; time in an inner stage does not count for the outer one."""

    def __init__(self, seconds: dict[str, float]) -> None:
        self._seconds, self._last = seconds, 0.0
        self._names: list[str] = []

    @contextlib.contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        self._record_lap()
        self._names.append(name)
        try:
            yield
        finally:
            self._record_lap()
            self._names.pop()

    def _record_lap(self) -> None:
        now = time.perf_counter()
        if self._names:
            self._seconds[self._names[-1]] += now - self._last
        self._last = now
