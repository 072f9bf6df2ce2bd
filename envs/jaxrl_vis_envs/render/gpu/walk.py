"""GPU kernel in which rays walk bounding volume hierarchies (Pallas with Triton), see `hierarchies`.

One program has one warp, and several times as many rays as lanes. Every lane traverses on its own the objects that its ray may
meet, in the order of their bits, and waits for no other lane to finish an object: a step visits some nodes, then the triangles
of a leaf for the lanes that have reached one. A lane that has finished its ray takes the next one. The same code runs as plain
JAX, with arrays in the place of memory blocks.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxrl_vis_envs.compiling.gpu_kernels import kernel_call
from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.model import hierarchies
from jaxrl_vis_envs.render.pixel.arithmetic import Vector, dot
from jaxrl_vis_envs.render.pixel.triangles import SEAM

TILE = (4, 8)
"""Rows and columns of a tile. Tuned on an H100, as are the following."""

LANES = 32
"""Lanes of a program, and pixels of a tile."""
RAYS_PER_LANE = 8
"""Rays of a lane, on average: a lane that has finished one takes the program's next."""
# Objects that a lane may look at, and nodes that it may visit, in one step.
_OBJECTS_PER_STEP, _NODES_PER_STEP = 2, 6

_COMPILER = plgpu.CompilerParams(num_warps=1, num_stages=1)
# Replaces ray components of 0, by which no finite number may be divided.
_TINY = 1e-20
# Relative error of the depths at which a ray meets the faces of a box: one within a face rounds either way.
_ROUNDING = 1e-6


class Refs(NamedTuple):
    """Memory blocks read by a program: N objects, and P rays.

    Attributes:
        words: [R, words], rows of bits of objects.
        rows: [K, P], rows of ``words``: a ray may meet the objects whose bits are set in all of its K rows.
        span: [R, 2], number of the first word of a row with a bit set, and of the word after the last one.
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
    rows: Any
    span: Any
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
    """Rays in the frames of the objects that they walk: points are ``start + t * direction``. Vectors of [L] float32.

    They meet the face of a box at c cells at ``t = c * inverse - begin``, axis by axis.
    """

    start: Vector
    direction: Vector
    inverse: Vector
    begin: Vector


class _Task(NamedTuple):
    """Rays of the lanes in the camera's frame, [L] each.

    Attributes:
        ray: Number of the ray, -1 for none.
        rows: Its rows of ``words``.
        start, direction: Vectors.
        nearest: Ray parameter before which no intersection counts.
        words: Number of the word after the last one with a bit of its objects.
    """

    ray: jax.Array
    rows: tuple[jax.Array, ...]
    start: Vector
    direction: Vector
    nearest: jax.Array
    words: jax.Array


class _State(NamedTuple):
    """State of the lanes, [L] each.

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


def traverse_on_gpu(refs: Refs, any_hit: bool, interpret: bool = False) -> list[jax.Array]:
    """Traverse the hierarchies along rays, by the kernel.

    Args:
        refs: Arrays that describe rays and objects.
        any_hit: Find any intersection, not the nearest.
        interpret: Run without a GPU, slowly.

    Returns:
        Planes [P] of each ray: the parameter (float32) of its nearest intersection, the object (int32) that it meets, -1 for
        none, and the row of ``maps`` (int32). With ``any_hit``, only the object.
    """
    kinds = [jnp.int32] if any_hit else [jnp.float32, jnp.int32, jnp.int32]
    count = LANES * RAYS_PER_LANE
    return kernel_call(
        functools.partial(_kernel, any_hit=any_hit),
        out_shape=[jax.ShapeDtypeStruct(refs.nearest.shape, kind) for kind in kinds],
        grid=(-(-refs.nearest.shape[0] // count),),
        in_specs=[_whole(array.shape) for array in refs],
        out_specs=[_whole(refs.nearest.shape) for _ in kinds],
        compiler_params=_COMPILER,
        interpret=interpret,
        name="find_blocker" if any_hit else "find_triangle",
    )(*refs)


def traverse_in_plain_jax(refs: Refs, any_hit: bool) -> list[jax.Array]:
    """Traverse the hierarchies as `traverse_on_gpu` does, along all rays at once. Rays of a call should be few and coherent."""
    return _walk(refs, jnp.arange(refs.nearest.shape[0], dtype=jnp.int32), any_hit)


def _whole(shape: tuple[int, ...]) -> pl.BlockSpec:
    """Return a block that gives every program the whole array."""
    return pl.BlockSpec(shape, lambda program: (0,) * len(shape))


def _kernel(*refs: Any, any_hit: bool) -> None:
    ins, outs = Refs(*refs[: len(Refs._fields)]), refs[len(Refs._fields) :]
    first = pl.program_id(0) * LANES * RAYS_PER_LANE
    end = jnp.minimum(first + LANES * RAYS_PER_LANE, ins.nearest.shape[0])

    def renew(following: jax.Array, task: _Task, state: _State) -> tuple[jax.Array, _Task, _State]:
        """Store what the finished rays have met, and give their lanes the following ones."""
        is_free = ~_is_going(task, state)
        for out, value in zip(outs, _found(state, any_hit), strict=True):
            plgpu.store(out.at[jnp.maximum(task.ray, 0)], value, mask=is_free & (task.ray >= 0))
        rank = jnp.cumsum(is_free.astype(jnp.int32), dtype=jnp.int32)
        ray = following + rank - 1
        following += jnp.max(rank)
        ray = jnp.where(is_free & (ray < end), ray, -1)
        fresh_task, fresh = _begin(ins, ray)
        select = functools.partial(jax.tree.map, lambda new, old: jnp.where(is_free, new, old))
        return following, select(fresh_task, task), select(fresh, state)

    def advance(carry: tuple) -> tuple:
        following, task, state = carry
        is_free = ~_is_going(task, state) & ((task.ray >= 0) | (following == first))
        following, task, state = jax.lax.cond(
            _any(is_free), lambda: renew(following, task, state), lambda: (following, task, state)
        )
        return following, task, _step(ins, task, state, any_hit)

    # The last rays are stored by the renewal in which no ray follows.
    begin = (first, *_begin(ins, jnp.full((LANES,), -1, jnp.int32)))
    jax.lax.while_loop(lambda carry: _any(carry[1].ray >= 0) | (carry[0] == first), advance, begin)


def _walk(refs: Refs, ray: jax.Array, any_hit: bool) -> list[jax.Array]:
    """Traverse the hierarchies along some rays, see `traverse_on_gpu`.

    Args:
        refs: Memory blocks of a kernel, or arrays.
        ray: [L] int32, numbers of the rays.
        any_hit: Find any intersection, not the nearest.
    """
    task, state = _begin(refs, ray)

    def going(state: _State) -> jax.Array:
        return _any(_is_going(task, state))

    state = jax.lax.while_loop(going, lambda state: _step(refs, task, state, any_hit), state)
    return _found(state, any_hit)


def _found(state: _State, any_hit: bool) -> list[jax.Array]:
    """Return what `traverse_on_gpu` returns."""
    return [state.hit] if any_hit else [state.best, state.hit, state.row]


def _begin(refs: Refs, ray: jax.Array) -> tuple[_Task, _State]:
    """Return the state of lanes that begin with rays, valid by their numbers [L], -1 for none."""
    valid = ray >= 0
    place = jnp.maximum(ray, 0)
    rows = tuple(_gather(refs.rows, valid, number, place) for number in range(refs.rows.shape[0]))
    start, direction = (tuple(_gather(ref, valid, axis, place) for axis in range(3)) for ref in (refs.start, refs.direction))
    nearest, farthest = _gather(refs.nearest, valid, place), _gather(refs.farthest, valid, place)
    word, words = (_gather(refs.span, valid, rows[0], side) for side in range(2))
    zero, none = jnp.zeros(ray.shape, jnp.float32), jnp.zeros(ray.shape, jnp.int32)
    state = _State(word, none, none, none, none, _Ray(*((zero,) * 3,) * 4), farthest, none - 1, none)
    return _Task(ray, rows, start, direction, nearest, words), state


def _is_looking(task: _Task, state: _State) -> jax.Array:
    """Return True for lanes that have objects to look at, [L] bool."""
    return (state.word < task.words) | (state.left != 0)


def _is_going(task: _Task, state: _State) -> jax.Array:
    """Return True for lanes that have not finished their ray, [L] bool."""
    return (state.node < state.end) | _is_looking(task, state)


def _step(refs: Refs, task: _Task, state: _State, any_hit: bool) -> _State:
    """Let the lanes look at some objects, visit some nodes, and test the triangles of a leaf."""
    is_idle = (state.node >= state.end) & _is_looking(task, state)
    state = jax.lax.cond(_any(is_idle), lambda: _next_object(refs, task, state), lambda: state)
    state, leaf = _visit_nodes(refs, task.nearest, state)
    state = jax.lax.cond(_any(leaf >= 0), lambda: _test_leaf(refs, task.nearest, state, leaf), lambda: state)
    if not any_hit:
        return state
    done = state.hit >= 0
    return state._replace(
        word=jnp.where(done, task.words, state.word),
        left=jnp.where(done, 0, state.left),
        node=jnp.where(done, state.end, state.node),
    )


def _any(mask: jax.Array) -> jax.Array:
    """Return True if the mask of any lane is set, [] bool."""
    return jnp.max(mask.astype(jnp.int32)) > 0


def _gather(ref: Any, mask: jax.Array, *place: Any) -> jax.Array:
    """Load the element at a place of each lane [L] where ``mask`` is set, 0 elsewhere."""
    place = tuple(jnp.broadcast_to(jnp.asarray(index, jnp.int32), mask.shape) for index in place)
    if isinstance(ref, jax.Array):
        return jnp.where(mask, ref.at[place].get(mode="promise_in_bounds"), 0)
    return plgpu.load(ref.at[place], mask=mask, other=0.0 if ref.dtype == jnp.float32 else 0)


def _gather_four(ref: Any, mask: jax.Array, row: jax.Array, first: int = 0) -> list[jax.Array]:
    """Load four successive columns of a row of each lane [L] where ``mask`` is set, and anything elsewhere.

    Lanes read different lines of a cache, each of which costs a cycle in every load: one load of 16 bytes takes a quarter of
    the cycles of four. The number of columns has to be a multiple of four.
    """
    if isinstance(ref, jax.Array):
        row = jnp.where(mask, row, 0)
        return [_gather(ref, mask, row, first + column) for column in range(4)]
    shape = (*mask.shape, 4)
    column = jax.lax.broadcasted_iota(jnp.int32, shape, 1)
    row, mask = (jnp.broadcast_to(plane[:, None], shape) for plane in (row, mask))
    # Sums of integers, because those with zeros vanish from the program. A lane holds its four columns.
    bits = jax.lax.bitcast_convert_type(plgpu.load(ref.at[(row, first + column)], mask=mask), jnp.int32)
    columns = [jnp.sum(jnp.where(column == number, bits, 0), axis=1, dtype=jnp.int32) for number in range(4)]
    return [jax.lax.bitcast_convert_type(one, ref.dtype) for one in columns]


def _next_object(refs: Refs, task: _Task, state: _State) -> _State:
    """Give idle lanes the next object whose bounding sphere their ray meets in front of its hit, if one of the next few is."""
    start, direction, words = task.start, task.direction, task.words
    inverse_square = 1.0 / dot(direction, direction)
    idle, (word, left, walked) = state.node >= state.end, state[:2] + state[4:5]
    fresh = jnp.zeros(idle.shape, bool)
    for _ in range(_OBJECTS_PER_STEP):
        looks = idle & ~fresh
        empty = looks & (left == 0) & (word < words)
        bits = (_gather(refs.words, empty, row, jnp.where(empty, word, 0)) for row in task.rows)
        left = jnp.where(empty, functools.reduce(jnp.bitwise_and, bits), left)
        word = jnp.where(empty, word + 1, word)
        looks &= left != 0
        place = jnp.where(looks, 32 * word - 1 - jax.lax.clz(left & -left), 0)
        left = jnp.where(looks, left & (left - 1), left)
        is_nearer = _gather(refs.near, looks, place) < state.best
        *centre, radius = _gather_four(refs.ball, looks, place)
        middle = tuple(c - s for c, s in zip(centre, start, strict=True))
        along = dot(middle, direction) * inverse_square
        apart = tuple(m - along * d for m, d in zip(middle, direction, strict=True))
        is_ahead = (along > 0.0) | (dot(middle, middle) <= radius * radius)
        takes = looks & is_nearer & is_ahead & (dot(apart, apart) <= radius * radius)
        walked = jnp.where(takes, _gather(refs.order, takes, place), walked)
        fresh |= takes
        # Objects are sorted: all that follow are farther away, too.
        stops = looks & ~is_nearer
        word, left = jnp.where(stops, words, word), jnp.where(stops, 0, left)
    state = state._replace(word=word, left=left, walked=walked)
    return jax.lax.cond(_any(fresh), lambda: _enter(refs, start, direction, state, fresh), lambda: state)


def _enter(refs: Refs, start: Vector, direction: Vector, state: _State, fresh: jax.Array) -> _State:
    """Move ``fresh`` lanes to the root of the object that they now walk, and their rays to its frame."""
    pose = [number for column in (0, 4, 8) for number in _gather_four(refs.pose, fresh, state.walked, column)]
    frame = [_gather(refs.frame, fresh, state.walked, column) for column in range(6)]
    axes = [pose[3 * row : 3 * row + 3] for row in range(3)]
    own_direction = camera.multiply(axes, direction)
    own_start = tuple(o + s for o, s in zip(pose[9:], camera.multiply(axes, start), strict=True))
    over = tuple(1.0 / jnp.where(jnp.abs(d) < _TINY, _TINY, d) for d in own_direction)
    inverse = tuple(cell * o for cell, o in zip(frame[3:], over, strict=True))
    begin = tuple((s - low) * o for s, low, o in zip(own_start, frame[:3], over, strict=True))
    ray = jax.tree.map(lambda new, old: jnp.where(fresh, new, old), _Ray(own_start, own_direction, inverse, begin), state.ray)
    first, steps = (_gather(ref, fresh, state.walked) for ref in (refs.first, refs.steps))
    return state._replace(node=jnp.where(fresh, first, state.node), end=jnp.where(fresh, first + steps, state.end), ray=ray)


def _visit_nodes(refs: Refs, nearest: jax.Array, state: _State) -> tuple[_State, jax.Array]:
    """Visit some nodes; return the state and the first row of ``maps`` [L] of the leaf that a lane has met, else -1."""
    node, leaf = state.node, jnp.full_like(state.node, -1)
    for _ in range(_NODES_PER_STEP):
        active = (node < state.end) & (leaf < 0)
        low, high, link, _ = _gather_four(refs.nodes, active, node)
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


def _test_leaf(refs: Refs, nearest: jax.Array, state: _State, leaf: jax.Array) -> _State:
    """Return the state after intersecting the ray of each lane with a leaf's triangles.

    ``leaf`` [L] is the leaf's first row in ``maps``, -1 for none.
    """
    (start, direction), best, hit, row = state.ray[:2], state.best, state.hit, state.row
    for number in range(hierarchies.LEAF):
        place = leaf + number
        numbers = tuple(number for column in (0, 4, 8) for number in _gather_four(refs.maps, leaf >= 0, place, column))
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
