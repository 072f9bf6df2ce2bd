"""Welds of two bodies in scalars (`partial_arithmetic`): residuals and Jacobians.

As in MJX, and unlike C MuJoCo 4, the time derivative of a weld's Jacobian is neglected.

Source: MuJoCo's documentation, "XML Reference", equality/weld, and "Computation", constraint model.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from jaxrl_vis_envs.physics.scalar import links, quaternions
from jaxrl_vis_envs.physics.scalar.link_frames import LinkFrames
from jaxrl_vis_envs.physics.scalar.links import FixedFrame, Link
from jaxrl_vis_envs.physics.scalar.partial_arithmetic import (
    ZERO,
    Vector,
    add,
    combine,
    cross,
    floats,
    plus,
    scale,
    subtract,
    times,
)
from jaxrl_vis_envs.physics.scalar.quaternions import Quaternion
from jaxrl_vis_envs.physics.scalar.sparse_algebra import Column


class Weld(NamedTuple):
    """Constants of a weld. Pairs are ordered: first body, second body.

    Attributes:
        frames: Frames of the bodies.
        quaternions: Rotations to be aligned, relative to the links; the first includes the weld's relative rotation.
        points: [3] each, anchor points that the weld makes coincide, in the links' frames, m.
        torque_scale: Length that converts rotations to displacements, m.
        joints: Joints that move the first body alone, the second alone, and both.
    """

    frames: tuple[FixedFrame, FixedFrame]
    quaternions: tuple[Quaternion, Quaternion]
    points: tuple[np.ndarray, np.ndarray]
    torque_scale: float
    joints: tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]


class WeldResidual(NamedTuple):
    """Violation of a weld.

    Attributes:
        errors: Three position errors, in the world, and the imaginary part of the rotation error's quaternion times
            ``torque_scale``, m.
        entries: Derivative of each error with respect to each joint, m/rad or m/m.
        norm: Norm of the six errors, m.
    """

    errors: Column
    entries: list[dict[int, Any]]
    norm: Any


def build_weld(model: mjx.Model, tree: list[Link], frames: list[FixedFrame], index: int) -> Weld:
    """Return the constants of a model's equality ``index``, a weld of two bodies."""
    bodies = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
    numbers = np.asarray(model.eq_data, np.float64)[index]
    own = frames[bodies[0]], frames[bodies[1]]
    anchors = numbers[3:6], numbers[0:3]
    rotations = [quaternions.from_matrix(frame.rotation) for frame in own]
    chains = [links.ancestor_joints(tree, frame.link) for frame in own]
    alone = [tuple(joint for joint in chain if joint not in other) for chain, other in (chains, chains[::-1])]
    return Weld(
        frames=own,
        quaternions=(quaternions.multiply(rotations[0], floats(numbers[6:10])), rotations[1]),  # type: ignore[arg-type] - of four
        points=(own[0].position + own[0].rotation @ anchors[0], own[1].position + own[1].rotation @ anchors[1]),
        torque_scale=float(numbers[10]),
        joints=(alone[0], alone[1], tuple(joint for joint in chains[0] if joint in chains[1])),
    )


def weld_residual(weld: Weld, frames: LinkFrames) -> WeldResidual:
    """Compute the violation of a weld and its Jacobian."""
    first, second, both = weld.joints
    point_1, point_2 = (frames.point(frame.link, point) for frame, point in zip(weld.frames, weld.points, strict=True))
    gap = subtract(point_1, point_2)
    rotation_1, rotation_2 = (
        quaternions.multiply(frames.quaternion(frame.link), own)
        for frame, own in zip(weld.frames, weld.quaternions, strict=True)
    )
    real, x, y, z = quaternions.multiply(quaternions.inverse(rotation_2), rotation_1)
    rotation_error: Vector = scale((x, y, z), weld.torque_scale)
    errors = [*gap, *rotation_error]

    # The derivative of the quaternion product is half its product with the relative angular velocity. With the quaternion's
    # other sign, error and derivative are both negated, which is the same constraint.
    body = weld.frames[1]
    axes = [frames.direction(body.link, axis) for axis in body.rotation.T]
    rates = []
    for column in range(3):
        within: Vector = (axes[0][column], axes[1][column], axes[2][column])
        rates.append(scale(add(scale(within, real), cross(within, (x, y, z))), 0.5 * weld.torque_scale))
    entries: list[dict[int, Any]] = [{} for _ in range(6)]

    def enter(joint: int, translation: Vector, rotation: Vector) -> None:
        for row, entry in zip(entries, (*translation, *rotation), strict=True):
            if not (isinstance(entry, float) and entry == 0.0):
                row[joint] = entry

    for joint in first:
        enter(joint, frames.point_derivative(joint, point_1), combine(rates, frames.rotation_derivative(joint)))
    for joint in second:
        translation = scale(frames.point_derivative(joint, point_2), -1.0)
        enter(joint, translation, scale(combine(rates, frames.rotation_derivative(joint)), -1.0))
    for joint in both:
        enter(joint, cross(frames.rotation_derivative(joint), gap), ZERO)
    return WeldResidual(errors, entries, jnp.sqrt(plus(*(times(error, error) for error in errors))))
