"""Nearest triangle of meshes and height fields along rays.

Clusters whose bounding sphere does not intersect the pyramid of a block of pixels are skipped: the remaining ones are counted,
and a loop runs up to that count. Under `jax.vmap` it runs up to the largest count in the batch.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.model import meshes, reading
from jaxrl_vis_envs.render.pixel import shapes
from jaxrl_vis_envs.render.pixel.arithmetic import Vector
from jaxrl_vis_envs.render.scene import Scene

SEAM = 1e-5
"""Relative tolerance by which triangles extend beyond their edges, so that no ray passes between adjacent ones."""

# Horizontal and vertical offset of a second ray in `next_triangle`, relative to half the image's height. Few edges have that
# direction, and it is far larger than the rounding error of an edge.
_OFFSET = (2e-5, -6e-6)
# Part of a pixel by which the bounds of a cluster are rounded outwards, more than the rounding error of a large image.
_ROUNDING = 1e-2
NUMBER = meshes.CLUSTER - 1
"""Mask of the lowest bits of a depth, which hold a triangle's index in its cluster."""


class Segments(NamedTuple):
    """Parts of rays in the camera's frame, [P] float32 each; empty where ``farthest`` is not above ``nearest``.

    Attributes:
        start: Three components, metres.
        direction: Three components, unit vectors.
        nearest: Distance from the start at which the part begins, m.
        farthest: Distance at which it ends, m; may be infinite.
    """

    start: Vector
    direction: Vector
    nearest: jax.Array
    farthest: jax.Array


class Bounds(NamedTuple):
    """Pixels that clusters may cover, once per image.

    Attributes:
        sides: [K, 4] float32: minimum and maximum u, minimum and maximum v, of the rays through the middles of pixels that may
            meet a cluster's front; inverted if there is none.
        near: [K] float32, metres, depth in front of which nothing of the cluster lies.
    """

    sides: jax.Array
    near: jax.Array


def opaque_bounds(scene: Scene, unit: shapes.UnitShapes) -> Bounds:
    """Return the bounds of all clusters; inverted for transparent objects and for clusters that are not visible."""
    middle, facing = _in_camera(scene, unit)
    radius, sine = scene.clusters[:, 3], scene.clusters[:, 7]
    extents = camera.sphere_sides(scene, middle, radius)
    # Most clusters of a fine mesh lie between the middles of pixels: their bounds are rounded to those.
    middles = camera.lens(scene)
    sides = []
    for axis, (count, pitch) in enumerate(zip((scene.width, scene.height), camera.pixel_pitch(scene), strict=True)):
        first = middles[axis] - 0.5 * (count - 1) * pitch
        low = jnp.ceil((extents[:, 2 * axis] - first) / pitch - _ROUNDING)
        high = jnp.floor((extents[:, 2 * axis + 1] - first) / pitch + _ROUNDING)
        sides += [jnp.where(low <= high, first + low * pitch, camera.INFINITE), first + high * pitch]
    if scene.projection == "orthographic":
        is_front = -facing[:, 2] < sine
    else:
        distance = jnp.sqrt(jnp.sum(jnp.square(middle), axis=1))
        is_front = jnp.sum(middle * facing, axis=1) < sine * distance + radius * 1.001
    is_front &= jnp.asarray(np.array(scene.transparent) == reading.SOLID)[scene.cluster_places[:, 0]]
    is_front &= radius - middle[:, 2] > scene.znear
    sides[0] = jnp.where(is_front, sides[0], camera.INFINITE)
    sides[1] = jnp.where(is_front, sides[1], -camera.INFINITE)
    return Bounds(jnp.stack(sides, axis=1), -middle[:, 2] - radius)


def _in_camera(scene: Scene, unit: shapes.UnitShapes) -> tuple[jax.Array, jax.Array]:
    """Return the centres (m) and the axes of the cones of all clusters in the camera's frame, [K, 3] each."""
    owner = scene.cluster_places[:, 0]
    axes = unit.axes[owner]  # of a mesh, a rotation
    offset = scene.clusters[:, :3] - unit.origin[owner]
    return jnp.sum(axes * offset[:, :, None], axis=1), jnp.sum(axes * scene.clusters[:, 4:7, None], axis=1)


def nearest_triangle(
    scene: Scene,
    unit: shapes.UnitShapes,
    rays: Rays,
    depth: jax.Array,
    only: int | None = None,
    bounds: Bounds | None = None,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Find the nearest triangle in front of ``depth``.

    Args:
        scene: The scene.
        unit: Rendered objects.
        rays: [P]. The pixels should be close together.
        depth: [P] float32, metres, maximum depth.
        only: Row of the only object to test; None for all opaque objects, whose ``bounds`` are then needed.
        bounds: From `opaque_bounds`. The rays are then those through the middles of pixels.

    Returns:
        Depth [P] float32 of the triangle, or ``depth`` if there is none; its row in `Scene.triangles` and the row of its
        object, [P] int32 each, -1 if there is none.
    """
    # Index of the k-th candidate cluster = number of cumulative counts that are at most k.
    if bounds is None:
        assert only is not None
        candidates = _candidates(scene, unit, rays, depth, only)
    else:
        candidates = bounded(scene, bounds, rays, depth)
    counts = jnp.cumsum(candidates.astype(jnp.int32), dtype=jnp.int32)
    last = counts.shape[0] - 1
    far = jnp.asarray(np.inf, jnp.float32)

    def advance(state: tuple) -> tuple:
        step, best, best_index, met, cluster = state
        # The previous iteration's hit is compared only now: XLA on a CPU would otherwise recompute it for each output.
        nearer = met < best
        number = jax.lax.bitcast_convert_type(met, jnp.int32) & NUMBER
        best, best_index = jnp.where(nearer, met, best), jnp.where(nearer, cluster * meshes.CLUSTER + number, best_index)
        cluster = jnp.minimum(kth(counts, step), last)
        met = jnp.where(step < counts[last], _intersect_cluster(scene, unit, cluster, rays), far)
        return step + 1, best, best_index, met, cluster

    none = jnp.full(rays.u.shape, -1, jnp.int32)
    start = (jnp.zeros((), jnp.int32), depth, none, jnp.full(rays.u.shape, np.inf, jnp.float32), jnp.zeros((), jnp.int32))
    # One extra iteration, to compare the last hit.
    _, best, best_index, _, _ = jax.lax.while_loop(lambda state: state[0] <= counts[last], advance, start)
    return best, *place(scene, best_index)


def place(scene: Scene, index: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the rows in `Scene.triangles`, and those of the objects, of triangles given by their cluster times `CLUSTER` plus
    their index in it: [P] int32 each, -1 for none.
    """
    places = scene.cluster_places.at[jnp.maximum(index, 0) // meshes.CLUSTER].get(mode="promise_in_bounds")
    row = jnp.where(index >= 0, places[..., 1] + (index & NUMBER), -1)
    return row, jnp.where(index >= 0, places[..., 0], -1)


def bounded(scene: Scene, bounds: Bounds, rays: Rays, depth: jax.Array) -> jax.Array:
    """Return the mask [K] of clusters of opaque objects that the rays may intersect in front of ``depth``."""
    candidates = bounds.near < jnp.max(depth)
    for axis, (coordinate, pitch) in enumerate(zip(rays, camera.pixel_pitch(scene), strict=True)):
        candidates &= bounds.sides[:, 2 * axis] <= jnp.max(coordinate) + 0.25 * pitch
        candidates &= bounds.sides[:, 2 * axis + 1] >= jnp.min(coordinate) - 0.25 * pitch
    return candidates


def _candidates(scene: Scene, unit: shapes.UnitShapes, rays: Rays, depth: jax.Array, only: int) -> jax.Array:
    """Return the mask [K] of clusters of the object ``only`` that the rays may intersect in front of ``depth``."""
    middle, _ = _in_camera(scene, unit)
    return camera.in_view(scene, middle, scene.clusters[:, 3], rays, depth) & (scene.cluster_places[:, 0] == only)


def kth(counts: jax.Array, step: jax.Array) -> jax.Array:
    """Return the index of the first of the cumulative ``counts`` [K] that exceeds ``step``, K for none; int32, any shape.

    A bisection: a count of all that do not exceed it would read the whole array for every cluster.
    """
    low, size = jnp.zeros(jnp.shape(step), jnp.int32), counts.shape[0]
    for bit in reversed(range(size.bit_length())):
        probe = low + (1 << bit)
        below = counts.at[jnp.minimum(probe, size) - 1].get(mode="promise_in_bounds") <= step
        low = jnp.where((probe <= size) & below, probe, low)
    return low


def next_triangle(
    scene: Scene, unit: shapes.UnitShapes, rays: Rays, depth: jax.Array, only: int, after: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Find the next triangle of an object, in MuJoCo's drawing order, that is not behind ``depth``.

    A ray through a shared edge or corner hits exactly one of the adjacent triangles, as in OpenGL: the one that a slightly
    offset ray hits.

    Args:
        scene: The scene.
        unit: Rendered objects.
        rays: [P]. The pixels should be close together.
        depth: [P] float32, metres, maximum depth.
        only: Row of the object, which is transparent.
        after: [P] int32, row in `Scene.triangles` after which to search; -1 for the first triangle.

    Returns:
        Depth [P] float32 of the triangle, and its row [P] int32, -1 if there is none.
    """
    counts = jnp.cumsum(_candidates(scene, unit, rays, depth, only).astype(jnp.int32), dtype=jnp.int32)
    last = counts.shape[0] - 1
    unset = np.iinfo(np.int32).max
    half_height = jax.lax.stop_gradient(camera.lens(scene)[3])
    offset_rays = Rays(rays.u + _OFFSET[0] * half_height, rays.v + _OFFSET[1] * half_height)

    def advance(state: tuple) -> tuple:
        step, depths, rows = state
        cluster = jnp.minimum(kth(counts, step), last)
        first = scene.cluster_places[cluster][1]
        # Clusters are in the order of their triangles: one found in an earlier cluster precedes all in this one.
        crossings = zip(
            _intersect_triangles(scene, unit, cluster, rays),
            _intersect_triangles(scene, unit, cluster, offset_rays),
            strict=True,
        )
        for number, ((t, _, is_front), (_, margin, offset_is_front)) in enumerate(crossings):
            accepted = is_front & offset_is_front & (margin >= 0.0) & (t <= depth) & (first + number > after) & (rows == unset)
            depths, rows = jnp.where(accepted, t, depths), jnp.where(accepted, first + number, rows)
        return step + 1, depths, rows

    start = (jnp.zeros((), jnp.int32), jnp.ones_like(depth), jnp.full(rays.u.shape, unset, jnp.int32))
    _, depths, rows = jax.lax.while_loop(lambda state: state[0] < counts[last], advance, start)
    return depths, jnp.where(rows == unset, -1, rows)


def _intersect_cluster(scene: Scene, unit: shapes.UnitShapes, cluster: jax.Array, rays: Rays) -> jax.Array:
    """Return the depth [P] of a cluster's nearest triangle, with its index in the lowest bits; infinite if there is none."""
    best = jnp.full(rays.u.shape, np.iinfo(np.int32).max, jnp.int32)
    for number, (t, margin, is_front) in enumerate(_intersect_triangles(scene, unit, cluster, rays)):
        meets = is_front & (margin >= -SEAM)
        key = (jax.lax.bitcast_convert_type(t, jnp.int32) & ~NUMBER) | number
        best = jnp.minimum(best, jnp.where(meets, key, best))
    infinite = np.float32(np.inf).view(np.int32)
    return jax.lax.bitcast_convert_type(jnp.minimum(best, infinite), jnp.float32)


def _intersect_triangles(
    scene: Scene, unit: shapes.UnitShapes, cluster: jax.Array, rays: Rays
) -> Iterator[tuple[jax.Array, jax.Array, jax.Array]]:
    """Yield the depth of each triangle's plane, the minimum barycentric coordinate there, and a mask; [P] each.

    The triangles are those of one cluster. A negative coordinate is outside. The mask is True for triangles that face the ray
    beyond the near plane.
    """
    location = scene.cluster_places[cluster]
    axes, origin = unit.axes[location[0]], unit.origin[location[0]]
    columns = scene.triangles.shape[1]
    rows = jax.lax.dynamic_slice(scene.triangles, (location[1], np.int32(0)), (meshes.CLUSTER, columns))[:, meshes.MAP]
    maps = rows.reshape(meshes.CLUSTER, 3, 4)
    # Composed maps from the camera's frame to each unit triangle: few numbers, so that a ray needs only one map.
    local_maps = jnp.sum(maps[:, :, :3, None] * axes[None, None], axis=2)
    begin = jnp.sum(maps[:, :, :3] * origin, axis=2) + maps[:, :, 3]
    for number in range(meshes.CLUSTER):
        yield cross(scene, local_maps[number], begin[number], rays)


def cross(scene: Scene, local_map: Any, begin: Any, rays: Rays) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Intersect rays with the planes of triangles.

    Args:
        scene: The scene.
        local_map: Linear part of the map from the camera's frame to the unit triangle: [3, 3], or three rows of values [P].
        begin: Its constant part: [3], or three values [P].
        rays: [P].

    Returns:
        The results of `_intersect_triangles` for one triangle.
    """
    start, direction, _ = camera.ray_parts(scene, rays)
    ray = camera.multiply(local_map, direction)
    offset = camera.multiply(local_map, start)
    origin = tuple(begin[axis] + offset[axis] for axis in range(3))
    t = -origin[2] / jnp.where(ray[2] < 0.0, ray[2], -1.0)
    first, second = origin[0] + t * ray[0], origin[1] + t * ray[1]
    return t, jnp.minimum(jnp.minimum(first, second), 1.0 - first - second), (ray[2] < 0.0) & (t > scene.znear)
