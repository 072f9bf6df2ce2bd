"""Direction in which the robot drove, and a check that its odometry and its images can both be right.

Odometry counts metres, but does not say whether the cameras moved to their own right or to their left: that depends on the
side of the robot that they look from. Two pairs that show the same stalks say by how much and which way they moved.
"""

import dataclasses

import numpy as np

from jaxrl_vis.stalks.phenotyping.track.follow import Path, Track, follow
from jaxrl_vis.stalks.phenotyping.track.sightings import Sighting
from jaxrl_vis_envs.plants import Calibration

_ALONG, _DEPTH = 0.006, 0.02  # m: by what two sightings of one stalk differ at most once the drive is taken off
_MIN_SHARED = 4  # stalks that two pairs must share before they say anything
_SHARED_SHARE = 0.75  # of the stalks of the pair that has fewer: by chance, so many do not stand as they do in another pair
_MAX_STEP_SHARE = 0.5  # of those: the odometry's own step explains less
_MIN_CONTRADICTIONS = 0.25  # of the pairs with so many stalks must say something against the odometry
_MIN_LINKED = 0.3  # of all sightings must go on a track the other way: fewer may do so by chance
_LINK_RATIO = 1.2  # by what more stalks go together the other way, where nothing is wrong with the way as it is given


@dataclasses.dataclass(frozen=True)
class Followed:
    """Tracks of a plot, and the robot's path.

    Attributes:
        tracks: Stalks, and what does not count.
        path: The robot's path; places grow as the odometry does, also where the cameras moved to their own left.
        fits: The images agree with the odometry. If not, nothing can be counted.
    """

    tracks: list[Track]
    path: Path
    fits: bool


def follow_either_way(
    frames: list[list[Sighting]],
    distances: np.ndarray,
    calibration: Calibration,
    columns: tuple[float, float] | None = None,
) -> Followed:
    """Put the sightings of a plot together, whichever way the cameras moved.

    What goes together with distances that grow to the cameras' right stays as `track.follow` makes it.

    Args:
        frames: Sightings of each pair, in the order in which the robot passed.
        distances: [F] float64, how far it had driven by its odometry, m.
        calibration: Calibration of the cameras.
        columns: See `track.follow`.
    """
    tracks, path = follow(frames, distances, calibration, columns=columns)
    fits = not _contradicted(frames, path.places)
    back, backwards = follow(frames, -np.asarray(distances, float), calibration, columns=columns)
    # Where pairs are too unlike each other to contradict anything, the way on which they go together is the right one.
    better = _links(back) > (_LINK_RATIO if fits else 1.0) * _links(tracks)
    well = _links(back) > _MIN_LINKED * sum(map(len, frames))
    if better and well and not _contradicted(frames, backwards.places):
        tracks = [dataclasses.replace(track, position_m=-track.position_m) for track in back]
        return Followed(tracks, dataclasses.replace(backwards, places=-backwards.places), True)
    return Followed(tracks, path, fits)


def _links(tracks: list[Track]) -> int:
    """Count the sightings of stalks that an earlier pair showed."""
    return sum(len(track.sightings) - 1 for track in tracks)


def _contradicted(frames: list[list[Sighting]], places: np.ndarray) -> bool:
    """Return True if most pairs that share stalks with the one before contradict the path.

    Args:
        frames: Sightings of each pair.
        places: [F] float64, of each pair along the row, m.
    """
    compared = judged = against = 0
    for first, second, step in zip(frames, frames[1:], np.diff(places)):
        best, own, most = _shared(_places(first), _places(second), float(step))
        compared += most >= _MIN_SHARED
        if best >= max(_MIN_SHARED, _SHARED_SHARE * most):
            judged += 1
            against += own < _MAX_STEP_SHARE * best
    return against > max(judged / 2, _MIN_CONTRADICTIONS * compared)


def _places(sightings: list[Sighting]) -> np.ndarray:
    """Return the positions of a pair's stalks that are known, [N, 2] float64: along the row and away from the cameras, m."""
    known = [
        (sighting.along_m, sighting.depth_m)
        for sighting in sightings
        if sighting.along_m is not None and sighting.depth_m is not None
    ]
    return np.array(known, float).reshape(-1, 2)


def _shared(first: np.ndarray, second: np.ndarray, step: float) -> tuple[int, int, int]:
    """Count the stalks that two pairs share: after the step that shares most, after a given one, and at the very most.

    Args:
        first, second: [N, 2] and [M, 2] float64, see `_places`.
        step: Distance that the cameras moved between them, m.
    """
    most = min(len(first), len(second))
    if most < _MIN_SHARED:
        return 0, 0, most
    moved = first[:, None, 0] - second[None, :, 0]  # [N, M], m: by what the cameras moved if the two were one stalk
    near = np.abs(first[:, None, 1] - second[None, :, 1]) < _DEPTH

    def count(by: float) -> int:
        one = near & (np.abs(moved - by) < _ALONG)
        return int(min(one.any(axis=0).sum(), one.any(axis=1).sum()))

    candidates = moved[near]
    best = max((count(float(by)) for by in candidates), default=0)
    # Odometry may be wrong by a few per cent, which `follow` takes off where it can; a step near enough is its own.
    own = max((count(float(by)) for by in candidates if abs(by - step) < 0.018), default=0)
    return best, own, most
