"""Kinematic trees of one-degree-of-freedom joints as links: each joint carries one link, in a frame with the joint along one
axis.

All of this is constant and computed in double precision before the program runs: a link has the masses of all bodies fixed to
it, and its frame is located at its joint.

Source: Featherstone, "Rigid Body Dynamics Algorithms", chapter 4 (one joint per body; several joints between two bodies have
massless bodies between them).
"""

from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import mjx

WORLD = -1
"""Index of the fixed link. Mocap bodies, which do not move during a step, have indices below it (`mocap_link`)."""
_ROUNDING = 1e-9  # relative to the largest entry: smaller entries are rounding errors of zeros


class Link(NamedTuple):
    """A joint with the bodies fixed to it, in the link's own frame. Arrays are float64.

    Attributes:
        parent: Index of the parent joint, `WORLD`, or a mocap body's link.
        rotation: [3, 3], the frame's axes in the parent's frame with the joint at ``qpos0``.
        position: [3], the frame's origin in the parent's frame, m; with the joint at ``qpos0`` if it slides.
        axis: Index of the frame's axis that the joint turns about or slides along.
        slides: True for a slide joint, False for a hinge.
        mass: Total mass, kg.
        moment: [3], mass times centre of mass, kg m.
        inertia: [3, 3], about the frame's origin, kg m^2.
    """

    parent: int
    rotation: np.ndarray
    position: np.ndarray
    axis: int
    slides: bool
    mass: float
    moment: np.ndarray
    inertia: np.ndarray


class FixedFrame(NamedTuple):
    """A frame fixed to a link.

    Attributes:
        link: Index of the link's joint, `WORLD`, or the link of a mocap body or of the free body (`mocap_link`).
        rotation: [3, 3] float64, axes in the link's frame.
        position: [3] float64, origin in the link's frame, m.
    """

    link: int
    rotation: np.ndarray
    position: np.ndarray


def build_links(model: mjx.Model) -> tuple[list[Link], list[FixedFrame]]:
    """Return the links of a model, one per hinge or slide in the order of the joints, and the frames of its bodies.

    A free body is a link of its own like the mocap bodies, after the last of them.
    """
    tree: list[Link] = []
    frames = [FixedFrame(WORLD, np.eye(3), np.zeros(3))]
    position, rotation = _array(model.body_pos), _rotations(model.body_quat)
    anchor, axes = _array(model.jnt_pos), _array(model.jnt_axis)
    for body in range(1, model.nbody):
        mocap = int(model.body_mocapid[body])
        frame = _compose(frames[model.body_parentid[body]], rotation[body], position[body])
        frame = FixedFrame(mocap_link(mocap), np.eye(3), np.zeros(3)) if mocap >= 0 else frame
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        for joint in range(first, first + count):
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
                frame = FixedFrame(mocap_link(model.nmocap), np.eye(3), np.zeros(3))
                continue
            axis, alignment = _align_axis(axes[joint])
            joint_frame = _compose(frame, alignment, anchor[joint])
            slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
            massless = (0.0, np.zeros(3), np.zeros((3, 3)))
            tree.append(Link(joint_frame.link, joint_frame.rotation, joint_frame.position, axis, bool(slides), *massless))
            frame = FixedFrame(joint, alignment.T, _round_entries(-alignment.T @ anchor[joint]))
        frames.append(frame)
    _add_masses(model, tree, frames)
    return tree, frames


def _add_masses(model: mjx.Model, tree: list[Link], frames: list[FixedFrame]) -> None:
    mass, principal = _array(model.body_mass), _array(model.body_inertia)
    centre, rotation = _array(model.body_ipos), _rotations(model.body_iquat)
    for body in range(1, model.nbody):
        frame = _compose(frames[body], rotation[body], centre[body])
        if frame.link >= 0:
            link = tree[frame.link]
            own = frame.rotation @ np.diag(principal[body]) @ frame.rotation.T
            away = mass[body] * (frame.position @ frame.position * np.eye(3) - np.outer(frame.position, frame.position))
            tree[frame.link] = link._replace(
                mass=link.mass + float(mass[body]),
                moment=_round_entries(link.moment + mass[body] * frame.position),
                inertia=_round_entries(link.inertia + own + away),
            )


def geom_frame(model: mjx.Model, frames: list[FixedFrame], geom: int) -> FixedFrame:
    """Return the frame of a geom relative to its link."""
    rotation = _rotations(model.geom_quat)[geom]
    return _compose(frames[model.geom_bodyid[geom]], rotation, _array(model.geom_pos)[geom])


def mocap_link(index: int) -> int:
    """Convert a mocap index to its link index, or a link index to its mocap index."""
    return WORLD - 1 - index


def ancestor_joints(tree: list[Link], link: int) -> list[int]:
    """Return the joints that move a link, from the root on; none for the world and mocap bodies."""
    joints = []
    while link >= 0:
        joints.append(link)
        link = tree[link].parent
    return joints[::-1]


def _compose(frame: FixedFrame, rotation: np.ndarray, position: np.ndarray) -> FixedFrame:
    return FixedFrame(
        frame.link, _round_entries(frame.rotation @ rotation), _round_entries(frame.position + frame.rotation @ position)
    )


def _align_axis(axis: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the index of the frame axis to align with a joint's ``axis``, and the frame's axes in the body's frame: [3, 3]."""
    axis = axis / np.linalg.norm(axis)
    index = int(np.argmax(np.abs(axis)))
    # The shortest rotation of the frame's axis onto the joint's, or, if they are opposite, half a turn.
    start = np.eye(3)[index]
    if axis[index] < 0:
        half_turn = -np.eye(3)
        half_turn[(index + 1) % 3, (index + 1) % 3] = 1.0
        _, rest = _align_axis(half_turn @ axis)
        return index, _round_entries(half_turn @ rest)
    x, y, z = np.cross(start, axis)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return index, _round_entries(np.eye(3) + skew + skew @ skew / (1.0 + axis[index]))


def _array(numbers: object) -> np.ndarray:
    return np.asarray(numbers, np.float64)


def _rotations(quaternions: object) -> np.ndarray:
    """Return matrices [N, 3, 3] of quaternions [N, 4], renormalized in double precision."""
    matrices = []
    for quaternion in _array(quaternions).reshape(-1, 4):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, quaternion / np.linalg.norm(quaternion))
        matrices.append(_round_entries(matrix.reshape(3, 3)))
    return np.array(matrices)


def _round_entries(array: np.ndarray) -> np.ndarray:
    """Round entries within rounding errors of 0 and, in arrays with entries above 0.5, of whole numbers."""
    array = np.where(np.abs(array) < _ROUNDING * max(np.abs(array).max(), 1e-30), 0.0, array)
    rounded = np.round(array)
    return np.where(np.abs(array - rounded) < _ROUNDING, rounded, array) if np.abs(array).max() > 0.5 else array
