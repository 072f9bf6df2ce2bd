"""A model of joints of one degree of freedom as links: every joint carries one, in a frame of which the joint has one axis.

What is known before the program runs is worked out here, in double precision: a link has the masses of all bodies that move
with it, and its frame stands where its joint is.

Source: Featherstone, "Rigid Body Dynamics Algorithms", chapter 4 (one joint per body; several joints between two bodies have
bodies without mass between them).
"""

from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import mjx

WORLD = -1
"""The link that stands still. Mocap bodies, which stand still during a step, are links below it (`link_of_mocap`)."""
_ROUNDING = 1e-9  # what is smaller, relative to the largest number of its kind, is a zero that was computed


class Link(NamedTuple):
    """What a joint carries, in a frame of its own. Arrays are float64.

    Attributes:
        parent: The joint before it, or `WORLD`, or that of a mocap body.
        turn: [3, 3], its axes in the parent's frame where the joint is at rest (at ``qpos0``).
        shift: [3], its origin in the parent's frame, m; at rest where the joint slides.
        axis: Which of its axes the joint turns about or slides along.
        slides: Whether it slides.
        mass: Of all that is fixed to it, kg.
        moment: [3], mass times centre of mass, kg m.
        inertia: [3, 3], about the frame's origin, kg m^2.
    """

    parent: int
    turn: np.ndarray
    shift: np.ndarray
    axis: int
    slides: bool
    mass: float
    moment: np.ndarray
    inertia: np.ndarray


class Frame(NamedTuple):
    """A pose relative to a link.

    Attributes:
        link: Its joint, or `WORLD`, or that of a mocap body.
        turn: [3, 3] float64, the axes.
        shift: [3] float64, the origin, m.
    """

    link: int
    turn: np.ndarray
    shift: np.ndarray


def links_of(model: mjx.Model) -> tuple[list[Link], list[Frame]]:
    """The links of a model, one for each joint, in the order of the joints, and the frames of its bodies."""
    links: list[Link] = []
    frames = [Frame(WORLD, np.eye(3), np.zeros(3))]
    position, rotation = _array(model.body_pos), _rotations(model.body_quat)
    anchor, axes = _array(model.jnt_pos), _array(model.jnt_axis)
    for body in range(1, model.nbody):
        mocap = int(model.body_mocapid[body])
        frame = _within(frames[model.body_parentid[body]], rotation[body], position[body])
        frame = Frame(link_of_mocap(mocap), np.eye(3), np.zeros(3)) if mocap >= 0 else frame
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        for joint in range(first, first + count):
            axis, towards = _frame_along(axes[joint])
            at = _within(frame, towards, anchor[joint])
            slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
            nothing = (0.0, np.zeros(3), np.zeros((3, 3)))
            links.append(Link(at.link, at.turn, at.shift, axis, bool(slides), *nothing))
            frame = Frame(joint, towards.T, _tidy(-towards.T @ anchor[joint]))
        frames.append(frame)
    _add_masses(model, links, frames)
    return links, frames


def _add_masses(model: mjx.Model, links: list[Link], frames: list[Frame]) -> None:
    mass, principal = _array(model.body_mass), _array(model.body_inertia)
    centre, rotation = _array(model.body_ipos), _rotations(model.body_iquat)
    for body in range(1, model.nbody):
        at = _within(frames[body], rotation[body], centre[body])
        if at.link >= 0:
            link = links[at.link]
            own = at.turn @ np.diag(principal[body]) @ at.turn.T
            away = mass[body] * (at.shift @ at.shift * np.eye(3) - np.outer(at.shift, at.shift))
            links[at.link] = link._replace(
                mass=link.mass + float(mass[body]),
                moment=_tidy(link.moment + mass[body] * at.shift),
                inertia=_tidy(link.inertia + own + away),
            )


def geom_frame(model: mjx.Model, frames: list[Frame], geom: int) -> Frame:
    """The pose of a geom relative to its link."""
    turn = _rotations(model.geom_quat)[geom]
    return _within(frames[model.geom_bodyid[geom]], turn, _array(model.geom_pos)[geom])


def link_of_mocap(mocap: int) -> int:
    """The link that a mocap body is, and the other way round."""
    return WORLD - 1 - mocap


def carriers(links: list[Link], link: int) -> list[int]:
    """The joints that move a link, from the world on; none for the world and mocap bodies."""
    found = []
    while link >= 0:
        found.append(link)
        link = links[link].parent
    return found[::-1]


def _within(frame: Frame, turn: np.ndarray, shift: np.ndarray) -> Frame:
    return Frame(frame.link, _tidy(frame.turn @ turn), _tidy(frame.shift + frame.turn @ shift))


def _frame_along(axis: np.ndarray) -> tuple[int, np.ndarray]:
    """The axis of a frame that a joint's ``axis`` becomes, and that frame's axes in those of the body: [3, 3]."""
    axis = axis / np.linalg.norm(axis)
    index = int(np.argmax(np.abs(axis)))
    # The shortest turn that takes the frame's axis there, or, where that is its opposite, half a turn.
    start = np.eye(3)[index]
    if axis[index] < 0:
        half_turn = -np.eye(3)
        half_turn[(index + 1) % 3, (index + 1) % 3] = 1.0
        _, rest = _frame_along(half_turn @ axis)
        return index, _tidy(half_turn @ rest)
    x, y, z = np.cross(start, axis)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return index, _tidy(np.eye(3) + skew + skew @ skew / (1.0 + axis[index]))


def _array(numbers: object) -> np.ndarray:
    return np.asarray(numbers, np.float64)


def _rotations(quaternions: object) -> np.ndarray:
    """Matrices [N, 3, 3] of quaternions [N, 4], which float32 has left a little off their length."""
    matrices = []
    for quaternion in _array(quaternions).reshape(-1, 4):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, quaternion / np.linalg.norm(quaternion))
        matrices.append(_tidy(matrix.reshape(3, 3)))
    return np.array(matrices)


def _tidy(array: np.ndarray) -> np.ndarray:
    """The same with zeros, and in rotations ones, where rounding errors have left something else."""
    array = np.where(np.abs(array) < _ROUNDING * max(np.abs(array).max(), 1e-30), 0.0, array)
    whole = np.round(array)
    return np.where(np.abs(array - whole) < _ROUNDING, whole, array) if np.abs(array).max() > 0.5 else array
