"""Driving direction of the robot, and a consistency check of its odometry and images.

Odometry gives distances, but not whether the cameras moved to their own right or left, which depends on the side of the robot
they are mounted on. Two pairs that show the same stalks determine distance and direction of the motion.
"""

import dataclasses

import numpy as np

from jaxrl_vis.stalks.phenotyping.track.follow import RobotPath, Track, track_stalks
from jaxrl_vis.stalks.phenotyping.track.sightings import Sighting
from jaxrl_vis_envs.plants import Calibration

_ALONG, _DEPTH = 0.006, 0.02  # m: maximum differences of two sightings of one stalk after motion compensation
_MIN_SHARED = 4  # minimum number of shared stalks of two pairs to be compared
_MIN_SHARED_FRACTION = 0.75  # minimum shared fraction of the smaller pair's stalks: so many do not match by chance
_MAX_STEP_FRACTION = 0.5  # of those: a pair contradicts the odometry if its step matches fewer
_MIN_CONTRADICTIONS = 0.25  # minimum fraction of the comparable pairs that contradict the odometry
_MIN_LINKED = 0.3  # minimum fraction of all sightings that are linked in reverse: fewer may be so by chance
_LINK_RATIO = 1.2  # minimum ratio of links in reverse to forward, if the forward direction is consistent


@dataclasses.dataclass(frozen=True)
class TrackedPlot:
    """Tracks of a plot, and the robot's path.

    Attributes:
        tracks: Tracks of stalks, including those that are not counted.
        path: Path of the robot; positions increase with the odometry, even if the cameras moved to their own left.
        is_consistent: True if the images are consistent with the odometry. If False, stalks cannot be counted.
    """

    tracks: list[Track]
    path: RobotPath
    is_consistent: bool


def track_either_way(
    frames: list[list[Sighting]],
    distances: np.ndarray,
    calibration: Calibration,
    columns: tuple[float, float] | None = None,
) -> TrackedPlot:
    """Track the stalks of a plot in whichever direction the cameras moved.

    The result is that of `follow.track_stalks`, for a motion to the cameras' right, unless clearly more sightings are linked in
    the other direction and the images do not contradict it.

    Args:
        frames: Sightings of each pair, in driving order.
        distances: Distance driven [F] float64 by odometry, m.
        calibration: Calibration of the cameras.
        columns: Range of visible image columns; see `follow.track_stalks`.
    """
    tracks, path = track_stalks(frames, distances, calibration, columns=columns)
    fits = not _is_contradicted(frames, path.positions)
    back, backwards = track_stalks(frames, -np.asarray(distances, float), calibration, columns=columns)
    # If pairs differ too much to contradict either direction, take the one in which more sightings are linked.
    better = _count_links(back) > (_LINK_RATIO if fits else 1.0) * _count_links(tracks)
    well = _count_links(back) > _MIN_LINKED * sum(map(len, frames))
    if better and well and not _is_contradicted(frames, backwards.positions):
        tracks = [dataclasses.replace(track, position_m=-track.position_m) for track in back]
        return TrackedPlot(tracks, dataclasses.replace(backwards, positions=-backwards.positions), True)
    return TrackedPlot(tracks, path, fits)


def _count_links(tracks: list[Track]) -> int:
    """Count the sightings that continue a track from an earlier pair."""
    return sum(len(track.sightings) - 1 for track in tracks)


def _is_contradicted(frames: list[list[Sighting]], positions: np.ndarray) -> bool:
    """Return True if most of the pairs that share stalks with the previous one contradict the path.

    Args:
        frames: Sightings of each pair.
        positions: Position [F] float64 of each pair along the row, m.
    """
    compared = judged = against = 0
    for first, second, step in zip(frames, frames[1:], np.diff(positions)):
        best, own, possible = _count_shared(_row_positions(first), _row_positions(second), float(step))
        compared += possible >= _MIN_SHARED
        if best >= max(_MIN_SHARED, _MIN_SHARED_FRACTION * possible):
            judged += 1
            against += own < _MAX_STEP_FRACTION * best
    return against > max(judged / 2, _MIN_CONTRADICTIONS * compared)


def _row_positions(sightings: list[Sighting]) -> np.ndarray:
    """Return the known positions [N, 2] float64 of the stalks of a pair: along the row and depth, m."""
    known = [
        (sighting.along_m, sighting.depth_m)
        for sighting in sightings
        if sighting.along_m is not None and sighting.depth_m is not None
    ]
    return np.array(known, float).reshape(-1, 2)


def _count_shared(first: np.ndarray, second: np.ndarray, step: float) -> tuple[int, int, int]:
    """Count the stalks that two pairs share, by matching their positions after a step of the cameras.

    Args:
        first, second: Positions [N, 2] and [M, 2] float64, see `_row_positions`.
        step: Distance that the cameras moved between the pairs by odometry, m.

    Returns:
        Number of shared stalks after the best step and after about the given step, and the maximum possible number.
    """
    possible = min(len(first), len(second))
    if possible < _MIN_SHARED:
        return 0, 0, possible
    moved = first[:, None, 0] - second[None, :, 0]  # [N, M], m: motion of the cameras if the two are one stalk
    near = np.abs(first[:, None, 1] - second[None, :, 1]) < _DEPTH

    def count(by: float) -> int:
        one = near & (np.abs(moved - by) < _ALONG)
        return int(min(one.any(axis=0).sum(), one.any(axis=1).sum()))

    candidates = moved[near]
    best = max((count(float(by)) for by in candidates), default=0)
    # Tolerate an error of the odometry of a few per cent, which `track_stalks` corrects where possible.
    own = max((count(float(by)) for by in candidates if abs(by - step) < 0.018), default=0)
    return best, own, possible
