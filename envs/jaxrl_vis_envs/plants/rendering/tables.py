"""Tables of the surfaces of a plot that one camera sees, with a list per tile, for the renderer. NumPy only.

A ray through a pixel is d = (x, y, 1) in the camera's frame, so that the ray parameter is the planar depth.

A cone is hit where its quadratic in that depth has a root. Cross sections are ellipses; each cone has a direction u along which
space is compressed until they are circles. A triangle is hit where d, expressed in its three corners, has no negative
component.
"""

import dataclasses

import numpy as np

from jaxrl_vis_envs.plants.cameras import Calibration, Pose
from jaxrl_vis_envs.plants.rendering.surfaces import Surfaces

NEAR, FAR = 0.15, 6.0
"""Minimum and maximum rendered depth, m."""

# Numbers of table columns: first those for intersection, then those for appearance.
CONE_HIT, CONE_SHADING = 16, 16
TRIANGLE_HIT, TRIANGLE_SHADING = 9, 18
# Numbers of table rows: more than most plots need, so that one compiled program renders them all.
_CONES, _TRIANGLES, _MATERIALS, _LIST = 1 << 14, 1 << 16, 1 << 13, 1 << 18
_OVERLAP = 0.06  # overlap of successive cones relative to their radius, so that bends have no gaps


@dataclasses.dataclass(frozen=True)
class View:
    """Surfaces of a plot visible to one camera.

    Attributes:
        cones: [C, CONE_HIT + CONE_SHADING] float32.
        cone_instance, cone_material: [C] int32.
        triangles: [T, TRIANGLE_HIT + TRIANGLE_SHADING] float32.
        triangle_instance, triangle_material: [T] int32.
        materials: [M, ...] float32, as in `Surfaces`.
        tiles: [N, 2] int32, first column and row of each tile, pixels.
        cone_ranges, triangle_ranges: [N, 2] int32, begin and end of each tile's part of the lists.
        cone_list, triangle_list: [...] int32, rows of the tables, tile by tile.
    """

    cones: np.ndarray
    cone_instance: np.ndarray
    cone_material: np.ndarray
    triangles: np.ndarray
    triangle_instance: np.ndarray
    triangle_material: np.ndarray
    materials: np.ndarray
    tiles: np.ndarray
    cone_ranges: np.ndarray
    triangle_ranges: np.ndarray
    cone_list: np.ndarray
    triangle_list: np.ndarray


def tile_size(width: int) -> int:
    """Return the tile size (pixels) for an image width: smaller for small images, which show as many surfaces."""
    return 64 if width > 1500 else 32 if width > 600 else 16


def build_view(surfaces: Surfaces, pose: Pose, camera: Calibration, shift: float = 0.0) -> View:
    """Build the view of one camera.

    Args:
        surfaces: Surfaces of the plot.
        pose: Pose of the left camera.
        camera: Actual calibration of the pair.
        shift: Distance of this camera to the right of the left one, m.
    """
    tile = tile_size(camera.width)
    columns, rows = (-(-size // tile) for size in (camera.width, camera.height))
    offset = np.array([shift, 0.0, 0.0])

    candidates = np.flatnonzero(_may_be_in_sight(surfaces.start, pose, camera))
    start, end = pose.to_camera(surfaces.start[candidates]) - offset, pose.to_camera(surfaces.end[candidates]) - offset
    reach = surfaces.radii[candidates].max(axis=1) * np.sqrt(surfaces.oval[candidates, 0]) * 1.15
    cone_boxes = _tile_boxes(np.stack([start, end], axis=1), reach, camera)
    in_sight = _in_sight(cone_boxes, columns, rows)
    cone_boxes, visible_cones = cone_boxes[in_sight], candidates[in_sight]
    cones = _cone_table(surfaces, visible_cones, start[in_sight], end[in_sight], pose)

    candidates = np.flatnonzero(_may_be_in_sight(surfaces.corners[:, 0], pose, camera))
    corners = pose.to_camera(surfaces.corners[candidates]) - offset
    triangle_boxes = _tile_boxes(corners, np.zeros(len(corners)), camera)
    in_sight = _in_sight(triangle_boxes, columns, rows)
    in_sight[in_sight] = np.abs(np.linalg.det(corners[in_sight])) > 1e-12
    triangle_boxes, visible_triangles = triangle_boxes[in_sight], candidates[in_sight]
    triangles = _triangle_table(surfaces, visible_triangles, corners[in_sight], pose)

    cone_list, cone_ranges = _list_by_tile(cone_boxes, columns, rows)
    triangle_list, triangle_ranges = _list_by_tile(triangle_boxes, columns, rows)
    row, column = np.divmod(np.arange(columns * rows), columns)
    return View(
        cones=_pad_rows(cones, _CONES),
        cone_instance=_pad_rows(surfaces.cone_stalk[visible_cones], _CONES),
        cone_material=_pad_rows(surfaces.cone_material[visible_cones], _CONES),
        triangles=_pad_rows(triangles, _TRIANGLES),
        triangle_instance=_pad_rows(surfaces.triangle_instance[visible_triangles], _TRIANGLES),
        triangle_material=_pad_rows(surfaces.triangle_material[visible_triangles], _TRIANGLES),
        materials=_pad_rows(surfaces.materials, _MATERIALS),
        tiles=(tile * np.stack([column, row], axis=1)).astype(np.int32),
        cone_ranges=cone_ranges,
        triangle_ranges=triangle_ranges,
        cone_list=_pad_rows(cone_list, _LIST),
        triangle_list=_pad_rows(triangle_list, _LIST),
    )


def _pad_rows(table: np.ndarray, minimum: int) -> np.ndarray:
    """Append zero rows to a table, up to ``minimum`` rows or the smallest sufficient multiple of it by a power of two."""
    size = minimum
    while size < len(table):
        size *= 2
    return np.concatenate([table, np.zeros((size - len(table), *table.shape[1:]), table.dtype)])


def _may_be_in_sight(points: np.ndarray, pose: Pose, camera: Calibration) -> np.ndarray:
    """Return a mask of points [N, 3] in the world that may belong to something in sight: a cheap, conservative test."""
    if pose.rotation[0, 0] != 1.0:  # turned or rolled
        return np.ones(len(points), bool)
    depth_bound = points[:, 1] - pose.position[1] + 0.3
    wide, high = (1.15 * size / camera.focal / 2 + 0.05 for size in (camera.width, camera.height))
    sideways, above = np.abs(points[:, 0] - pose.position[0]), np.abs(points[:, 2] - pose.position[2])
    return (sideways < wide * depth_bound + 0.35 + camera.baseline) & (above < high * depth_bound + 0.35)


def _tile_boxes(points: np.ndarray, reach: np.ndarray, camera: Calibration) -> np.ndarray:
    """Return the tile ranges [N, 4] (first column and row, last column and row) that contain the spheres of radius ``reach``
    [N] about ``points`` [N, K, 3]; empty for spheres that are too near or too far.
    """
    with np.errstate(all="ignore"):
        depth = points[..., 2] - reach[:, None]
        low = points[..., :2] - reach[:, None, None]
        high = points[..., :2] + reach[:, None, None]
        # A sphere's far side projects nearer to the image's centre, so both depths bound it.
        near, far = depth[..., None], points[..., 2:] + reach[:, None, None]
        low_slope = np.minimum(low / near, low / far).min(axis=1)
        high_slope = np.maximum(high / near, high / far).max(axis=1)
        centre, tile = np.array(camera.centre), tile_size(camera.width)
        first = np.floor((low_slope * camera.focal + centre - 2.0) / tile)
        last = np.floor((high_slope * camera.focal + centre + 2.0) / tile)
        boxes = np.concatenate([first, last], axis=1)
    bad = (depth.min(axis=1) < NEAR) | (depth.max(axis=1) > FAR) | ~np.isfinite(boxes).all(axis=1)
    boxes[bad] = (0, 0, -1, -1)
    return np.clip(boxes, -1, 1 << 20).astype(np.int64)


def _in_sight(boxes: np.ndarray, columns: int, rows: int) -> np.ndarray:
    return (boxes[:, 0] < columns) & (boxes[:, 1] < rows) & (boxes[:, 2] >= 0) & (boxes[:, 3] >= 0)


def _list_by_tile(boxes: np.ndarray, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the table rows visible in each tile, tile by tile, and the range [N, 2] of each tile's part."""
    first = np.maximum(boxes[:, :2], 0)
    last = np.minimum(boxes[:, 2:], [columns - 1, rows - 1])
    wide, high = (last - first + 1).T if len(boxes) else np.zeros((2, 0), np.int64)
    counts = wide * high
    row = np.repeat(np.arange(len(boxes)), counts)
    number_in_box = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    tile_row, column = np.divmod(number_in_box, np.maximum(wide[row], 1))
    tile = (first[row, 1] + tile_row) * columns + first[row, 0] + column
    order = np.argsort(tile, kind="stable")
    ends = np.cumsum(np.bincount(tile, minlength=columns * rows))
    starts = np.concatenate([[0], ends[:-1]])
    return row[order].astype(np.int32), np.stack([starts, ends], axis=1).astype(np.int32)


def _cone_table(surfaces: Surfaces, visible: np.ndarray, start: np.ndarray, end: np.ndarray, pose: Pose) -> np.ndarray:
    """Build the rows of the cones ``visible``, given their ends [C, 3] in the camera's frame."""
    along = end - start
    length = np.linalg.norm(along, axis=1)
    axis = along / length[:, None]
    ratio, angle = surfaces.oval[visible].T
    major = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1) @ pose.rotation.T
    major -= (major * axis).sum(axis=1, keepdims=True) * axis
    major /= np.linalg.norm(major, axis=1, keepdims=True)
    squeeze = 1.0 / ratio - 1.0
    radii = surfaces.radii[visible] / np.sqrt(ratio)[:, None]
    slope = (radii[:, 1] - radii[:, 0]) / length

    offset = -start  # from the start to the camera
    inward = (offset * major).sum(axis=1)
    round_offset = offset + (squeeze * inward)[:, None] * major
    travelled = (offset * axis).sum(axis=1)
    radius = radii[:, 0] + slope * travelled
    twice = 2.0 * squeeze + squeeze**2
    constant = (round_offset**2).sum(axis=1) - travelled**2 - radius**2
    # The dot product of offset and ray in round space equals that of the ray and an offset that is squeezed twice.
    twice_squeezed = offset + (twice * inward)[:, None] * major
    margin = _OVERLAP * radii.max(axis=1)
    arcs, sheath, node = surfaces.arcs[visible], surfaces.sheath[visible], surfaces.node[visible]
    columns = [
        twice_squeezed, axis, major, twice[:, None], travelled[:, None], (1.0 + slope**2)[:, None],
        (travelled + slope * radius)[:, None], constant[:, None], -margin[:, None], (length + margin)[:, None],
        start, slope[:, None], arcs[:, :1], (np.diff(arcs, axis=1)[:, 0] / length)[:, None],
        sheath[:, :1], (np.diff(sheath, axis=1)[:, 0] / length)[:, None],
        node[:, :1], (np.diff(node, axis=1)[:, 0] / length)[:, None],
        surfaces.radii[visible][:, :1], ratio[:, None], np.zeros((len(start), 4)),
    ]  # fmt: skip
    return np.concatenate(columns, axis=1).astype(np.float32).reshape(-1, CONE_HIT + CONE_SHADING)


def _triangle_table(surfaces: Surfaces, visible: np.ndarray, corners: np.ndarray, pose: Pose) -> np.ndarray:
    """Build the rows of the triangles ``visible``, given their corners [T, 3, 3] in the camera's frame."""
    inverse = np.linalg.inv(np.swapaxes(corners, 1, 2)) if len(corners) else np.zeros((0, 3, 3))
    normals = surfaces.normals[visible] @ pose.rotation.T
    along, across, offset = (
        np.einsum("tk,tkc->tc", values[visible], inverse) for values in (surfaces.along, surfaces.across, surfaces.offset)
    )
    normal = np.einsum("tkn,tkc->tnc", normals, inverse).reshape(-1, 9)
    columns = [inverse.reshape(-1, 9), along, across, offset, normal]
    return np.concatenate(columns, axis=1).astype(np.float32).reshape(-1, TRIANGLE_HIT + TRIANGLE_SHADING)
