"""`descent.solve` as one GPU kernel (Pallas, by Triton): a program solves the problem of one episode.

All numbers of a problem stay on the chip from its first read to the motion. As XLA operations, a physics step of the finger
is some 850 kernels more, and one of the hand 150, most of which do next to nothing.

Every thread of a program computes the same numbers. Were each of a warp's 32 to take another episode, the kernel would do
with a thirtieth of the instructions, but it is other kernels that take the time, and Triton takes minutes to compile it:
before it decides how the threads of a block share each read, it searches the whole program, which is thousands of operations
here. Numbers that all threads share are no business of that search.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from jaxrl_vis_envs.physics import descent
from jaxrl_vis_envs.physics.descent import Motion, Problem, Structure

_COMPILER = plgpu.CompilerParams(num_warps=1, num_stages=1)


def solve(structure: Structure, problem: Problem, interpret: bool = False) -> Motion:
    """`descent.solve` for the arrays of a problem, float32; over all axes of `jax.vmap` in one kernel.

    Args:
        structure: Of the problem.
        problem: Its arrays.
        interpret: Run the kernel without a GPU, slowly.
    """
    # What has no numbers cannot be handed to a kernel, which never reads it.
    used = Problem(*(array if array.size else jnp.zeros(1, jnp.float32) for array in problem))
    out = jax.ShapeDtypeStruct((structure.joints,), jnp.float32)
    motion = pl.pallas_call(
        functools.partial(_kernel, structure=structure),
        out_shape=[out] * len(Motion._fields),
        compiler_params=_COMPILER,
        interpret=interpret,
        name="solve_constraints",
    )(*used)
    return Motion(*motion)


def _kernel(*refs: Any, structure: Structure) -> None:
    inputs, outputs = dict(zip(Problem._fields, refs)), refs[len(Problem._fields) :]
    motion = descent.solve(structure, descent.numbers_of(structure, lambda name, *place: inputs[name][place]))
    for ref, part in zip(outputs, motion, strict=True):
        for joint, number in enumerate(part):
            ref[joint] = jnp.asarray(number, jnp.float32)


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
