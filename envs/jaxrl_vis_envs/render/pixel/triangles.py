"""The nearest triangle of meshes and height fields along rays.

Clusters of triangles whose ball does not touch the pyramid of a block of pixels are left out: the others are counted through,
and a loop runs up to that count. Under `jax.vmap` it runs up to the greatest count in the batch.
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.model import meshes, reading
from jaxrl_vis_envs.render.pixel import shapes
from jaxrl_vis_envs.render.scene import Scene

# How far outside of its edges, as a share of them, a triangle is still met, so that no ray slips between two.
_SEAM = 1e-5
# Across and up, as a share of half the image's height: where `next_triangle` looks, instead of the pixel's very middle. Few
# edges run in that direction, and it is far beyond what rounding moves an edge by.
_ASIDE = (2e-5, -6e-6)
_NUMBER = meshes.CLUSTER - 1  # the lowest bits of a depth, that hold the number of a triangle in its cluster


def nearest_triangle(
    scene: Scene, unit: shapes.UnitShapes, rays: Rays, depth: jax.Array, only: int | None = None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The nearest triangle before ``depth``.

    Args:
        scene: The scene.
        unit: The drawn objects.
        rays: [P]. The pixels should lie close together.
        depth: [P] float32, metres.
        only: Row of the only object that counts; all opaque ones if None.

    Returns:
        The depth [P] float32 of the triangle (or ``depth``), its row in `Scene.triangles` and the row of its object, [P] int32,
        -1 where there is none.
    """
    # Counts of clusters up to each one: the k-th that touches is the number of counts that are at most k.
    counts = jnp.cumsum(_touching(scene, unit, rays, depth, only).astype(jnp.int32), dtype=jnp.int32)
    last = counts.shape[0] - 1
    far = jnp.asarray(np.inf, jnp.float32)

    def advance(state: tuple) -> tuple:
        step, best, found, met, cluster = state
        # What the last round met is weighed only now: a CPU would otherwise meet it again for each of these two.
        nearer = met < best
        number = jax.lax.bitcast_convert_type(met, jnp.int32) & _NUMBER
        best, found = jnp.where(nearer, met, best), jnp.where(nearer, cluster * meshes.CLUSTER + number, found)
        cluster = jnp.minimum(jnp.sum((counts <= step).astype(jnp.int32), dtype=jnp.int32), last)
        met = jnp.where(step < counts[last], _meet_cluster(scene, unit, cluster, rays), far)
        return step + 1, best, found, met, cluster

    none = jnp.full(rays.u.shape, -1, jnp.int32)
    start = (jnp.zeros((), jnp.int32), depth, none, jnp.full(rays.u.shape, np.inf, jnp.float32), jnp.zeros((), jnp.int32))
    # One round more than there are clusters, to weigh what the last one met.
    _, best, found, _, _ = jax.lax.while_loop(lambda state: state[0] <= counts[last], advance, start)
    places = scene.cluster_places.at[jnp.maximum(found, 0) // meshes.CLUSTER].get(mode="promise_in_bounds")
    row = jnp.where(found >= 0, places[:, 1] + (found & _NUMBER), -1)
    return best, row, jnp.where(found >= 0, places[:, 0], -1)


def _touching(scene: Scene, unit: shapes.UnitShapes, rays: Rays, depth: jax.Array, only: int | None) -> jax.Array:
    """[K] bool: which clusters may be met by the rays before the depths."""
    owner = scene.cluster_places[:, 0]
    axes, origin = unit.axes[owner], unit.origin[owner]
    offset = scene.clusters[:, :3] - origin
    middle = jnp.sum(axes * offset[:, :, None], axis=1)  # back to the camera's frame: the axes of a mesh are a rotation
    touching = camera.in_view(scene, middle, scene.clusters[:, 3], rays, depth)
    if only is not None:
        return touching & (owner == only)
    opaque = np.array(scene.transparent) == reading.SOLID
    return touching & jnp.asarray(opaque)[owner]


def next_triangle(
    scene: Scene, unit: shapes.UnitShapes, rays: Rays, depth: jax.Array, only: int, after: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The next triangle of an object, in the order in which MuJoCo draws them, that is not behind ``depth``.

    A ray through a common edge or corner meets exactly one of the triangles around it, as in OpenGL: the one that a ray a hair
    aside meets.

    Args:
        scene: The scene.
        unit: The drawn objects.
        rays: [P]. The pixels should lie close together.
        depth: [P] float32, metres.
        only: Row of the object, one that lets light through.
        after: [P] int32, the row in `Scene.triangles` after which it is looked for; -1 for the first.

    Returns:
        The depth [P] float32 of the triangle, and its row [P] int32, -1 where there is none.
    """
    counts = jnp.cumsum(_touching(scene, unit, rays, depth, only).astype(jnp.int32), dtype=jnp.int32)
    last = counts.shape[0] - 1
    most = np.iinfo(np.int32).max
    half_height = jax.lax.stop_gradient(camera.lens(scene)[3])
    aside = Rays(rays.u + _ASIDE[0] * half_height, rays.v + _ASIDE[1] * half_height)

    def advance(state: tuple) -> tuple:
        step, depths, rows = state
        cluster = jnp.minimum(jnp.sum((counts <= step).astype(jnp.int32), dtype=jnp.int32), last)
        first = scene.cluster_places[cluster][1]
        # Clusters come in the order of their triangles: what was found in one before is not after what is in this one.
        crossings = zip(_meet_each(scene, unit, cluster, rays), _meet_each(scene, unit, cluster, aside), strict=True)
        for number, ((t, _, before), (_, margin, before_aside)) in enumerate(crossings):
            taken = before & before_aside & (margin >= 0.0) & (t <= depth) & (first + number > after) & (rows == most)
            depths, rows = jnp.where(taken, t, depths), jnp.where(taken, first + number, rows)
        return step + 1, depths, rows

    start = (jnp.zeros((), jnp.int32), jnp.ones_like(depth), jnp.full(rays.u.shape, most, jnp.int32))
    _, depths, rows = jax.lax.while_loop(lambda state: state[0] < counts[last], advance, start)
    return depths, jnp.where(rows == most, -1, rows)


def _meet_cluster(scene: Scene, unit: shapes.UnitShapes, cluster: jax.Array, rays: Rays) -> jax.Array:
    """Depth of the nearest triangle of one cluster, its number in the lowest bits, infinite for none; [P] float32."""
    best = jnp.full(rays.u.shape, np.iinfo(np.int32).max, jnp.int32)
    for number, (t, margin, before) in enumerate(_meet_each(scene, unit, cluster, rays)):
        meets = before & (margin >= -_SEAM)
        key = (jax.lax.bitcast_convert_type(t, jnp.int32) & ~_NUMBER) | number
        best = jnp.minimum(best, jnp.where(meets, key, best))
    infinite = np.float32(np.inf).view(np.int32)
    return jax.lax.bitcast_convert_type(jnp.minimum(best, infinite), jnp.float32)


def _meet_each(
    scene: Scene, unit: shapes.UnitShapes, cluster: jax.Array, rays: Rays
) -> Iterator[tuple[jax.Array, jax.Array, jax.Array]]:
    """Depth of each triangle's plane, the least barycentric coordinate there, and whether it faces the ray; [P] each.

    The triangles are those of one cluster. A coordinate is negative outside. One before the near plane does not face the ray.
    """
    place = scene.cluster_places[cluster]
    axes, origin = unit.axes[place[0]], unit.origin[place[0]]
    columns = scene.triangles.shape[1]
    rows = jax.lax.dynamic_slice(scene.triangles, (place[1], np.int32(0)), (meshes.CLUSTER, columns))[:, meshes.MAP]
    maps = rows.reshape(meshes.CLUSTER, 3, 4)
    # From the camera's frame to that of each unit triangle: a handful of numbers, so that a ray needs one map only.
    turned = jnp.sum(maps[:, :, :3, None] * axes[None, None], axis=2)
    begin = jnp.sum(maps[:, :, :3] * origin, axis=2) + maps[:, :, 3]
    start, direction, _ = camera.ray_parts(scene, rays)
    for number in range(meshes.CLUSTER):
        ray = camera.mapped(turned[number], direction)
        offset = camera.mapped(turned[number], start)
        from_ = tuple(begin[number, axis] + offset[axis] for axis in range(3))
        t = -from_[2] / jnp.where(ray[2] < 0.0, ray[2], -1.0)
        first, second = from_[0] + t * ray[0], from_[1] + t * ray[1]
        yield t, jnp.minimum(jnp.minimum(first, second), 1.0 - first - second), (ray[2] < 0.0) & (t > scene.znear)
