"""Grasp points as in the thesis: centres of dense regions in slices of the stitched cloud, seen from above.

The thesis states the height of a slice, 0.2 m, but not the heat map's cell size, smoothing and threshold. Here a cell is 1 cm,
and a cell is dense if its smoothed count is at least a quarter of the 90th percentile over occupied cells. Points lie on the
front of a stalk; the centre of a region is taken for that of the stalk.
"""

import dataclasses

import numpy as np
from scipy import ndimage

from jaxrl_vis.stalks.grasping.perception.cloud import subsample
from jaxrl_vis.stalks.grasping.perception.lines import PREFERRED, GraspPoint

THICKNESS = 0.2
"""Thickness of a slice, m."""
CELL = 0.01
"""Edge of a cell of the heat map, m."""
_VOXEL = 0.005  # m: downsampling, so that the density of points does not depend on the distance
_FRACTION = 0.25
_MIN_CELLS = 2


@dataclasses.dataclass(frozen=True)
class Slice:
    """Horizontal slice of a cloud, seen from above.

    Attributes:
        low: Height of its lower side, m.
        corner: [2], x and y of the first cell's corner, m.
        heat: [X, Y] float64, smoothed number of points in each cell.
        regions: [X, Y] int32, number of the region from 1; 0 for cells that are not dense.
        middles: [R, 3] float64, mean position of the points in each region of at least two cells, at half the slice's height,
            m.
    """

    low: float
    corner: np.ndarray
    heat: np.ndarray
    regions: np.ndarray
    middles: np.ndarray


def slice_at(points: np.ndarray, low: float) -> Slice:
    """Return the slice of points [N, 3] (m) from the height ``low`` to `THICKNESS` above it."""
    inside = points[(points[:, 2] >= low) & (points[:, 2] < low + THICKNESS)]
    inside = subsample(inside, _VOXEL)
    if not len(inside):
        return Slice(low, np.zeros(2), np.zeros((1, 1)), np.zeros((1, 1), int), np.zeros((0, 3)))
    corner = np.floor(inside[:, :2].min(axis=0) / CELL - 2) * CELL
    cell = ((inside[:, :2] - corner) / CELL).astype(int)
    counts = np.zeros(cell.max(axis=0) + 4)
    np.add.at(counts, tuple(cell.T), 1.0)
    heat = ndimage.gaussian_filter(counts, 0.7)
    dense = heat >= _FRACTION * np.quantile(heat[counts > 0], 0.9)
    regions = np.zeros(dense.shape, np.int32)
    count = int(ndimage.label(dense, np.ones((3, 3)), output=regions))  # pyright: ignore
    of_point = regions[tuple(cell.T)]
    middles = []
    for region in range(1, count + 1):
        own = inside[of_point == region]
        if (regions == region).sum() >= _MIN_CELLS and len(own):
            middles.append([*own[:, :2].mean(axis=0), low + 0.5 * THICKNESS])
    return Slice(low, corner, heat, regions, np.array(middles).reshape(-1, 3))


def detect_by_slice(points: np.ndarray) -> list[GraspPoint]:
    """Detect grasp points in the slice around the preferred height, in ascending order of x.

    Directions are vertical; thickness and spread are NaN, and the number of pairs is 0.

    Args:
        points: [N, 3], points of stalks of all pairs, in the robot frame of the last one, m.
    """
    middles = slice_at(points, PREFERRED - 0.5 * THICKNESS).middles
    upwards = np.array([0.0, 0.0, 1.0])
    return [GraspPoint(middle, upwards, np.nan, 0, np.nan) for middle in middles[np.argsort(middles[:, 0])]]
