"""Welds number by number (`folding`): how far two bodies are from being one, and how joints change that.

Source: MuJoCo's documentation, "XML Reference", equality/weld, and "Computation", constraint model; as in MJX, which leaves out
how a weld's Jacobian itself turns.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from jaxrl_vis_envs.physics import links, quaternions
from jaxrl_vis_envs.physics.algebra import Numbers
from jaxrl_vis_envs.physics.folding import Vector, add, combine, cross, floats, plus, scale, subtract, times
from jaxrl_vis_envs.physics.links import Frame, Link
from jaxrl_vis_envs.physics.places import Places
from jaxrl_vis_envs.physics.quaternions import Quaternion


class Weld(NamedTuple):
    """What is known of a weld. Of each pair, the first is of the first body.

    Attributes:
        frames: The bodies.
        turns: Their quaternions relative to their links; the first with the turn of the second body in the weld after it.
        points: [3] each, what is to be in one place, relative to the links, m.
        torque_scale: m, the length by which a turn counts.
        carriers: The joints that move the first body alone, the second alone, and both.
    """

    frames: tuple[Frame, Frame]
    turns: tuple[Quaternion, Quaternion]
    points: tuple[np.ndarray, np.ndarray]
    torque_scale: float
    carriers: tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]


class Apartness(NamedTuple):
    """How far the bodies of a weld are from being one.

    Attributes:
        errors: Six: of the position, in the world, and of half of the turn, m.
        entries: For each, its change per radian (or m) of each joint.
        length: Of all six.
    """

    errors: Numbers
    entries: list[dict[int, Any]]
    length: Any


def weld_of(model: mjx.Model, tree: list[Link], frames: list[Frame], index: int) -> Weld:
    """What is known of a model's equality ``index``, a weld of two bodies."""
    bodies = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
    numbers = np.asarray(model.eq_data, np.float64)[index]
    own = frames[bodies[0]], frames[bodies[1]]
    anchors = numbers[3:6], numbers[0:3]
    turns = [quaternions.of_matrix(frame.turn) for frame in own]
    chains = [links.carriers(tree, frame.link) for frame in own]
    alone = [tuple(joint for joint in these if joint not in others) for these, others in (chains, chains[::-1])]
    return Weld(
        frames=own,
        turns=(quaternions.multiply(turns[0], floats(numbers[6:10])), turns[1]),  # type: ignore[arg-type] - of four
        points=(own[0].shift + own[0].turn @ anchors[0], own[1].shift + own[1].turn @ anchors[1]),
        torque_scale=float(numbers[10]),
        carriers=(alone[0], alone[1], tuple(joint for joint in chains[0] if joint in chains[1])),
    )


def apartness(weld: Weld, places: Places) -> Apartness:
    """How far the bodies of a weld are from being one, where the links are."""
    first, second, both = weld.carriers
    point_1, point_2 = (places.point(frame.link, point) for frame, point in zip(weld.frames, weld.points, strict=True))
    gap = subtract(point_1, point_2)
    turn_1, turn_2 = (
        quaternions.multiply(places.turn(frame.link), turn) for frame, turn in zip(weld.frames, weld.turns, strict=True)
    )
    real, x, y, z = quaternions.multiply(quaternions.inverse(turn_2), turn_1)
    turned: Vector = scale((x, y, z), weld.torque_scale)
    errors = [*gap, *turned]

    # The turn's error is a product of quaternions; it changes by half of the product with the velocity of turning between. With
    # the other sign of a quaternion error and change are the opposite, which is the same constraint.
    body = weld.frames[1]
    axes = [places.direction(body.link, axis) for axis in body.turn.T]
    rates = []
    for column in range(3):
        within: Vector = (axes[0][column], axes[1][column], axes[2][column])
        rates.append(scale(add(scale(within, real), cross(within, (x, y, z))), 0.5 * weld.torque_scale))
    entries: list[dict[int, Any]] = [{} for _ in range(6)]

    def enter(joint: int, moved: Vector, spun: Vector) -> None:
        for row, entry in zip(entries, (*moved, *spun), strict=True):
            if not (isinstance(entry, float) and entry == 0.0):
                row[joint] = entry

    for joint in first:
        enter(joint, places.travel(joint, point_1), combine(rates, places.spin(joint)))
    for joint in second:
        enter(joint, scale(places.travel(joint, point_2), -1.0), scale(combine(rates, places.spin(joint)), -1.0))
    for joint in both:
        enter(joint, cross(places.spin(joint), gap), (0.0, 0.0, 0.0))
    return Apartness(errors, entries, jnp.sqrt(plus(*(times(error, error) for error in errors))))
