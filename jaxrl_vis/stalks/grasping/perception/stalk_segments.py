"""Segments of image rows on stalks ("chords"), and the 3D centre of the stalk at each.

In each row, adjacent masked pixels of similar depth are one chord of a stalk. Its middle column gives the direction to the
stalk, its depth the distance to the front, and its length the diameter, so that the centre of the stalk lies about half a
diameter behind the front.
"""

import dataclasses

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jaxrl_vis.stalks.grasping.perception.cloud import Cloud, Mount
from jaxrl_vis_envs.plants import Calibration

STEP = 3
"""Stride of the image rows that are processed."""

_JUMP = 0.02  # m: adjacent pixels whose depths differ by more are on different stalks
_MIN_PIXELS = 3  # minimum length of a chord
_BEHIND_FRONT = 0.9  # distance of the centre behind the matched front, relative to the radius
_MAX_THICKNESS = 0.035  # m: chords at least this long are not stalks
_MAX_SHIFT = 3.0  # pixels: maximum shift of a stalk from one processed row to the next


@dataclasses.dataclass(frozen=True)
class StalkSegments:
    """Chords of stalks in one pair or in several.

    Attributes:
        middle: [N, 3] float64, centre of the stalk at each chord in the robot's frame (`cloud`), m.
        thickness: [N] float64, diameter of the stalk, m.
        frame: [N] int, index of the pair.
        component: [N] int, index of the connected component: chords of one pair that are connected from row to row.
    """

    middle: np.ndarray
    thickness: np.ndarray
    frame: np.ndarray
    component: np.ndarray

    def __len__(self) -> int:
        return len(self.thickness)


def extract_stalk_segments(cloud: Cloud, calibration: Calibration, mount: Mount, frame: int) -> StalkSegments:
    """Return the chords of every `STEP`-th row of one pair, in its own robot frame; ``frame`` is the index of the pair."""
    red, depth = cloud.mask[::STEP], cloud.depth[::STEP]
    with np.errstate(invalid="ignore"):
        jump = np.abs(np.diff(depth, axis=1)) > _JUMP
    begins = red.copy()
    begins[:, 1:] &= ~red[:, :-1] | jump
    row, column = np.nonzero(red)
    first = np.flatnonzero(begins[row, column])
    if not first.size:
        return _empty_segments()
    last = np.append(first[1:], len(row)) - 1
    length = column[last] - column[first] + 1.0
    far = _middle_depth(depth[row, column], first, last)
    thickness = length * far / calibration.focal
    good = (length >= _MIN_PIXELS) & np.isfinite(far) & (thickness < _MAX_THICKNESS)
    row, far, thickness = row[first][good], far[good], thickness[good]
    across = (0.5 * (column[first] + column[last]))[good]
    if not len(row):
        return _empty_segments()
    piece = _split_runs(row, across, far)
    rays = np.stack(
        [
            (across - calibration.centre[0]) / calibration.focal,
            (STEP * row - calibration.centre[1]) / calibration.focal,
            np.ones(len(row)),
        ],
        axis=1,
    )
    points = rays * (far + _BEHIND_FRONT * 0.5 * thickness)[:, None]
    return StalkSegments(mount.pose.to_world(points), thickness, np.full(len(row), frame), piece)


def join_segments(segments: list[StalkSegments]) -> StalkSegments:
    """Concatenate the chords of several pairs, all in one robot frame; components are renumbered to stay distinct."""
    if not segments:
        return _empty_segments()
    counts = np.cumsum([0, *(int(part.component.max(initial=-1)) + 1 for part in segments)])
    return StalkSegments(
        np.concatenate([part.middle for part in segments]),
        np.concatenate([part.thickness for part in segments]),
        np.concatenate([part.frame for part in segments]),
        np.concatenate([part.component + count for part, count in zip(segments, counts)]),
    )


def _empty_segments() -> StalkSegments:
    return StalkSegments(np.zeros((0, 3)), np.zeros(0), np.zeros(0, int), np.zeros(0, int))


def _middle_depth(depth: np.ndarray, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Return the median depth [C] float64 of the inner half of each chord, m; NaN where less than half of that has a depth.

    Args:
        depth: [P], depths of the masked pixels in row-major order, m; NaN where there is none.
        first, last: [C] int, indices of the first and last pixel of each chord, both inclusive.
    """
    count = last - first + 1
    inner = np.maximum(count // 4, 0)
    begin, end = first + inner, last - inner + 1
    owner = np.repeat(np.arange(len(first)), end - begin)
    start = np.cumsum(end - begin) - (end - begin)
    values = depth[np.arange(len(owner)) + np.repeat(begin - start, end - begin)]
    order = np.lexsort((values, owner))  # NaN comes last
    valid = np.bincount(owner, np.isfinite(values), len(first)).astype(int)
    middle = values[order][np.minimum(start + valid // 2, len(values) - 1)]
    return np.where(2 * valid >= end - begin, middle, np.nan).astype(np.float64)


def _split_runs(image_row: np.ndarray, positions: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return the number [N] of the piece of each chord: connected components over neighbouring rows.

    Args:
        image_row: [N] int, index of the processed row of each chord, ascending.
        positions: [N], column of the middle of each chord, pixels.
        depth: [N], depth of each chord, m.
    """
    count = len(image_row)
    ends = np.searchsorted(image_row, np.arange(image_row.max() + 3))
    one, other = [], []
    for here in range(image_row.max()):
        upper, lower = np.arange(ends[here], ends[here + 1]), np.arange(ends[here + 1], ends[here + 2])
        if not (upper.size and lower.size):
            continue
        near = np.abs(positions[upper, None] - positions[None, lower]) < _MAX_SHIFT
        near &= np.abs(depth[upper, None] - depth[None, lower]) < _JUMP
        rows, columns = np.nonzero(near)
        one.append(upper[rows])
        other.append(lower[columns])
    if not one:
        return np.arange(count)
    rows, columns = np.concatenate(one), np.concatenate(other)
    _, piece = connected_components(coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count)), directed=False)
    return piece.astype(int)
