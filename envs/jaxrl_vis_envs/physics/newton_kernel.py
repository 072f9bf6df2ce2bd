"""`descent.solve` as one GPU kernel (Pallas, by Triton): each program solves the problems of a few episodes, one in a lane.

All numbers of a problem stay in registers, or in the processor's own memory, from its first read to the motion. As XLA
operations, a physics step of the finger is 600 kernels and one of the hand 100, most of which do next to nothing.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxrl_vis_envs.physics import descent
from jaxrl_vis_envs.physics.descent import Problem, Structure

# Episodes of a program: as many as a warp has lanes, so that even few episodes occupy many processors.
_LANES = 32
_COMPILER = plgpu.CompilerParams(num_warps=1, num_stages=1)


def solve(structure: Structure, problem: Problem) -> tuple[jax.Array, ...]:
    """The arrays of `descent.Motion` for those of one problem; over the axes of `jax.vmap` in one kernel."""
    motion = _batched(structure, False)(*(array[None] for array in problem))
    return tuple(part[0] for part in motion)


def solve_batch(structure: Structure, problems: Problem, interpret: bool = False) -> tuple[jax.Array, ...]:
    """The arrays of `descent.Motion` [B, N] for arrays of problems with an axis [B] before the others.

    Args:
        structure: Common to all of them.
        problems: Float32.
        interpret: Run the kernel without a GPU, slowly.
    """
    episodes = problems.mass.shape[0]
    # What has no numbers cannot be handed to a kernel, which never reads it.
    used = Problem(*(array if array.size else jnp.zeros((episodes, 1), jnp.float32) for array in problems))
    out = jax.ShapeDtypeStruct((episodes, structure.joints), jnp.float32)
    return tuple(
        pl.pallas_call(
            functools.partial(_kernel, structure=structure, episodes=episodes),
            out_shape=[out] * len(descent.Motion._fields),
            grid=(pl.cdiv(episodes, _LANES),),
            in_specs=[_whole(array) for array in used],
            out_specs=[_whole(out)] * len(descent.Motion._fields),
            compiler_params=_COMPILER,
            interpret=interpret,
            name="solve_constraints",
        )(*used)
    )


def _kernel(*refs: Any, structure: Structure, episodes: int) -> None:
    inputs, outputs = dict(zip(Problem._fields, refs)), refs[len(Problem._fields) :]
    # Lanes beyond the last episode solve that one again, and write the same.
    episode = jnp.minimum(pl.program_id(0) * _LANES + jnp.arange(_LANES), episodes - 1)
    motion = descent.solve(structure, descent.numbers_of(structure, lambda name, *place: inputs[name][(episode, *place)]))
    for ref, part in zip(outputs, motion, strict=True):
        for joint, number in enumerate(part):
            ref[episode, joint] = jnp.broadcast_to(number, (_LANES,)).astype(jnp.float32)


def _whole(array: Any) -> pl.BlockSpec:
    """Every program sees all of it."""
    return pl.BlockSpec(array.shape, lambda program: (0,) * len(array.shape))


@functools.cache
def _batched(structure: Structure, interpret: bool) -> Callable[..., tuple[jax.Array, ...]]:
    """`solve_batch` for a structure; what `jax.vmap` makes of it is another axis of the same batch."""

    @jax.custom_batching.custom_vmap
    def solve_all(*arrays: jax.Array) -> tuple[jax.Array, ...]:
        return solve_batch(structure, Problem(*arrays), interpret)

    @solve_all.def_vmap
    def solve_more(size: int, batched: list[bool], *arrays: jax.Array) -> tuple[tuple[jax.Array, ...], tuple[bool, ...]]:
        whole = [
            array if has_axis else jnp.broadcast_to(array, (size, *array.shape))
            for array, has_axis in zip(arrays, batched, strict=True)
        ]
        episodes = whole[0].shape[1]
        motion = solve_all(*(array.reshape(size * episodes, *array.shape[2:]) for array in whole))
        return tuple(part.reshape(size, episodes, -1) for part in motion), (True,) * len(motion)

    return solve_all


def probe() -> None:
    """Compiles a small instance of the kernel for the device that is the default; raises what that raises."""
    probe_program().lower().compile()


def probe_program() -> Any:
    """A small instance of the kernel, traced (`jax.stages.Traced`): every kind of constraint, warm starts, an exact step."""
    joints, row = 3, (0, 1, 2)
    structure = Structure(
        joints=joints,
        mass=((0, 0), (1, 0), (1, 1), (2, 2)),
        rows=(row, (1,), (0,), row, row, row, row),
        equalities=1,
        frictions=1,
        cones=((4, 3),),
        apart=(3,),
        iterations=1,
        warm=True,
        exact=True,
    )
    shapes = [(joints, joints), *[(joints,)] * 3, (len(structure.rows), joints), *[(len(structure.rows),)] * 3, (1, 6)]
    problem = Problem(*(jnp.ones((_LANES, *shape), jnp.float32) for shape in shapes))
    return jax.jit(functools.partial(solve_batch, structure)).trace(problem)
