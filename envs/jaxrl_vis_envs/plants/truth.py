"""Ground truth of the stalks in one stereo pair: boxes, visibility, and edges. NumPy only.

Columns and rows are those of the left image, with (0, 0) at the centre of the first pixel. A box is (left, top, right,
bottom), the outer edges of its pixels: a box around the first pixel alone is (-0.5, -0.5, 0.5, 0.5).
"""

import dataclasses

import numpy as np

from jaxrl_vis_envs.plants.cameras import Calibration, Pose
from jaxrl_vis_envs.plants.family import INCH
from jaxrl_vis_envs.plants.field import Plot, Stalk

HEIGHTS = (12 * INCH, 24 * INCH)
"""Heights above the ground at which the thesis measures widths, m."""
BAND = (12 * INCH - 0.1, 12 * INCH + 0.1)
"""Lower and upper limit of the band in which stalks are detected, m above the ground."""

Box = tuple[float, float, float, float]


@dataclasses.dataclass(frozen=True)
class StalkInView:
    """One stalk of the near row in one left image.

    Attributes:
        stalk: Index in `Plot.stalks`; the same in all pairs.
        box: Box around the whole stalk within the image, including occluded parts.
        visible_box: Box around the visible pixels; None if there are none.
        visible: Visible fraction of its area inside the image.
        pixels: Number of visible pixels.
        band_box, band_visible: Box and visible fraction of the part within a band of heights; None and 0 if that is outside
            the image.
    """

    stalk: int
    box: Box
    visible_box: Box | None
    visible: float
    pixels: int
    band_box: Box | None
    band_visible: float


def outline(stalk: Stalk, pose: Pose, camera: Calibration, heights: np.ndarray | None = None) -> np.ndarray:
    """Project the two edges of a stalk to the left image, ignoring occlusion.

    Exact for a straight piece of stalk with parallel sides; taper moves an edge by less than a hundredth of a pixel.

    Args:
        stalk: The stalk.
        pose: Pose of the left camera.
        camera: Actual calibration of the cameras.
        heights: [K] above the ground, m; by default, the stalk's own knots.

    Returns:
        [K, 2, 2] float64: (left, right) x (column, row), pixels.
    """
    arcs = stalk.arc if heights is None else np.interp(heights, stalk.points[:, 2], stalk.arc)
    middle = np.stack([np.interp(arcs, stalk.arc, stalk.points[:, axis]) for axis in range(3)], axis=1)
    step = 1e-3
    ahead, behind = (
        np.stack([np.interp(arcs + sign * step, stalk.arc, stalk.points[:, axis]) for axis in range(3)], axis=1)
        for sign in (1.0, -1.0)
    )
    axis = (ahead - behind) @ pose.rotation.T
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    major = np.array([np.cos(stalk.oval_angle), np.sin(stalk.oval_angle), 0.0]) @ pose.rotation.T
    major = major - (axis @ major)[:, None] * axis
    major /= np.linalg.norm(major, axis=1, keepdims=True)

    def scale_along_major(vectors: np.ndarray, factor: float) -> np.ndarray:
        return vectors + (factor - 1.0) * (vectors * major).sum(axis=1, keepdims=True) * major

    # In space compressed until the stalk is round, its edges are where rays are tangent to a circle.
    radius = (np.interp(arcs, stalk.arc, stalk.radius) / np.sqrt(stalk.ovality))[:, None]
    centre = scale_along_major(pose.to_camera(middle), 1.0 / stalk.ovality)
    from_axis = centre - (centre * axis).sum(axis=1, keepdims=True) * axis
    distance = np.linalg.norm(from_axis, axis=1, keepdims=True)
    from_axis /= distance
    sideways = np.cross(axis, from_axis)
    sine = radius / distance
    sides = []
    for sign in (-1.0, 1.0):
        tangent_point = centre + radius * (sign * np.sqrt(1.0 - sine**2) * sideways - sine * from_axis)
        point = scale_along_major(tangent_point, stalk.ovality)
        sides.append(point[:, :2] / point[:, 2:] * camera.focal + np.array(camera.centre))
    left, right = sides
    swap = left[:, :1] > right[:, :1]
    return np.stack([np.where(swap, right, left), np.where(swap, left, right)], axis=1)


def stalks_in_view(
    plot: Plot, pose: Pose, camera: Calibration, instance: np.ndarray, depth: np.ndarray, band: tuple[float, float] = BAND
) -> list[StalkInView]:
    """Return the stalks of the near row that one left image shows, or would show without occlusion.

    Args:
        plot: The plot.
        pose: Pose of the left camera.
        camera: Actual calibration of the cameras.
        instance: [H, W] int32, instance image of a `Pair`.
        depth: [H, W] float32, planar depth, m.
        band: Lower and upper limit of the band, m above the ground.
    """
    stalks = []
    for index, stalk in enumerate(plot.measured):
        tall = stalk.points[:, 2].max()
        projection = _area(outline(stalk, pose, camera, np.linspace(0.0, tall, 120)), camera)
        if projection is None:
            continue
        box, area = _extended_to_ground(projection[0], stalk, pose, camera), projection[1]
        rows, columns = _pixels(box, camera)
        row, column = np.nonzero(instance[rows, columns] == index)
        row, column = row + rows.start, column + columns.start
        part = _area(outline(stalk, pose, camera, np.linspace(*band, 40)), camera) if band[0] < tall else None
        within = 0
        if part is not None and row.size:
            x = (column - camera.centre[0]) / camera.focal
            y = (row - camera.centre[1]) / camera.focal
            points = np.stack([x, y, np.ones_like(x)], axis=1) * depth[row, column][:, None]
            height = pose.to_world(points)[:, 2]
            within = int(((height >= band[0]) & (height <= band[1])).sum())
        visible_box = _bounding_box(column, row) if row.size else None
        stalks.append(
            StalkInView(
                stalk=index,
                box=box,
                visible_box=visible_box,
                visible=min(row.size / area, 1.0),
                pixels=int(row.size),
                band_box=None if part is None else part[0],
                band_visible=0.0 if part is None else min(within / part[1], 1.0),
            )
        )
    return stalks


def _area(edges: np.ndarray, camera: Calibration) -> tuple[Box, float] | None:
    """Return box and area (pixels) of the part of an outline [K, 2, 2] inside the image; None if it is empty."""
    middle_rows = edges[:, :, 1].mean(axis=1)
    order = np.argsort(middle_rows)
    rows = np.arange(max(int(np.ceil(middle_rows.min())), 0), min(int(np.floor(middle_rows.max())), camera.height - 1) + 1)
    if not rows.size:
        return None
    sides = []
    for side in (0, 1):
        row_order = np.argsort(edges[:, side, 1])
        sides.append(np.interp(rows, edges[row_order, side, 1], edges[row_order, side, 0]))
    left, right = (np.clip(side, -0.5, camera.width - 0.5) for side in sides)
    wide = right - left
    inside = wide > 0
    if wide.sum() < 1.0:
        return None
    top, bottom = middle_rows[order[0]], middle_rows[order[-1]]
    box = (left[inside].min(), max(top, -0.5), right[inside].max(), min(bottom, camera.height - 0.5))
    return tuple(map(float, box)), float(wide.sum())  # pyright: ignore[reportReturnType]


def _extended_to_ground(box: Box, stalk: Stalk, pose: Pose, camera: Calibration) -> Box:
    """Extend a box down to the front of the stalk's foot, which is nearer than its edges."""
    towards = (pose.position - stalk.points[0])[:2]
    foot = stalk.points[0].copy()
    foot[:2] += stalk.radius[0] * towards / np.linalg.norm(towards)
    _, y, z = pose.to_camera(foot)
    row = y / z * camera.focal + camera.centre[1]
    return (*box[:3], float(max(box[3], min(row, camera.height - 0.5))))


def _bounding_box(column: np.ndarray, row: np.ndarray) -> Box:
    """Return the box around pixels."""
    return (float(column.min()) - 0.5, float(row.min()) - 0.5, float(column.max()) + 0.5, float(row.max()) + 0.5)


def _pixels(box: Box, camera: Calibration) -> tuple[slice, slice]:
    """Return the slices of rows and columns of an image that contain a box, with a margin of 20 pixels."""
    left, top, right, bottom = box
    return (
        slice(max(int(top) - 20, 0), min(int(bottom) + 21, camera.height)),
        slice(max(int(left) - 20, 0), min(int(right) + 21, camera.width)),
    )
