"""`descent.solve` as one GPU kernel (Pallas, by Triton): a thread solves the problem of one episode, a program those of 32.

All numbers of a problem stay on the chip from its first read to the motion. As XLA operations, a physics step of the finger
is some 850 kernels more, and one of the hand 150, most of which do next to nothing.

Numbers are read and written in a way of their own (`lanes`): Pallas's own takes minutes to compile, for so many.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxrl_vis_envs.physics import descent, lanes
from jaxrl_vis_envs.physics.descent import Motion, Problem, Structure

_COMPILER = plgpu.CompilerParams(num_warps=1, num_stages=1)


def solve(structure: Structure, problem: Problem, interpret: bool = False) -> Motion:
    """`descent.solve` for the arrays of a problem, float32; over all axes of `jax.vmap` in one kernel.

    Args:
        structure: Of the problem.
        problem: Its arrays.
        interpret: Run the kernel without a GPU, slowly.
    """
    places = _places(structure)
    parts = [array[tuple(np.array(places[name]).T)] for name, array in problem._asdict().items() if places[name]]
    motion = _batched(structure, interpret)(jnp.concatenate(parts)[None])[0]
    return Motion(*motion.reshape(len(Motion._fields), structure.joints))


def _places(structure: Structure) -> dict[str, list[tuple[int, ...]]]:
    """For each array of a problem, the places of the numbers that the solver reads, in the order in which it reads them."""
    places: dict[str, list[tuple[int, ...]]] = {name: [] for name in Problem._fields}
    descent.numbers_of(structure, lambda name, *place: places[name].append(place))
    return places


def _batched(structure: Structure, interpret: bool) -> Callable[[jax.Array], jax.Array]:
    """Motions [B, outputs] of problems [B, inputs], in numbers whose order is that of `_places` and of `Motion`.

    Another axis of `jax.vmap` makes B larger.
    """

    @custom_vmap
    def motions(problems: jax.Array) -> jax.Array:
        return _launch(structure, problems, interpret)

    @motions.def_vmap
    def _(size: int, in_batched: list[bool], problems: jax.Array) -> tuple[jax.Array, bool]:
        del in_batched  # there is one input, so it is batched
        flat = motions(problems.reshape(-1, problems.shape[-1]))
        return flat.reshape(size, -1, flat.shape[-1]), True

    return motions


def _launch(structure: Structure, problems: jax.Array, interpret: bool) -> jax.Array:
    batch = problems.shape[0]
    programs = pl.cdiv(batch, lanes.LANES)
    # Threads beyond the last episode solve that again: zeros would be no problem to solve.
    problems = jnp.pad(problems, ((0, programs * lanes.LANES - batch), (0, 0)), mode="edge")
    motions, _ = pl.pallas_call(
        functools.partial(_kernel, structure=structure, interpret=interpret),
        grid=(programs,),
        out_shape=[
            jax.ShapeDtypeStruct((len(Motion._fields) * structure.joints, programs * lanes.LANES), jnp.float32),
            jax.ShapeDtypeStruct((programs,), jnp.int32),
        ],
        compiler_params=_COMPILER,
        interpret=interpret,
        name="solve_constraints",
    )(problems.T)
    return motions.T[:batch]


def _kernel(problems: Any, motions: Any, done: Any, *, structure: Structure, interpret: bool) -> None:
    program = pl.program_id(0)
    own = pl.ds(program * lanes.LANES, lanes.LANES)
    rows = [problems[row, own] for row in range(problems.shape[0])] if interpret else lanes.read_rows(problems)
    every_place = [(name, place) for name, places in _places(structure).items() for place in places]
    numbers = dict(zip(every_place, rows, strict=True))
    problem = descent.numbers_of(structure, lambda name, *place: numbers[name, place])
    motion = descent.solve(structure, problem)
    results = [jnp.broadcast_to(jnp.asarray(number, jnp.float32), (lanes.LANES,)) for part in motion for number in part]
    if interpret:
        for row, result in enumerate(results):
            motions[row, own] = result
    else:
        done[program] = lanes.write_rows(motions, results)


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
