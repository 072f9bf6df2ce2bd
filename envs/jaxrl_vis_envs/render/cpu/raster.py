"""Nearest triangles of an image on a CPU, by rasterisation: each triangle is tested at the pixels within its bounds only.

Most triangles of a fine mesh lie between the middles of pixels, or face away from the camera. So clusters of triangles are
selected by their bounds, then single triangles by theirs, and the pairs of a triangle and a pixel that remain are tested as in
the plain renderer: some thousand pairs in an image of 64x64, where testing blocks of pixels takes millions.

How many there are differs between images. They are processed in groups of a fixed size, and the images of a batch one after
another, so that none waits for those of another image, and all of an image's arrays stay in the cache.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import sequential_vmap

from jaxrl_vis_envs.compiling.compilation import targets_cpu
from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.model import meshes
from jaxrl_vis_envs.render.pixel import blocks, raycast, shapes, triangles
from jaxrl_vis_envs.render.scene import Scene

# Clusters, and pairs of a triangle and a pixel, that are processed together.
_CLUSTERS, _PAIRS = 256, 1024
# Part of a pixel, and of a triangle's size, by which its bounds are enlarged; more than the rounding errors.
_ROUNDING, _RELATIVE = 1e-2, 1e-4
_FACING = 1e-5  # m, height above a triangle's plane from which its front may be visible
_UNSET = np.iinfo(np.int32).max


class _Boxes(NamedTuple):
    """Pixels that triangles may cover, [T] int32 each.

    Attributes:
        first: Index of the first pixel, in row-major order.
        width: Number of columns.
        ends: Cumulative numbers of pixels.
    """

    first: jax.Array
    width: jax.Array
    ends: jax.Array


def can_search(scene: Scene) -> bool:
    """Return True if the scene's triangles are rasterised on the platform being traced for."""
    return targets_cpu() and scene.clusters.shape[-2] > 0


def nearest(scene: Scene, unit: shapes.UnitShapes, rays: Rays) -> blocks.Nearest:
    """Return the nearest opaque objects of all pixels, as `blocks.nearest`. Not differentiable.

    Args:
        scene: Scene with triangles.
        unit: Rendered objects.
        rays: [blocks, P], those of all pixels, in the order of `blocks.layout`.
    """
    layout = blocks.layout(scene)
    scene, unit = jax.lax.stop_gradient((scene, unit))
    key, row = blocks.nearest_primitives(scene, unit, rays)

    @sequential_vmap
    def search(scene: Scene, unit: shapes.UnitShapes, rays: Rays, depth: jax.Array) -> tuple[jax.Array, ...]:
        return nearest_triangle(scene, unit, rays, depth, layout)

    found = search(scene, unit, rays, raycast.decode(scene, key, row)[0])
    return blocks.add_triangles(scene, key, row, found)


def nearest_triangle(
    scene: Scene, unit: shapes.UnitShapes, rays: Rays, depth: jax.Array, layout: blocks.Layout
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Find the nearest triangle of an opaque object in front of ``depth``, as `triangles.nearest_triangle`.

    Args:
        scene: Scene with triangles.
        unit: Rendered objects.
        rays: [blocks, P], those of all pixels.
        depth: [blocks, P] float32, metres, maximum depth.
        layout: Order of the pixels.
    """
    shape = depth.shape
    rays, depth = jax.tree.map(jnp.ravel, (rays, depth))
    bounds = triangles.opaque_bounds(scene, unit)
    counts = jnp.cumsum(triangles.bounded(scene, bounds, rays, depth).astype(jnp.int32), dtype=jnp.int32)
    last = counts.shape[0] - 1
    inside = (layout.rows < scene.height) & (layout.columns < scene.width)
    places = np.zeros(scene.height * scene.width, np.int32)
    places[(layout.rows * scene.width + layout.columns)[inside]] = np.flatnonzero(inside)

    def draw_clusters(state: tuple) -> tuple:
        step, *image = state
        ordinals = step * _CLUSTERS + np.arange(_CLUSTERS, dtype=np.int32)
        cluster = jnp.minimum(triangles.kth(counts, ordinals), last)
        boxes = _triangle_boxes(scene, unit, cluster, ordinals < counts[last])

        def draw_pairs(state: tuple) -> tuple:
            step, *image = state
            return step + 1, *_draw_pairs(scene, unit, cluster, boxes, step, rays, jnp.asarray(places), *image)

        return step + 1, *_loop(boxes.ends[-1], _PAIRS, draw_pairs, image)

    image = [jax.lax.bitcast_convert_type(depth, jnp.int32), jnp.full(depth.shape, -1, jnp.int32)]
    best, index = _loop(counts[last], _CLUSTERS, draw_clusters, image)
    found = (jax.lax.bitcast_convert_type(best, jnp.float32), *triangles.place(scene, index))
    return jax.tree.map(lambda plane: plane.reshape(shape), found)


def _loop(count: jax.Array, size: int, advance: object, image: list) -> list:
    """Advance the state ``(step, *image)`` for each group of ``size`` of ``count`` elements; return the image."""
    return jax.lax.while_loop(lambda state: state[0] * size < count, advance, (jnp.zeros((), jnp.int32), *image))[1:]


def _triangle_boxes(scene: Scene, unit: shapes.UnitShapes, cluster: jax.Array, valid: jax.Array) -> _Boxes:
    """Return the boxes of the triangles of clusters [Q], those of a cluster one after another; empty unless ``valid`` [Q]."""
    place = scene.cluster_places[cluster]
    axes, origin = unit.axes[place[:, 0]], unit.origin[place[:, 0]]

    def columns(first: int, count: int) -> jax.Array:
        size = (meshes.CLUSTER, count)
        return jax.vmap(lambda row: jax.lax.dynamic_slice(scene.triangles, (row, np.int32(first)), size))(place[:, 1])

    normal, corners = columns(meshes.MAP.start + 8, 4), columns(meshes.CORNERS.start, 9)
    sides = []
    depths, us, vs = [], [], []
    for corner in range(3):
        offset = [corners[:, :, 3 * corner + i] - origin[:, None, i] for i in range(3)]
        x, y, z = (sum(axes[:, None, i, j] * offset[i] for i in range(3)) for j in range(3))
        depths.append(-z)
        scale = 1.0 if scene.projection == "orthographic" else 1.0 / jnp.maximum(-z, 1e-6)
        us.append(x * scale)
        vs.append(y * scale)
    nearest = jnp.minimum(jnp.minimum(depths[0], depths[1]), depths[2])
    farthest = jnp.maximum(jnp.maximum(depths[0], depths[1]), depths[2])
    if scene.projection == "orthographic":
        ahead = -sum(normal[:, :, i] * axes[:, None, i, 2] for i in range(3))
        is_front = ahead < _FACING
    else:
        height = sum(normal[:, :, i] * origin[:, None, i] for i in range(3)) + normal[:, :, 3]
        is_front = height > -_FACING
    is_front &= valid[:, None] & (farthest > scene.znear)
    crosses = (nearest < scene.znear) & (scene.projection != "orthographic")
    middles = camera.lens(scene)
    sides = []
    for coordinates, middle, pitch, count, sign in (
        (us, middles[0], camera.pixel_pitch(scene)[0], scene.width, 1.0),
        (vs, middles[1], camera.pixel_pitch(scene)[1], scene.height, -1.0),  # rows are counted from the top
    ):
        at = [sign * (coordinate - middle) / pitch + 0.5 * (count - 1) for coordinate in coordinates]
        low, high = jnp.minimum(jnp.minimum(at[0], at[1]), at[2]), jnp.maximum(jnp.maximum(at[0], at[1]), at[2])
        margin = _ROUNDING + _RELATIVE * (high - low)
        low = jnp.clip(jnp.ceil(low - margin), 0.0, count)
        high = jnp.clip(jnp.floor(high + margin), -1.0, count - 1.0)
        sides.append((jnp.where(crosses, 0.0, low).astype(jnp.int32), jnp.where(crosses, count - 1.0, high).astype(jnp.int32)))
    (left, right), (top, bottom) = sides
    width = jnp.maximum(right - left + 1, 0)
    size = jnp.where(is_front, width * jnp.maximum(bottom - top + 1, 0), 0).ravel()
    return _Boxes((top * scene.width + left).ravel(), width.ravel(), jnp.cumsum(size, dtype=jnp.int32))


def _draw_pairs(
    scene: Scene,
    unit: shapes.UnitShapes,
    cluster: jax.Array,
    boxes: _Boxes,
    step: jax.Array,
    rays: Rays,
    places: jax.Array,
    best: jax.Array,
    index: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Draw a group of pairs of a triangle and a pixel into an image.

    Args:
        scene: The scene.
        unit: Rendered objects.
        cluster: [Q] int32.
        boxes: Those of the clusters' triangles.
        step: [] int32, number of the group.
        rays: [P].
        places: [H * W] int32, places of the pixels among the P.
        best: [P] int32, bits of the depth of the nearest intersection, of which the lowest hold the triangle's number.
        index: [P] int32, the triangle: cluster times `CLUSTER` plus number; -1 for none.

    Returns:
        The new ``best`` and ``index``.
    """
    ordinals = step * _PAIRS + np.arange(_PAIRS, dtype=np.int32)
    item = jnp.minimum(triangles.kth(boxes.ends, ordinals), boxes.ends.shape[0] - 1)
    before = jnp.where(item > 0, boxes.ends[jnp.maximum(item - 1, 0)], 0)
    number, width = ordinals - before, jnp.maximum(boxes.width[item], 1)
    pixel = boxes.first[item] + number // width * scene.width + number % width
    valid = ordinals < boxes.ends[-1]
    pixel = places[jnp.where(valid, pixel, 0)]
    own, member = cluster[item // meshes.CLUSTER], item % meshes.CLUSTER
    place = scene.cluster_places[own]
    axes, origin = unit.axes[place[:, 0]], unit.origin[place[:, 0]]
    row = place[:, 1] + member
    maps = jax.vmap(lambda row: jax.lax.dynamic_slice(scene.triangles, (row, np.int32(meshes.MAP.start)), (1, 12)))(row)
    maps = maps.reshape(_PAIRS, 3, 4)
    local = [[sum(maps[:, i, k] * axes[:, k, j] for k in range(3)) for j in range(3)] for i in range(3)]
    begin = [sum(maps[:, i, k] * origin[:, k] for k in range(3)) + maps[:, i, 3] for i in range(3)]
    t, margin, is_front = triangles.cross(scene, local, begin, Rays(rays.u[pixel], rays.v[pixel]))
    meets = valid & is_front & (margin >= -triangles.SEAM)
    key = (jax.lax.bitcast_convert_type(t, jnp.int32) & ~triangles.NUMBER) | member
    nearest = best.at[pixel].min(jnp.where(meets, key, _UNSET))
    # Of triangles at the same depth, the first one counts, also if it was drawn in an earlier group.
    is_new = nearest < best
    first = meets & (key == nearest[pixel])
    index = jnp.where(is_new, _UNSET, index)
    return nearest, index.at[pixel].min(jnp.where(first & is_new[pixel], own * meshes.CLUSTER + member, _UNSET))
