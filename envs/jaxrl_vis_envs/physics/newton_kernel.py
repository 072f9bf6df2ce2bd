"""`descent.solve` as one GPU kernel (Pallas, by Triton): a thread solves the problem of one episode, a program those of 32.

All numbers of a problem stay on the chip from its first read to the motion. As XLA operations, a physics step of the finger
is some 850 kernels more, and one of the hand 150, most of which do next to nothing.

Numbers are read and written in a way of their own (`lanes`): Pallas's own takes minutes to compile, for so many.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.physics import descent, lanes
from jaxrl_vis_envs.physics.descent import Motion, Problem, Structure


def solve(structure: Structure, problem: Problem, interpret: bool = False) -> Motion:
    """`descent.solve` for the arrays of a problem, float32; over all axes of `jax.vmap` in one kernel.

    Args:
        structure: Of the problem.
        problem: Its arrays.
        interpret: Run the kernel without a GPU, slowly.
    """
    places = _places(structure)
    parts = [array[tuple(np.array(places[name]).T)] for name, array in problem._asdict().items() if places[name]]
    outputs = len(Motion._fields) * structure.joints
    kernel = lanes.as_kernel("solve_constraints", functools.partial(_solved, structure), outputs, interpret)
    return Motion(*kernel(jnp.concatenate(parts)[None])[0].reshape(len(Motion._fields), structure.joints))


def _places(structure: Structure) -> dict[str, list[tuple[int, ...]]]:
    """For each array of a problem, the places of the numbers that the solver reads, in the order in which it reads them."""
    places: dict[str, list[tuple[int, ...]]] = {name: [] for name in Problem._fields}
    descent.numbers_of(structure, lambda name, *place: places[name].append(place))
    return places


@functools.partial(jax.jit, static_argnums=0)
def _solved(structure: Structure, rows: list[jax.Array]) -> list[Any]:
    """The numbers of a motion, of those of a problem in the order of `_places`.

    Jitted so that it is traced once for all launches, in however many programs they are.
    """
    every_place = [(name, place) for name, places in _places(structure).items() for place in places]
    numbers = dict(zip(every_place, rows, strict=True))
    motion = descent.solve(structure, descent.numbers_of(structure, lambda name, *place: numbers[name, place]))
    return [number for part in motion for number in part]


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
