"""`descent.solve` as one GPU kernel (Pallas, by Triton): a thread solves the problem of one episode, a program those of 32.

All numbers of a problem stay on the chip from its first read to the motion. As XLA operations, a physics step of the finger
is some 850 kernels more, and one of the hand 150, most of which do next to nothing.

The numbers of a problem come in one vector, and so does the motion, and the kernel takes the vectors apart and puts them
together itself. The reason is the compiler: before it decides how the threads of a block share a read or a write, it searches
the whole program, which is thousands of operations here. With a read for each number, that takes minutes.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxrl_vis_envs.physics import descent
from jaxrl_vis_envs.physics.descent import Motion, Problem, Structure

_COMPILER = plgpu.CompilerParams(num_warps=1, num_stages=1)
_LANES = 32  # episodes of a program: the threads of a warp


def solve(structure: Structure, problem: Problem, interpret: bool = False) -> Motion:
    """`descent.solve` for the arrays of a problem, float32; over all axes of `jax.vmap` in one kernel.

    Args:
        structure: Of the problem.
        problem: Its arrays.
        interpret: Run the kernel without a GPU, slowly.
    """
    places = _places(structure)
    parts = [array[tuple(np.array(places[name]).T)] for name, array in problem._asdict().items() if places[name]]
    numbers = jnp.concatenate(parts)
    vector = jnp.pad(numbers, (0, pl.next_power_of_2(numbers.size) - numbers.size))

    @custom_vmap
    def motion(vector: jax.Array) -> jax.Array:
        return _batch(structure, vector[None], interpret)[0]

    @motion.def_vmap
    def _(axis_size: int, in_batched: list[bool], vectors: jax.Array) -> tuple[jax.Array, bool]:
        del axis_size, in_batched  # there is one input, so it is batched
        return _batch(structure, vectors, interpret), True

    return Motion(*motion(vector)[: len(Motion._fields) * structure.joints].reshape(-1, structure.joints))


def _places(structure: Structure) -> dict[str, list[tuple[int, ...]]]:
    """For each array of a problem, the places of the numbers that the solver reads, in the order in which it reads them."""
    places: dict[str, list[tuple[int, ...]]] = {name: [] for name in Problem._fields}
    descent.numbers_of(structure, lambda name, *place: places[name].append(place))
    return places


def _batch(structure: Structure, vectors: jax.Array, interpret: bool) -> jax.Array:
    """Motions [B, outputs] of problems [B, inputs], in numbers whose order is that of `_places` and of `Motion`."""
    batch, inputs = vectors.shape
    outputs = pl.next_power_of_2(len(Motion._fields) * structure.joints)
    programs = pl.cdiv(batch, _LANES)
    # Threads beyond the last episode solve it again: zeros would be no problem to solve.
    vectors = jnp.pad(vectors, ((0, programs * _LANES - batch), (0, 0)), mode="edge")
    motions = pl.pallas_call(
        functools.partial(_kernel, structure=structure),
        grid=(programs,),
        in_specs=[pl.BlockSpec((_LANES, inputs), lambda program: (program, 0))],
        out_specs=pl.BlockSpec((_LANES, outputs), lambda program: (program, 0)),
        out_shape=jax.ShapeDtypeStruct((programs * _LANES, outputs), jnp.float32),
        compiler_params=_COMPILER,
        interpret=interpret,
        name="solve_constraints",
    )(vectors)
    return motions[:batch]


def _kernel(vectors: Any, motions: Any, *, structure: Structure) -> None:
    every_place = [(name, place) for name, places in _places(structure).items() for place in places]
    numbers = dict(zip(every_place, _columns(vectors[...])))  # the rest of the columns fills them up to a power of two
    motion = descent.solve(structure, descent.numbers_of(structure, lambda name, *place: numbers[name, place]))
    columns = [jnp.broadcast_to(jnp.asarray(number, jnp.float32), (_LANES,)) for part in motion for number in part]
    nothing = jnp.zeros(_LANES, jnp.float32)
    motions[...] = _from_columns(columns + [nothing] * (motions.shape[1] - len(columns)))


def _columns(matrix: jax.Array) -> list[jax.Array]:
    """The columns of a matrix [rows, a power of two], by the one operation that takes an array apart without memory: halving."""
    parts = [matrix]
    while parts[0].shape[1] > 1:
        parts = [half for part in parts for half in jnp.split(part, 2, axis=1)]
    return [part.reshape(-1) for part in parts]


def _from_columns(columns: list[jax.Array]) -> jax.Array:
    """The reverse of `_columns`."""
    rows = columns[0].shape[0]
    parts = [column.reshape(rows, 1) for column in columns]
    while len(parts) > 1:
        half = len(parts) // 2
        # Only a last axis of 1 can be joined. The first one joined varies most slowly at the end.
        parts = [jnp.concatenate(pair, axis=-1)[..., None] for pair in zip(parts[:half], parts[half:], strict=True)]
    return parts[0].reshape(rows, -1)


def probe() -> None:
    """Compiles a small instance of the kernel for the device that is the default; raises what that raises."""
    probe_program().lower().compile()


def probe_program() -> Any:
    """A small instance of the kernel, traced (`jax.stages.Traced`): every kind of constraint, warm starts, an exact step."""
    structure = Structure(
        joints=2,
        mass=((0, 0), (1, 0), (1, 1)),
        rows=((0, 1), (1,), (0,), (0, 1), (0, 1), (0, 1), (0, 1)),
        equalities=1,
        frictions=1,
        cones=((4, 3),),
        apart=(3,),
        iterations=1,
        warm=True,
        exact=True,
    )
    rows = len(structure.rows)
    shapes = [(2, 2), (2,), (2,), (2,), (rows, 2), (rows,), (rows,), (rows,), (1, 6)]
    problems = Problem(*(jnp.ones((2, *shape), jnp.float32) for shape in shapes))
    return jax.jit(jax.vmap(functools.partial(solve, structure))).trace(problems)
