"""Per image: instances in the camera's frame from front to back, the floor behind them, and lists of instances by tile."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from benchmarks.mesh_kernels.structure import Structure
from jaxrl_vis_envs.compiling.gpu_kernels import kernel_call

FAR = 1e9
CHUNK = 32
"""Instances that a program tests against its tile at once."""


class Views(NamedTuple):
    """Inputs of the kernels for I images of N instances (padded to a multiple of `CHUNK`) from front to back.

    Attributes:
        near: [I, N] float32, m, depth in front of which nothing of the instance lies; `FAR` for those out of view.
        rectangle: [I, N] int32, columns and rows that the bounding sphere covers: first and last column, first and last row, a
            byte each from the lowest.
        pose: [I, N, 12] float32: rows of the map from the camera's frame to the mesh's, then the camera's position there.
        back: [I, N, 12] float32: rows of the map from the frame of the geom to the camera's, m, then the geom's position.
        mesh: [I, N] int32, number of the mesh.
        octant: [I, N] int32, see `Structure.nodes`.
        ids: [I, N] int32, geoms.
        depth: [I, P] float32, m, depth of the floor or of the far plane.
        floor: [I, P] int32, geom of the floor, -1 for the sky.
    """

    near: jax.Array
    rectangle: jax.Array
    pose: jax.Array
    back: jax.Array
    mesh: jax.Array
    octant: jax.Array
    ids: jax.Array
    depth: jax.Array
    floor: jax.Array


def half_height(mj_model: mujoco.MjModel) -> float:
    """Return the tangent of half the field of view, the same for all cameras."""
    assert len(set(mj_model.cam_fovy)) == 1
    return float(np.tan(np.deg2rad(mj_model.cam_fovy[0]) / 2))


def make_views(mj_model: mujoco.MjModel, structure: Structure, size: int, poses: dict[str, jax.Array]) -> Views:
    """Compute the inputs of the kernels; traceable. Image ``world * cameras + camera`` is that of one camera in one world.

    Args:
        mj_model: Model of meshes and at most one finite plane.
        structure: Structures of its meshes.
        size: Height and width of the images.
        poses: Poses of W worlds, see `models.random_poses`.
    """
    kinds = mj_model.geom_type
    geoms = np.flatnonzero(kinds == mujoco.mjtGeom.mjGEOM_MESH)
    meshes = mj_model.geom_dataid[geoms]
    worlds, cameras = len(poses["cam_xpos"]), mj_model.ncam
    eye = poses["cam_xpos"][:, :, None, :]  # [W, C, 1, 3]
    axes = poses["cam_xmat"].reshape(worlds, cameras, 1, 3, 3)
    turns = poses["geom_xmat"].reshape(worlds, 1, -1, 3, 3)
    places = poses["geom_xpos"][:, None]
    offset = _times(_transposed(axes), places[:, :, geoms] - eye)  # geom in the camera's frame
    back = _product(_transposed(axes), turns[:, :, geoms])
    middle = offset + _times(back, jnp.asarray(structure.middle[meshes], jnp.float32))
    cell = jnp.asarray(structure.cell[meshes], jnp.float32)
    forth = _transposed(back) / cell[:, :, None]
    start = -_times(forth, offset) - jnp.asarray(structure.low[meshes], jnp.float32) / cell
    radius = jnp.asarray(structure.radius[meshes], jnp.float32) * (1.0 + 1e-4)
    half = half_height(mj_model)
    sides, seen = _rectangles(middle, radius, half, size)
    znear = mj_model.vis.map.znear * mj_model.stat.extent
    ahead = -middle[..., 2]
    seen &= ahead + radius > znear
    near = jnp.where(seen, jnp.maximum(ahead - radius, znear), FAR)
    ahead_local = _times(forth, middle)
    octant = jnp.sum(jnp.where(ahead_local < 0.0, jnp.array([1, 2, 4]), 0), -1)
    images, padded = worlds * cameras, -(-len(geoms) // CHUNK) * CHUNK
    order = jnp.argsort(near.reshape(images, -1), axis=1)

    def sorted_(values: Any, fill: float) -> jax.Array:
        values = jnp.broadcast_to(values, (worlds, cameras, *values.shape[-1:]) if values.ndim == 1 else values.shape)
        values = jnp.take_along_axis(values.reshape(images, len(geoms)), order, axis=1)
        return jnp.pad(values, ((0, 0), (0, padded - len(geoms))), constant_values=fill)

    def sorted_rows(values: jax.Array) -> jax.Array:
        values = jnp.take_along_axis(values.reshape(images, len(geoms), 12), order[:, :, None], axis=1)
        return jnp.pad(values, ((0, 0), (0, padded - len(geoms)), (0, 0)))

    depth, floor = _background(mj_model, poses, eye, axes, half, size)
    flat = (worlds, cameras, len(geoms), 9)
    return Views(
        near=sorted_(near, FAR),
        rectangle=sorted_(sides, 255),  # first column 255: no tile
        pose=sorted_rows(jnp.concatenate([forth.reshape(flat), start], -1)),
        back=sorted_rows(jnp.concatenate([back.reshape(flat), offset], -1)),
        mesh=sorted_(jnp.asarray(meshes, jnp.int32), 0),
        octant=sorted_(octant.astype(jnp.int32), 0),
        ids=sorted_(jnp.asarray(geoms, jnp.int32), 0),
        depth=depth.reshape(images, -1),
        floor=floor.reshape(images, -1),
    )


def _rectangles(middle: jax.Array, radius: jax.Array, half: float, size: int) -> tuple[jax.Array, jax.Array]:
    """Return the packed rectangles of pixels that spheres cover, and the mask of those that cover a pixel."""
    ahead = -middle[..., 2]
    square = ahead * ahead - radius * radius
    around = ahead <= radius
    safe = jnp.where(around, 1.0, square)
    bounds = []
    for axis, sign in ((0, 1.0), (1, -1.0)):  # rows count downwards
        along = sign * middle[..., axis]
        root = radius * jnp.sqrt(jnp.maximum(along * along + square, 0.0))
        low, high = (along * ahead - root) / safe, (along * ahead + root) / safe
        first = jnp.ceil((low / half * size + size - 1) / 2 - 1e-3)
        last = jnp.floor((high / half * size + size - 1) / 2 + 1e-3)
        bounds += [jnp.where(around, 0, first), jnp.where(around, size - 1, last)]
    seen = (bounds[0] <= bounds[1]) & (bounds[2] <= bounds[3])
    seen &= (bounds[1] >= 0) & (bounds[0] < size) & (bounds[3] >= 0) & (bounds[2] < size) & (ahead > -radius)
    packed = jnp.zeros(middle.shape[:-1], jnp.int32)
    for place, bound in enumerate(bounds):
        packed |= jnp.clip(bound, 0, size - 1).astype(jnp.int32) << 8 * place
    return jnp.where(seen, packed, 255), seen


def _background(
    mj_model: mujoco.MjModel, poses: dict[str, jax.Array], eye: jax.Array, axes: jax.Array, half: float, size: int
) -> tuple[jax.Array, jax.Array]:
    """Return depth (m) and geom of the floor or the far plane, [W, C, P]."""
    unit = jnp.asarray((2.0 * np.arange(size) + 1.0 - size) / size * half, jnp.float32)
    v, u = jnp.meshgrid(-unit, unit, indexing="ij")
    direction = jnp.stack([u.ravel(), v.ravel(), jnp.full(size * size, -1.0)], -1)  # [P, 3]
    worlds, cameras = eye.shape[:2]
    depth = jnp.full((worlds, cameras, size * size), mj_model.vis.map.zfar * mj_model.stat.extent, jnp.float32)
    floor = jnp.full(depth.shape, -1, jnp.int32)
    for geom in np.flatnonzero(mj_model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        turn = poses["geom_xmat"][:, geom].reshape(worlds, 1, 1, 3, 3)
        to_plane = _product(_transposed(turn), axes)
        start = _times(_transposed(turn), eye - poses["geom_xpos"][:, geom][:, None, None])
        ray = _times(to_plane, direction)
        t = -start[..., 2] / jnp.where(ray[..., 2] < 0.0, ray[..., 2], -1e-20)
        inside = (ray[..., 2] < 0.0) & (t < depth)
        for axis in range(2):
            reach = mj_model.geom_size[geom, axis]
            inside &= (reach <= 0) | (jnp.abs(start[..., axis] + t * ray[..., axis]) <= reach)
        depth, floor = jnp.where(inside, t, depth), jnp.where(inside, np.int32(geom), floor)
    return depth, floor


def _transposed(matrix: jax.Array) -> jax.Array:
    return jnp.swapaxes(matrix, -1, -2)


def _times(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Multiply without a matrix product, which a GPU may compute at low precision."""
    return jnp.sum(matrix * vector[..., None, :], -1)


def _product(left: jax.Array, right: jax.Array) -> jax.Array:
    return jnp.sum(left[..., :, :, None] * right[..., None, :, :], -2)


def tile_lists(
    views: Views, size: int, tile: tuple[int, int], most: int, interpret: bool = False
) -> tuple[jax.Array, jax.Array]:
    """List the instances whose rectangles meet a tile, from front to back.

    Args:
        views: The images.
        size: Height and width of the images.
        tile: Rows and columns of a tile, divisors of ``size``.
        most: Length of a list; a longer one is cut.
        interpret: Run without a GPU.

    Returns:
        Places of the instances in ``views``, [I, tiles, most + `CHUNK`] int32, and their numbers [I, tiles] int32, which
        also count those that were cut.
    """
    images, count = views.near.shape
    high, wide = tile
    across, tiles = size // wide, (size // wide) * (size // high)
    outs = [jax.ShapeDtypeStruct((images, tiles, most + CHUNK), jnp.int32), jax.ShapeDtypeStruct((images, tiles), jnp.int32)]

    def kernel(near_ref: Any, rectangle_ref: Any, list_ref: Any, count_ref: Any) -> None:
        tile_index = pl.program_id(0)
        top, left = jax.lax.div(tile_index, np.int32(across)) * high, jax.lax.rem(tile_index, np.int32(across)) * wide
        lane = jax.lax.broadcasted_iota(jnp.int32, (CHUNK,), 0)

        def visible(state: tuple) -> jax.Array:
            place = jnp.minimum(state[0] * CHUNK, count - 1)
            return (state[0] < count // CHUNK) & (near_ref[place] < FAR)

        def test(state: tuple) -> tuple:
            chunk, found = state
            packed = plgpu.load(rectangle_ref.at[chunk * CHUNK + lane])
            first_column, last_column = packed & 255, (packed >> 8) & 255
            first_row, last_row = (packed >> 16) & 255, (packed >> 24) & 255
            meets = (first_column < left + wide) & (last_column >= left) & (first_row < top + high) & (last_row >= top)
            ones = meets.astype(jnp.int32)
            place = found + jnp.cumsum(ones) - 1
            fits = meets & (place < most)
            # Each lane has a place of its own: without a GPU, a masked store writes back what was there.
            plgpu.store(list_ref.at[jnp.where(fits, place, most + lane)], chunk * CHUNK + lane, mask=fits)
            return chunk + 1, found + jnp.sum(ones)

        count_ref[...] = jax.lax.while_loop(visible, test, (jnp.int32(0), jnp.int32(0)))[1]

    return kernel_call(
        kernel,
        out_shape=outs,
        grid=(tiles, images),
        in_specs=[pl.BlockSpec((None, count), lambda _, image: (image, 0))] * 2,
        out_specs=[
            pl.BlockSpec((None, None, most + CHUNK), lambda tile, image: (image, tile, 0)),
            pl.BlockSpec((None, None), lambda tile, image: (image, tile)),
        ],
        compiler_params=plgpu.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name="tile_lists",
    )(views.near, views.rectangle)
