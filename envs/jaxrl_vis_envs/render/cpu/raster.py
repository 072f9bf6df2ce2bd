"""Nearest triangles of images on a CPU, by rasterisation: each triangle is tested at the pixels within its bounds only.

Most triangles of a fine mesh lie between the middles of pixels, or face away from the camera. So clusters of triangles are
selected by their bounds, then single triangles by theirs, and the pairs of a triangle and a pixel that remain are tested as in
the plain renderer: some thousand pairs in an image of 64x64, where testing blocks of pixels takes millions.

Images differ in their number of pairs. Those of several images are therefore listed one after another, and processed in chunks
of a fixed size, so that no image waits for another one, and the arrays of a chunk stay in the cache.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

from jaxrl_vis_envs.compiling.compilation import targets_cpu
from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.model import meshes
from jaxrl_vis_envs.render.pixel import blocks, raycast, shapes, triangles
from jaxrl_vis_envs.render.scene import Scene

# Maximum number of images whose triangles are in one list.
_IMAGES = 8
# Clusters, and pairs of a triangle and a pixel, in a chunk, per image of the list.
_CLUSTERS, _PAIRS = 256, 512
# Part of a pixel, and of a triangle's size, by which its bounds are enlarged; more than the rounding errors.
_ROUNDING, _RELATIVE = 1e-2, 1e-4
_FACING = 1e-5  # height above a triangle's plane in m, or sine of the angle to it, below which its front is invisible
_UNSET = np.iinfo(np.int32).max
_TABLES = ("triangles", "clusters", "cluster_places")
_LENS = ("fovy", "focal", "principal", "sensor", "znear")


class _Views(NamedTuple):
    """Images to search, [B, ...].

    Attributes:
        lens: Leaves of the scene by name, those in `_LENS`.
        unit: Rendered objects.
        depth: [B, P] float32, metres, maximum depth.
    """

    lens: dict[str, jax.Array]
    unit: shapes.UnitShapes
    depth: jax.Array


class _ImageBatch(NamedTuple):
    """Images whose triangles are in one list, G.

    Attributes:
        scene: Scene with the leaves in `_TABLES` only.
        ends: [G * K] int32, cumulative number of clusters that may be visible.
        axes, origin: Those of the objects of all images, one after another, see `UnitShapes`.
        lens: [G, 5] float32: the column is the first number times u plus the third, and the row the second times v plus the
            fourth; the fifth is the depth of the near plane, m.
        rays: [G * P].
        places: [H * W] int32, places of the pixels among the P, NumPy.
    """

    scene: Scene
    ends: jax.Array
    axes: jax.Array
    origin: jax.Array
    lens: jax.Array
    rays: Rays
    places: np.ndarray


class _Chunk(NamedTuple):
    """Some of the clusters of a list, Q, and the pixels that their triangles may cover, T = Q * CLUSTER.

    Attributes:
        image: [Q] int32.
        cluster: [Q] int32.
        first: [T] int32, first pixel in row-major order.
        width: [T] int32, number of columns, at least 1.
        ends: [T] int32, cumulative number of pixels.
    """

    image: jax.Array
    cluster: jax.Array
    first: jax.Array
    width: jax.Array
    ends: jax.Array


def can_search(scene: Scene) -> bool:
    """Return True if the scene's triangles are rasterised on the platform being traced for."""
    return targets_cpu() and scene.clusters.shape[-2] > 0


def nearest(scene: Scene, unit: shapes.UnitShapes, rays: Rays) -> blocks.Nearest:
    """Return the nearest opaque objects of all pixels, as `blocks.nearest` does. Not differentiable.

    Args:
        scene: Scene with triangles.
        unit: Rendered objects.
        rays: [blocks, P], those of all pixels, in the order of `blocks.layout`.
    """
    scene, unit = jax.lax.stop_gradient((scene, unit))
    key, row = blocks.nearest_primitives(scene, unit, rays)
    first_triangle = nearest_triangle(scene, unit, raycast.decode(scene, key, row)[0], blocks.layout(scene))
    return blocks.add_triangles(scene, key, row, first_triangle)


def nearest_triangle(
    scene: Scene, unit: shapes.UnitShapes, depth: jax.Array, layout: blocks.Layout
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Find the nearest triangle of an opaque object in front of ``depth``. Not differentiable.

    Args:
        scene: Scene with triangles.
        unit: Rendered objects.
        depth: [blocks, P] float32, metres, maximum depth.
        layout: Order of the pixels.

    Returns:
        The results of `triangles.nearest_triangle`, [blocks, P] each. The lowest bits of the depths (`triangles.NUMBER`) hold
        the triangle's index in its cluster.
    """
    leaves = [field.name for field in dataclasses.fields(scene) if not field.metadata.get("static")]
    tables = {name: getattr(scene, name) for name in _TABLES}
    views = _Views({name: getattr(scene, name) for name in _LENS}, unit, depth.ravel())
    search = _by_image(scene.replace(**dict.fromkeys(leaves)), layout)
    best, index = search(tables, jax.tree.map(lambda leaf: leaf[None], views))
    best, index = best.reshape(depth.shape), index.reshape(depth.shape)
    return jax.lax.bitcast_convert_type(best, jnp.float32), *triangles.place(scene, index)


def _by_image(bare: Scene, layout: blocks.Layout) -> Callable[[dict, _Views], tuple[jax.Array, jax.Array]]:
    """Return `_search_list` of any number of images; axes of `jax.vmap` are merged into that of the images."""

    @custom_vmap
    def search(tables: dict[str, jax.Array], views: _Views) -> tuple[jax.Array, jax.Array]:
        count = views.depth.shape[0]
        size = max(size for size in range(1, _IMAGES + 1) if count % size == 0)
        lists = jax.tree.map(lambda leaf: leaf.reshape(count // size, size, *leaf.shape[1:]), views)
        planes = jax.lax.map(lambda views: _search_list(bare.replace(**tables), layout, views), lists)
        return jax.tree.map(lambda plane: plane.reshape(count, -1), planes)

    @search.def_vmap
    def _(size: int, in_batched: list, tables: dict, views: _Views) -> tuple[tuple, tuple]:
        def spread(leaf: jax.Array, is_batched: bool) -> jax.Array:
            return leaf if is_batched else jnp.broadcast_to(leaf, (size, *leaf.shape))

        views = jax.tree.map(spread, views, in_batched[1])
        if any(jax.tree.leaves(in_batched[0])):  # meshes differ between images
            tables = jax.tree.map(spread, tables, in_batched[0])
            return jax.lax.map(lambda batch: search(*batch), (tables, views)), (True, True)
        merged = jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:]), views)
        planes = search(tables, merged)
        return jax.tree.map(lambda plane: plane.reshape(size, -1, plane.shape[-1]), planes), (True, True)

    return search


def _search_list(scene: Scene, layout: blocks.Layout, views: _Views) -> tuple[jax.Array, jax.Array]:
    """Find the nearest triangles of images.

    Args:
        scene: Scene with the leaves in `_TABLES` only.
        layout: Order of the pixels.
        views: The images, [G, ...].

    Returns:
        Bits of the depth, with the triangle's number in the lowest ones; and the triangle, which is its cluster times
        `CLUSTER` plus its number, -1 for none; [G * P] int32 each.
    """
    inside = (layout.rows < scene.height) & (layout.columns < scene.width)
    places = np.zeros(scene.height * scene.width, np.int32)
    places[(layout.rows * scene.width + layout.columns)[inside]] = np.flatnonzero(inside)

    def see(lens: dict[str, jax.Array], unit: shapes.UnitShapes, depth: jax.Array) -> tuple:
        own_scene = scene.replace(**lens)
        rays = camera.pixel_rays(own_scene, layout.rows.ravel(), layout.columns.ravel())
        visible = triangles.bounded(own_scene, triangles.opaque_bounds(own_scene, unit), rays, depth)
        slopes, shifts = [], []
        for length, middle, pitch, sign in zip(
            (scene.width, scene.height), camera.lens(own_scene), camera.pixel_pitch(own_scene), (1.0, -1.0), strict=False
        ):
            slopes.append(sign / pitch)  # rows are counted from the top
            shifts.append(0.5 * (length - 1) - slopes[-1] * middle)
        return visible, jnp.stack([*slopes, *shifts, own_scene.znear]), rays

    visible, lens, rays = jax.vmap(see)(*views)
    ends = jnp.cumsum(visible.ravel().astype(jnp.int32), dtype=jnp.int32)
    axes, origin = views.unit.axes.reshape(-1, 3, 3), views.unit.origin.reshape(-1, 3)
    listed = _ImageBatch(scene, ends, axes, origin, lens, jax.tree.map(jnp.ravel, rays), places)
    clusters, pairs = (size * len(views.depth) for size in (_CLUSTERS, _PAIRS))

    def draw_clusters(step: jax.Array, image: tuple) -> tuple:
        chunk = _make_chunk(listed, step * clusters + np.arange(clusters, dtype=np.int32))

        def draw_pairs(step: jax.Array, image: tuple) -> tuple:
            return _draw_pairs(listed, chunk, step * pairs + np.arange(pairs, dtype=np.int32), *image)

        return _in_chunks(chunk.ends[-1], pairs, draw_pairs, image)

    far = jax.lax.bitcast_convert_type(views.depth.ravel(), jnp.int32)
    return _in_chunks(ends[-1], clusters, draw_clusters, (far, jnp.full(far.shape, -1, jnp.int32)))


def _in_chunks(count: jax.Array, size: int, draw: Callable[[jax.Array, tuple], tuple], image: tuple) -> tuple:
    """Draw chunks of ``size`` of ``count`` elements, by their number, over an image."""
    state = (jnp.zeros((), jnp.int32), image)
    return jax.lax.while_loop(lambda state: state[0] * size < count, lambda s: (s[0] + 1, draw(*s)), state)[1]


def _get(array: jax.Array, index: jax.Array) -> jax.Array:
    return array.at[index].get(mode="promise_in_bounds")


def _make_chunk(listed: _ImageBatch, ordinals: jax.Array) -> _Chunk:
    """Return the clusters with numbers ``ordinals`` [Q] in the list. Those beyond its end have triangles without pixels."""
    scene, count = listed.scene, listed.scene.cluster_places.shape[0]
    element = jnp.minimum(triangles.kth(listed.ends, ordinals), len(listed.ends) - 1)
    image, cluster = element // count, element % count
    place = _get(scene.cluster_places, cluster)
    pose = image * (len(listed.origin) // len(listed.lens)) + place[:, 0]
    axes, origin, lens = _get(listed.axes, pose)[:, None], _get(listed.origin, pose)[:, None], _get(listed.lens, image)[:, None]
    normal = _columns(scene, place[:, 1], meshes.CLUSTER, meshes.MAP.start + 8, 4)  # the map's third row
    corners = _columns(scene, place[:, 1], meshes.CLUSTER, meshes.CORNERS.start, 9)
    is_flat = scene.projection == "orthographic"

    depths, coordinates = [], ([], [])
    for corner in range(3):
        offset = [corners[..., 3 * corner + i] - origin[..., i] for i in range(3)]
        point = [sum(axes[..., i, j] * offset[i] for i in range(3)) for j in range(3)]
        depths.append(-point[2])
        scale = 1.0 if is_flat else 1.0 / jnp.maximum(-point[2], 1e-6)
        for values, component in zip(coordinates, point, strict=False):
            values.append(component * scale)
    if is_flat:
        height = sum(normal[..., i] * axes[..., i, 2] for i in range(3))
    else:
        height = sum(normal[..., i] * origin[..., i] for i in range(3)) + normal[..., 3]
    is_front = (height > -_FACING) & (_largest(depths) > lens[..., 4]) & (ordinals < listed.ends[-1])[:, None]
    # A triangle that is partly behind the near plane may cover any pixel.
    is_cut = (_smallest(depths) < lens[..., 4]) & (not is_flat)
    ranges = []
    for axis, (values, length) in enumerate(zip(coordinates, (scene.width, scene.height), strict=True)):
        at = [lens[..., axis] * value + lens[..., 2 + axis] for value in values]
        low, high = _smallest(at), _largest(at)
        margin = _ROUNDING + _RELATIVE * (high - low)
        low = jnp.where(is_cut, 0.0, jnp.clip(jnp.ceil(low - margin), 0.0, length))
        high = jnp.where(is_cut, length - 1.0, jnp.clip(jnp.floor(high + margin), -1.0, length - 1.0))
        ranges.append((low.astype(jnp.int32), jnp.maximum(high - low + 1.0, 0.0).astype(jnp.int32)))
    (left, width), (top, height) = ranges
    pixels = jnp.where(is_front, width * height, 0).ravel()
    first = (top * scene.width + left).ravel()
    return _Chunk(image, cluster, first, jnp.maximum(width, 1).ravel(), jnp.cumsum(pixels, dtype=jnp.int32))


def _smallest(values: list[jax.Array]) -> jax.Array:
    return jnp.minimum(jnp.minimum(values[0], values[1]), values[2])


def _largest(values: list[jax.Array]) -> jax.Array:
    return jnp.maximum(jnp.maximum(values[0], values[1]), values[2])


def _columns(scene: Scene, row: jax.Array, rows: int, first: int, count: int) -> jax.Array:
    """Return columns of successive rows of `Scene.triangles`: [Q, ``rows``, ``count``], from the rows given [Q]."""
    return jax.vmap(lambda row: jax.lax.dynamic_slice(scene.triangles, (row, np.int32(first)), (rows, count)))(row)


def _find_triangle(ends: jax.Array, ordinals: jax.Array) -> jax.Array:
    """Return the first triangle of which the cumulative number of pixels [T] exceeds ``ordinals``, successive ones [N]."""
    count = len(ordinals)
    # By a histogram of the clusters' ends, and a bisection in the cluster.
    after = jnp.clip(ends[meshes.CLUSTER - 1 :: meshes.CLUSTER] - ordinals[0], 0, count)
    passed = jnp.zeros(count + 1, jnp.int32).at[after].add(1, mode="promise_in_bounds")
    item = jnp.cumsum(passed, dtype=jnp.int32)[:count] * meshes.CLUSTER
    item = jnp.minimum(item, len(ends) - meshes.CLUSTER)
    for step in (4, 2, 1):
        item = jnp.where(_get(ends, item + (step - 1)) <= ordinals, item + step, item)
    return item


def _draw_pairs(
    listed: _ImageBatch, chunk: _Chunk, ordinals: jax.Array, best: jax.Array, index: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Draw pairs of a triangle and a pixel.

    Args:
        listed: The images.
        chunk: Triangles.
        ordinals: [N] int32, numbers of the pairs among those of the chunk; those beyond the last have no effect.
        best: [G * P] int32, see `_search_list`.
        index: [G * P] int32.

    Returns:
        The new ``best`` and ``index``.
    """
    scene, valid = listed.scene, ordinals < chunk.ends[-1]
    item = _find_triangle(chunk.ends, ordinals)
    number = ordinals - jnp.where(item > 0, _get(chunk.ends, jnp.maximum(item - 1, 0)), 0)
    width, own, member = _get(chunk.width, item), item // meshes.CLUSTER, item % meshes.CLUSTER
    # Integer division is slow. This one is exact for triangles that cover less than four million pixels.
    down = ((number.astype(jnp.float32) + 0.5) / width.astype(jnp.float32)).astype(jnp.int32)
    pixel = _get(chunk.first, item) + down * (scene.width - width) + number
    image, cluster = _get(chunk.image, own), _get(chunk.cluster, own)
    pixel = image * (len(best) // len(listed.lens)) + _get(jnp.asarray(listed.places), jnp.where(valid, pixel, 0))
    place = _get(scene.cluster_places, cluster)
    pose = image * (len(listed.origin) // len(listed.lens)) + place[:, 0]
    axes, origin = _get(listed.axes, pose), _get(listed.origin, pose)
    maps = _columns(scene, place[:, 1] + member, 1, meshes.MAP.start, 12).reshape(-1, 3, 4)
    local_map = [[sum(maps[:, i, k] * axes[:, k, j] for k in range(3)) for j in range(3)] for i in range(3)]
    begin = [sum(maps[:, i, k] * origin[:, k] for k in range(3)) + maps[:, i, 3] for i in range(3)]
    rays = Rays(_get(listed.rays.u, pixel), _get(listed.rays.v, pixel))
    t, margin, is_front = triangles.cross(scene.replace(znear=_get(listed.lens, image)[:, 4]), local_map, begin, rays)
    meets = valid & is_front & (margin >= -triangles.SEAM)
    key = jnp.where(meets, (jax.lax.bitcast_convert_type(t, jnp.int32) & ~triangles.NUMBER) | member, _UNSET)
    nearest = best.at[pixel].min(key, mode="promise_in_bounds")
    # Of triangles at the same depth, the first one counts, also if it was drawn in an earlier chunk.
    is_new = nearest < best
    is_first = (key == _get(nearest, pixel)) & _get(is_new, pixel)
    triangle = jnp.where(is_first, cluster * meshes.CLUSTER + member, _UNSET)
    return nearest, jnp.where(is_new, _UNSET, index).at[pixel].min(triangle, mode="promise_in_bounds")
