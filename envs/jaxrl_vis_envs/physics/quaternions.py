"""Unit quaternions number by number (`folding`): four numbers, the real part first. Either sign is the same turn."""

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.physics.folding import Vector, add, cross, dot, floats, minus, plus, scale, times

Quaternion = tuple[Any, Any, Any, Any]

WHOLE: Quaternion = (1.0, 0.0, 0.0, 0.0)


def multiply(one: Quaternion, other: Quaternion) -> Quaternion:
    """The turn ``other``, and then ``one``."""
    (real, *parts), (other_real, *other_parts) = one, other
    left, right = (parts[0], parts[1], parts[2]), (other_parts[0], other_parts[1], other_parts[2])
    x, y, z = add(scale(right, real), scale(left, other_real), cross(left, right))
    return minus(times(real, other_real), dot(left, right)), x, y, z


def inverse(turn: Quaternion) -> Quaternion:
    """The turn back."""
    real, x, y, z = turn
    return real, minus(0.0, x), minus(0.0, y), minus(0.0, z)


def unit(parts: Any) -> Quaternion:
    """Four numbers, scaled to a length of 1."""
    real, x, y, z = parts
    scaled = 1.0 / jnp.sqrt(plus(*(times(part, part) for part in (real, x, y, z))))
    return times(real, scaled), times(x, scaled), times(y, scaled), times(z, scaled)


def axes_of(turn: Quaternion) -> tuple[Vector, Vector, Vector]:
    """The axes of a frame that is turned so: the columns of the rotation matrix."""
    real, *parts = turn
    twice = [times(2.0, part) for part in parts]
    columns = []
    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        column: list[Any] = [0.0] * 3
        column[axis] = minus(minus(1.0, times(twice[one], parts[one])), times(twice[other], parts[other]))
        column[one] = plus(times(twice[axis], parts[one]), times(twice[other], real))
        column[other] = minus(times(twice[axis], parts[other]), times(twice[one], real))
        columns.append((column[0], column[1], column[2]))
    return columns[0], columns[1], columns[2]


def about(axis: int, half: tuple[Any, Any]) -> Quaternion:
    """A turn about an axis of the frame, of whose half the sine and the cosine are given."""
    sine, cosine = half
    parts: list[Any] = [0.0] * 3
    parts[axis] = sine
    return cosine, parts[0], parts[1], parts[2]


def of_matrix(matrix: np.ndarray) -> Quaternion:
    """A known rotation matrix [3, 3] as a quaternion, with zeros where rounding errors left something."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(matrix, np.float64).ravel())
    return floats(np.where(np.abs(quaternion) < 1e-9, 0.0, quaternion))  # type: ignore[return-value] - of four
