"""GPU search for triangles in one kernel (Pallas with Triton): rays walk bounding volume hierarchies, see `hierarchies`.

One program has one warp and a tile of 32 pixels. Every lane walks on its own the objects that its ray may meet, from front to
back if the rays are those of the camera, and waits for no other lane to finish an object: a step is some nodes, then the
triangles of a leaf for the lanes that have reached one. Objects that may be met from a tile are bits of its words, sorted by
their nearest point, so a lane stops at the first object that lies behind its hit.

The kernel only searches. Depths, normals and colours are computed by the plain renderer from the triangle found.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxrl_vis_envs.compiling.compilation import use_gpu_kernels
from jaxrl_vis_envs.compiling.gpu_kernels import kernel_call
from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.gpu import kernel
from jaxrl_vis_envs.render.model import hierarchies, reading
from jaxrl_vis_envs.render.pixel import blocks, raycast, shapes
from jaxrl_vis_envs.render.pixel.arithmetic import Vector, dot
from jaxrl_vis_envs.render.pixel.prepare import prepare
from jaxrl_vis_envs.render.pixel.triangles import SEAM, Segments, may_meet
from jaxrl_vis_envs.render.scene import Scene

# Tuned on an H100: rows and columns of a tile, nodes that a lane may visit and objects that it may look at in one step.
_TILE = (4, 8)
_LANES = 32
_NODES, _OBJECTS = 4, 2
_COMPILER = plgpu.CompilerParams(num_warps=1, num_stages=1)
# Replaces ray components of 0, by which no finite number may be divided.
_TINY = 1e-20
# Relative error of the depths at which a ray meets the faces of a box: one within a face rounds either way.
_ROUNDING = 1e-6
_PROBE = """
<mujoco>
  <asset><mesh name="m" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset>
  <worldbody><geom type="mesh" mesh="m"/><camera pos="0 0 1"/></worldbody>
</mujoco>
"""


class _Refs(NamedTuple):
    """Memory blocks read by a program. Those of one environment first, then those of the scene; N objects, P pixels.

    Attributes:
        words: [tiles, words], bits of the objects that may be met from a tile.
        order: [N], object of each bit; the following two are in this order, all others in that of the objects.
        near: [N], ray parameter before which no ray meets the object.
        ball: [N, 4], bounding sphere.
        pose: [N, 12], map from the camera's frame to the object's: nine numbers of the axes, and the origin.
        first: [N], first node, in the octant of most rays.
        start: [3, P], rays in the camera's frame.
        direction: [3, P].
        nearest: [P], ray parameter before which no intersection counts.
        farthest: [P], ray parameter from which no intersection counts.
        steps, frame, nodes, maps: See `hierarchies.Hierarchies`.
    """

    words: Any
    order: Any
    near: Any
    ball: Any
    pose: Any
    first: Any
    start: Any
    direction: Any
    nearest: Any
    farthest: Any
    steps: Any
    frame: Any
    nodes: Any
    maps: Any


class _Ray(NamedTuple):
    """Rays in the frames of the objects that they walk: points are ``start + t * direction``. Vectors of [32] float32.

    They meet the face of a box at c cells at ``t = c * inverse - begin``, axis by axis.
    """

    start: Vector
    direction: Vector
    inverse: Vector
    begin: Vector


class _State(NamedTuple):
    """State of the lanes, [32] each.

    Attributes:
        word: Number of the next word of objects.
        left: Bits of the present word's objects that the lane has not looked at.
        node, end: Next node, and the node at which the object is finished.
        walked: Object that is walked.
        ray: The ray in its frame.
        best: Ray parameter of the nearest intersection.
        hit: Its object, -1 for none.
        row: Its row of ``maps``.
    """

    word: jax.Array
    left: jax.Array
    node: jax.Array
    end: jax.Array
    walked: jax.Array
    ray: _Ray
    best: jax.Array
    hit: jax.Array
    row: jax.Array


def can_search(scene: Scene) -> bool:
    """Return True if the kernel searches the scene's triangles on the platform being traced for."""
    return scene.hierarchies is not None and use_gpu_kernels(probe)


def nearest(scene: Scene, unit: shapes.UnitShapes, rays: Rays, interpret: bool = False) -> blocks.Nearest:
    """Return the nearest opaque objects of all pixels, as `blocks.nearest`. Not differentiable.

    Args:
        scene: Scene with triangles.
        unit: Rendered objects.
        rays: [1, H * W], those of all pixels, row by row.
        interpret: Run without a GPU, slowly.
    """
    scene, unit = jax.lax.stop_gradient((scene, unit))
    rays, row = Rays(rays.u[0], rays.v[0]), None
    if kernel.can_search(scene):
        key, row = kernel.nearest_primitives(scene, unit, interpret)
    elif raycast.has_separate_rows(scene):
        key, row = raycast.nearest_row(scene, unit, rays)
    else:
        key = raycast.nearest_key(scene, unit, rays)
    found = nearest_triangle(scene, unit, rays, raycast.decode(scene, key, row)[0], interpret)
    return jax.tree.map(lambda plane: plane[None], blocks.add_triangles(scene, key, row, found))


def nearest_triangle(
    scene: Scene, unit: shapes.UnitShapes, rays: Rays, depth: jax.Array, interpret: bool = False
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Find the nearest triangle of an opaque object in front of ``depth``. Not differentiable.

    Args:
        scene: Scene with triangles.
        unit: Rendered objects.
        rays: [H * W], those of all pixels, row by row.
        depth: [H * W] float32, metres, maximum depth.
        interpret: Run without a GPU, slowly.

    Returns:
        Depth [H * W] float32 of the triangle, or ``depth`` if there is none; its row in `Scene.triangles` and the row of its
        object, [H * W] int32 each, -1 if there is none.
    """
    trees = scene.hierarchies
    assert trees is not None
    middle, radius = _balls(trees, unit)
    near = jnp.maximum(-middle[:, 2] - radius, scene.znear)
    is_solid = jnp.asarray(np.array(scene.transparent) == reading.SOLID)[trees.objects]
    order = jnp.argsort(near)
    meets = _seen_from_tiles(scene, jnp.where(is_solid, radius, np.nan)[order], middle[order])
    start, direction, _ = camera.ray_parts(scene, rays)
    axis = -unit.axes[trees.objects, :, 2] if scene.projection == "orthographic" else _apply(unit.axes[trees.objects], middle)
    refs = _shared_refs(trees, unit, order, axis)._replace(
        words=kernel.pack_bits(meets),
        near=near[order],
        ball=jnp.concatenate([middle, radius[:, None]], axis=1)[order],
        start=_stack(start, depth.shape),
        direction=_stack(direction, depth.shape),
        nearest=jnp.broadcast_to(scene.znear, depth.shape),
        farthest=depth,
    )
    best, hit, row = _walk(scene, refs, any_hit=False, interpret=interpret)
    is_hit = hit >= 0
    row = trees.rows.at[jnp.maximum(row, 0)].get(mode="promise_in_bounds")
    owner = trees.objects.at[jnp.maximum(hit, 0)].get(mode="promise_in_bounds")
    return best, jnp.where(is_hit, row, -1), jnp.where(is_hit, owner, -1)


def blocked(scene: Scene, unit: shapes.UnitShapes, segments: Segments, interpret: bool = False) -> jax.Array:
    """Return True where a segment enters a mesh or a height field, as `triangles.blocked`. Not differentiable.

    Args:
        scene: Scene with triangles.
        unit: Rendered objects.
        segments: [H * W], one for each pixel, row by row.
        interpret: Run without a GPU, slowly.
    """
    scene, unit, segments = jax.lax.stop_gradient((scene, unit, segments))
    trees = scene.hierarchies
    assert trees is not None
    middle, radius = _balls(trees, unit)
    by_tile = jax.tree.map(lambda plane: _cut(scene, plane), segments)
    meets = jax.vmap(may_meet, in_axes=(0, None, None))(by_tile, middle, radius)
    start, direction = jnp.stack(segments.start), jnp.stack(segments.direction)
    shown = segments.farthest > segments.nearest
    common = jnp.sum(jnp.where(shown, direction, 0.0), axis=1)
    order = jnp.arange(len(radius), dtype=jnp.int32)
    refs = _shared_refs(trees, unit, order, _apply(unit.axes[trees.objects], common[None]))._replace(
        words=kernel.pack_bits(meets),
        near=jnp.zeros_like(radius),
        ball=jnp.concatenate([middle, radius[:, None]], axis=1),
        start=start,
        direction=direction,
        nearest=segments.nearest,
        farthest=segments.farthest,
    )
    return _walk(scene, refs, any_hit=True, interpret=interpret)[0] >= 0


def _cut(scene: Scene, plane: jax.Array) -> jax.Array:
    """Cut a plane [H * W] into tiles [tiles, 32], with zeros beyond the image."""
    (high, wide), (down, across) = _TILE, (-(-scene.height // _TILE[0]), -(-scene.width // _TILE[1]))
    plane = plane.reshape(scene.height, scene.width)
    plane = jnp.pad(plane, ((0, down * high - scene.height), (0, across * wide - scene.width)))
    return plane.reshape(down, high, across, wide).swapaxes(1, 2).reshape(down * across, high * wide)


def _balls(trees: hierarchies.Hierarchies, unit: shapes.UnitShapes) -> tuple[jax.Array, jax.Array]:
    """Return centres [N, 3] in the camera's frame and radii [N] of the objects' bounding spheres, m, enlarged by rounding."""
    axes = unit.axes[trees.objects]  # rotations
    middle = jnp.sum(axes * (trees.ball[:, :3] - unit.origin[trees.objects])[:, :, None], axis=1)
    distance = jnp.sqrt(jnp.sum(jnp.square(middle), axis=1))
    return middle, trees.ball[:, 3] * (1.0 + 1e-4) + 1e-6 * (1.0 + distance)


def _apply(axes: jax.Array, vector: jax.Array) -> jax.Array:
    """Multiply matrices [N, 3, 3] and vectors [N, 3]. Not a matrix product, which a GPU may compute at low precision."""
    return jnp.sum(axes * vector[:, None, :], axis=2)


def _stack(vector: Vector, shape: tuple[int, ...]) -> jax.Array:
    """Return three values, numbers or arrays, as one array [3, *shape]."""
    return jnp.stack([jnp.broadcast_to(jnp.asarray(value, jnp.float32), shape) for value in vector])


def _seen_from_tiles(scene: Scene, radius: jax.Array, middle: jax.Array) -> jax.Array:
    """Return the mask [tiles, N] of spheres that the rays of a tile's pixels may meet beyond the near plane.

    Args:
        scene: The scene.
        radius: [N] float32, m; not a number for objects to leave out.
        middle: [N, 3] float32, m, camera's frame.
    """
    sides = camera.sphere_sides(scene, middle, radius)
    middles, pitches = camera.lens(scene)[:2], camera.pixel_pitch(scene)
    ranges = []
    for axis, (count, length) in enumerate(((scene.width, _TILE[1]), (scene.height, _TILE[0]))):
        first = np.arange(0, count, length)
        if axis:
            first = count - length - first  # rows are counted from the top, v from the bottom
        low, high = (first - 0.5 * (count - 1) - 0.01, first + length - 1 - 0.5 * (count - 1) + 0.01)
        low, high = (middles[axis] + jnp.asarray(side, jnp.float32) * pitches[axis] for side in (low, high))
        ranges.append((sides[:, 2 * axis] <= high[:, None]) & (sides[:, 2 * axis + 1] >= low[:, None]))
    across, down = ranges
    in_front = radius - middle[:, 2] > scene.znear
    return (down[:, None] & across[None] & in_front).reshape(down.shape[0] * across.shape[0], -1)


def _shared_refs(trees: hierarchies.Hierarchies, unit: shapes.UnitShapes, order: jax.Array, axis: jax.Array) -> _Refs:
    """Return the memory blocks that all searches need, the others None.

    Args:
        trees: Hierarchies of the scene.
        unit: Rendered objects.
        order: [N] int32, order of the objects.
        axis: [N, 3] float32, direction of most rays in the object's frame.
    """
    octant = jnp.sum(jnp.where(axis < 0.0, np.array([1, 2, 4], np.int32), 0), axis=1, dtype=jnp.int32)
    pose = jnp.concatenate([unit.axes[trees.objects].reshape(-1, 9), unit.origin[trees.objects]], axis=1)
    blocks = dict.fromkeys(_Refs._fields)
    blocks |= dict(order=order.astype(jnp.int32), pose=pose, first=trees.first + octant * trees.steps)
    blocks |= dict(steps=trees.steps, frame=trees.frame, nodes=trees.nodes, maps=trees.maps)
    return _Refs(**blocks)


def _walk(scene: Scene, refs: _Refs, any_hit: bool, interpret: bool) -> list[jax.Array]:
    """Run the kernel; return the planes of `_kernel`, [H * W] each."""
    pixels = scene.height * scene.width
    kinds = [jnp.int32] if any_hit else [jnp.float32, jnp.int32, jnp.int32]
    return kernel_call(
        functools.partial(_kernel, height=scene.height, width=scene.width, any_hit=any_hit),
        out_shape=[jax.ShapeDtypeStruct((pixels,), kind) for kind in kinds],
        grid=(refs.words.shape[0],),
        in_specs=[_whole(array.shape) for array in refs],
        out_specs=[_whole((pixels,)) for _ in kinds],
        compiler_params=_COMPILER,
        interpret=interpret,
        name="find_blocker" if any_hit else "find_triangle",
    )(*refs)


def _whole(shape: tuple[int, ...]) -> pl.BlockSpec:
    """Return a block that gives every program the whole array."""
    return pl.BlockSpec(shape, lambda tile_index: (0,) * len(shape))


def _kernel(*refs: Any, height: int, width: int, any_hit: bool) -> None:
    """Write the ray parameter of each pixel's nearest intersection, its object (-1 for none) and its row of ``maps``.

    With ``any_hit``, write only an object that the ray meets, whichever is found first.
    """
    ins, outs = _Refs(*refs[: len(_Refs._fields)]), refs[len(_Refs._fields) :]
    tile = pl.program_id(0)
    across = np.int32(-(-width // _TILE[1]))
    lane = jax.lax.broadcasted_iota(jnp.int32, (_LANES,), 0)
    row = jax.lax.div(tile, across) * _TILE[0] + jax.lax.div(lane, np.int32(_TILE[1]))
    column = jax.lax.rem(tile, across) * _TILE[1] + jax.lax.rem(lane, np.int32(_TILE[1]))
    inside = (row < height) & (column < width)
    pixel = jnp.where(inside, row * width + column, 0)
    start, direction = (tuple(_gather(ref, inside, axis, pixel) for axis in range(3)) for ref in (ins.start, ins.direction))
    nearest, farthest = _gather(ins.nearest, inside, pixel), _gather(ins.farthest, inside, pixel)
    words = ins.words.shape[1]

    def is_looking(state: _State) -> jax.Array:
        return (state.word < words) | (state.left != 0)

    def going(state: _State) -> jax.Array:
        return _any((state.node < state.end) | is_looking(state))

    def advance(state: _State) -> _State:
        is_idle = (state.node >= state.end) & is_looking(state)
        state = jax.lax.cond(_any(is_idle), lambda: _next_object(ins, tile, start, direction, state), lambda: state)
        state, leaf = _visit_nodes(ins, nearest, state)
        state = jax.lax.cond(_any(leaf >= 0), lambda: _test_leaf(ins, nearest, state, leaf), lambda: state)
        if not any_hit:
            return state
        done = state.hit >= 0
        return state._replace(
            word=jnp.where(done, words, state.word),
            left=jnp.where(done, 0, state.left),
            node=jnp.where(done, state.end, state.node),
        )

    zero, none = jnp.zeros((_LANES,), jnp.float32), jnp.zeros((_LANES,), jnp.int32)
    # A lane without a pixel has nothing to look at.
    word = jnp.where(inside, 0, words)
    begin = _State(word, none, none, none, none, _Ray(*((zero,) * 3,) * 4), farthest, none - 1, none)
    state = jax.lax.while_loop(going, advance, begin)
    results = (state.hit,) if any_hit else (state.best, state.hit, state.row)
    for out, value in zip(outs, results, strict=True):
        plgpu.store(out.at[pixel], value, mask=inside)


def _any(mask: jax.Array) -> jax.Array:
    """Return True if a lane's mask is set, [] bool."""
    return jnp.max(mask.astype(jnp.int32)) > 0


def _gather(ref: Any, mask: jax.Array, *place: Any) -> jax.Array:
    """Load the element at a place of each lane [32] where ``mask`` is set, 0 elsewhere."""
    place = tuple(jnp.broadcast_to(jnp.asarray(index, jnp.int32), mask.shape) for index in place)
    return plgpu.load(ref.at[place], mask=mask, other=0.0 if ref.dtype == jnp.float32 else 0)


def _next_object(refs: _Refs, tile: jax.Array, start: Vector, direction: Vector, state: _State) -> _State:
    """Give idle lanes the next object whose bounding sphere their ray meets in front of its hit, if it is among the next few."""
    words = refs.words.shape[1]
    inverse_square = 1.0 / dot(direction, direction)
    idle, (word, left, walked) = state.node >= state.end, state[:2] + state[4:5]
    fresh = jnp.zeros(idle.shape, bool)
    for _ in range(_OBJECTS):
        looks = idle & ~fresh
        empty = looks & (left == 0) & (word < words)
        left = jnp.where(empty, _gather(refs.words, empty, tile, jnp.where(empty, word, 0)), left)
        word = jnp.where(empty, word + 1, word)
        looks &= left != 0
        place = jnp.where(looks, 32 * word - 1 - jax.lax.clz(left & -left), 0)
        left = jnp.where(looks, left & (left - 1), left)
        is_nearer = _gather(refs.near, looks, place) < state.best
        middle = tuple(_gather(refs.ball, looks, place, axis) - start[axis] for axis in range(3))
        along = dot(middle, direction) * inverse_square
        apart = tuple(m - along * d for m, d in zip(middle, direction, strict=True))
        radius = _gather(refs.ball, looks, place, 3)
        is_ahead = (along > 0.0) | (dot(middle, middle) <= radius * radius)
        takes = looks & is_nearer & is_ahead & (dot(apart, apart) <= radius * radius)
        walked = jnp.where(takes, _gather(refs.order, takes, place), walked)
        fresh |= takes
        # Objects are sorted: all that follow are farther away, too.
        stops = looks & ~is_nearer
        word, left = jnp.where(stops, words, word), jnp.where(stops, 0, left)
    state = state._replace(word=word, left=left, walked=walked)
    return jax.lax.cond(_any(fresh), lambda: _enter(refs, start, direction, state, fresh), lambda: state)


def _enter(refs: _Refs, start: Vector, direction: Vector, state: _State, fresh: jax.Array) -> _State:
    """Move ``fresh`` lanes to the root of the object that they now walk, and their rays to its frame."""
    pose = [_gather(refs.pose, fresh, state.walked, column) for column in range(12)]
    frame = [_gather(refs.frame, fresh, state.walked, column) for column in range(6)]
    axes = [pose[3 * row : 3 * row + 3] for row in range(3)]
    own_direction = camera.multiply(axes, direction)
    own_start = tuple(o + s for o, s in zip(pose[9:], camera.multiply(axes, start), strict=True))
    over = tuple(1.0 / jnp.where(jnp.abs(d) < _TINY, _TINY, d) for d in own_direction)
    inverse = tuple(cell * o for cell, o in zip(frame[3:], over, strict=True))
    begin = tuple((s - low) * o for s, low, o in zip(own_start, frame[:3], over, strict=True))
    ray = jax.tree.map(
        lambda new, old: jnp.where(fresh, new, old), _Ray(own_start, own_direction, inverse, begin), state.ray
    )
    first, steps = (_gather(ref, fresh, state.walked) for ref in (refs.first, refs.steps))
    return state._replace(
        node=jnp.where(fresh, first, state.node), end=jnp.where(fresh, first + steps, state.end), ray=ray
    )


def _visit_nodes(refs: _Refs, nearest: jax.Array, state: _State) -> tuple[_State, jax.Array]:
    """Visit some nodes; return the state and, for lanes that have met a leaf, its first row of ``maps`` [32], -1 for others."""
    node, leaf = state.node, jnp.full((_LANES,), -1, jnp.int32)
    for _ in range(_NODES):
        active = (node < state.end) & (leaf < 0)
        low, high, link = (_gather(refs.nodes, active, jnp.where(active, node, 0), word) for word in range(3))
        meets = active & _meets_box(state, low, high, nearest)
        is_leaf = link < 0
        leaf = jnp.where(meets & is_leaf, -1 - link, leaf)
        # A leaf has no subtree: the next node follows in any case.
        node = jnp.where(active, jnp.where(meets | is_leaf, node + 1, link), node)
    return state._replace(node=node), leaf


def _meets_box(state: _State, low: jax.Array, high: jax.Array, nearest: jax.Array) -> jax.Array:
    """Return True where rays meet the boxes of nodes in front of their hit."""
    enter, leave = nearest, state.best
    for axis in range(3):
        faces = (((corner >> 10 * axis) & hierarchies.CELLS).astype(jnp.float32) for corner in (low, high))
        one, other = (face * state.ray.inverse[axis] - state.ray.begin[axis] for face in faces)
        enter, leave = jnp.maximum(enter, jnp.minimum(one, other)), jnp.minimum(leave, jnp.maximum(one, other))
    return enter <= leave * (1.0 + _ROUNDING)


def _test_leaf(refs: _Refs, nearest: jax.Array, state: _State, leaf: jax.Array) -> _State:
    """Intersect rays with the triangles of leaves, given by their first row of ``maps`` [32], -1 for none."""
    (start, direction), best, hit, row = state.ray[:2], state.best, state.hit, state.row
    for number in range(hierarchies.LEAF):
        place = jnp.where(leaf >= 0, leaf + number, 0)
        numbers = [_gather(refs.maps, leaf >= 0, place, column) for column in range(12)]
        slope = dot(numbers[8:11], direction)
        t = -(dot(numbers[8:11], start) + numbers[11]) / jnp.where(slope < 0.0, slope, -1.0)
        point = tuple(s + t * d for s, d in zip(start, direction, strict=True))
        first, second = (dot(numbers[4 * i : 4 * i + 3], point) + numbers[4 * i + 3] for i in range(2))
        margin = jnp.minimum(jnp.minimum(first, second), 1.0 - first - second)
        # Of two objects at the same depth, the one listed first is visible.
        is_nearer = (t < best) | ((t == best) & (state.walked < hit))
        meets = (leaf >= 0) & (slope < 0.0) & (margin >= -SEAM) & (t > nearest) & is_nearer
        best, hit = jnp.where(meets, t, best), jnp.where(meets, state.walked, hit)
        row = jnp.where(meets, place, row)
    return state._replace(best=best, hit=hit, row=row)


def probe() -> None:
    """Compile small instances of both kernels."""
    probe_program().lower().compile()


def probe_program() -> Any:
    """Trace small instances of both kernels (`jax.stages.Traced`)."""
    mj_model = mujoco.MjModel.from_xml_string(_PROBE)
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    scene = Scene.from_mjmodel(mj_model, 0, 8, 8)
    unit = jax.eval_shape(lambda scene: prepare(scene, mj_data), scene).unit  # avoids compilation
    pixels = jax.ShapeDtypeStruct((64,), jnp.float32)

    def search(scene: Scene, unit: shapes.UnitShapes, one: jax.Array) -> Any:
        return nearest_triangle(scene, unit, Rays(one, one), one), blocked(scene, unit, Segments((one,) * 3, (one,) * 3, one, one))

    return jax.jit(search).trace(scene, unit, pixels)
