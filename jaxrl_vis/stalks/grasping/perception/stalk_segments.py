"""Segments of image lines on stalks: the middle of each stalk in space, line by line.

Line by line, painted pixels that are next to each other and about equally far away are one chord of a stalk. Its middle column
says in which direction the stalk is, its depth how far its front is, and its length how thick it is, so that the middle of the
stalk lies half a diameter behind its front.
"""

import dataclasses

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jaxrl_vis.stalks.grasping.perception.cloud import Cloud, Mount
from jaxrl_vis_envs.plants import Calibration

STEP = 3
"""Each so-many-th line of the image is looked at."""

_JUMP = 0.02  # m: pixels that differ more in depth are not one stalk
_MIN_PIXELS = 3  # pixels
_BEHIND_FRONT = 0.9  # of a radius: how far the middle lies behind what matching sees of the front
_THICK = 0.035  # m: no stalk is
_SIDEWAYS = 3.0  # pixels: by how much a stalk moves from one line to the next


@dataclasses.dataclass(frozen=True)
class StalkSegments:
    """StalkSegments of one image or of several.

    Attributes:
        middle: [N, 3] float64, middle of the stalk, m.
        thickness: [N] float64, m.
        frame: [N] int, which pair shows it.
        piece: [N] int, chords with the same number follow each other without a gap in one pair.
    """

    middle: np.ndarray
    thickness: np.ndarray
    frame: np.ndarray
    piece: np.ndarray

    def __len__(self) -> int:
        return len(self.thickness)


def stalk_segments(cloud: Cloud, calibration: Calibration, mount: Mount, frame: int) -> StalkSegments:
    """The chords of one pair, in its own robot frame."""
    red, depth = cloud.red[::STEP], cloud.depth[::STEP]
    with np.errstate(invalid="ignore"):
        jump = np.abs(np.diff(depth, axis=1)) > _JUMP
    begins = red.copy()
    begins[:, 1:] &= ~red[:, :-1] | jump
    line, column = np.nonzero(red)
    first = np.flatnonzero(begins[line, column])
    if not first.size:
        return _nothing()
    last = np.append(first[1:], len(line)) - 1
    length = column[last] - column[first] + 1.0
    far = _middle_depth(depth[line, column], first, last)
    thickness = length * far / calibration.focal
    good = (length >= _MIN_PIXELS) & np.isfinite(far) & (thickness < _THICK)
    line, far, thickness = line[first][good], far[good], thickness[good]
    across = (0.5 * (column[first] + column[last]))[good]
    if not len(line):
        return _nothing()
    piece = _pieces(line, across, far)
    rays = np.stack(
        [
            (across - calibration.centre[0]) / calibration.focal,
            (STEP * line - calibration.centre[1]) / calibration.focal,
            np.ones(len(line)),
        ],
        axis=1,
    )
    points = rays * (far + _BEHIND_FRONT * 0.5 * thickness)[:, None]
    return StalkSegments(mount.pose.to_world(points), thickness, np.full(len(line), frame), piece)


def joined(parts: list[StalkSegments]) -> StalkSegments:
    """StalkSegments of several pairs, in one frame; pieces stay apart."""
    if not parts:
        return _nothing()
    counts = np.cumsum([0, *(int(part.piece.max(initial=-1)) + 1 for part in parts)])
    return StalkSegments(
        np.concatenate([part.middle for part in parts]),
        np.concatenate([part.thickness for part in parts]),
        np.concatenate([part.frame for part in parts]),
        np.concatenate([part.piece + count for part, count in zip(parts, counts)]),
    )


def _nothing() -> StalkSegments:
    return StalkSegments(np.zeros((0, 3)), np.zeros(0), np.zeros(0, int), np.zeros(0, int))


def _middle_depth(depth: np.ndarray, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Median depth of the inner half of each chord; not a number where less than half of it has a depth."""
    count = last - first + 1
    inner = np.maximum(count // 4, 0)
    begin, end = first + inner, last - inner + 1
    owner = np.repeat(np.arange(len(first)), end - begin)
    start = np.cumsum(end - begin) - (end - begin)
    values = depth[np.arange(len(owner)) + np.repeat(begin - start, end - begin)]
    order = np.lexsort((values, owner))  # what is not a number comes last
    valid = np.bincount(owner, np.isfinite(values), len(first)).astype(int)
    middle = values[order][np.minimum(start + valid // 2, len(values) - 1)]
    return np.where(2 * valid >= end - begin, middle, np.nan).astype(np.float64)


def _pieces(line: np.ndarray, across: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Numbers the pieces that chords [N] make with those of the next line."""
    count = len(line)
    ends = np.searchsorted(line, np.arange(line.max() + 3))
    one, other = [], []
    for here in range(line.max()):
        upper, lower = np.arange(ends[here], ends[here + 1]), np.arange(ends[here + 1], ends[here + 2])
        if not (upper.size and lower.size):
            continue
        near = np.abs(across[upper, None] - across[None, lower]) < _SIDEWAYS
        near &= np.abs(far[upper, None] - far[None, lower]) < _JUMP
        rows, columns = np.nonzero(near)
        one.append(upper[rows])
        other.append(lower[columns])
    if not one:
        return np.arange(count)
    rows, columns = np.concatenate(one), np.concatenate(other)
    _, piece = connected_components(coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count)), directed=False)
    return piece.astype(int)
