"""Unit quaternions in scalars: four scalars, the real part first. A quaternion and its negative are the same rotation."""

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.physics.scalar.partial_arithmetic import Vector, add, cross, dot, floats, minus, plus, scale, times

Quaternion = tuple[Any, Any, Any, Any]

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)


def multiply(left: Quaternion, right: Quaternion) -> Quaternion:
    """Return the product: the rotation ``right`` followed by ``left``."""
    (real, *parts), (other_real, *other_parts) = left, right
    one, other = (parts[0], parts[1], parts[2]), (other_parts[0], other_parts[1], other_parts[2])
    x, y, z = add(scale(other, real), scale(one, other_real), cross(one, other))
    return minus(times(real, other_real), dot(one, other)), x, y, z


def inverse(quaternion: Quaternion) -> Quaternion:
    """Return the inverse rotation."""
    real, x, y, z = quaternion
    return real, minus(0.0, x), minus(0.0, y), minus(0.0, z)


def normalize(parts: Any) -> Quaternion:
    """Normalise four scalars to a unit quaternion."""
    real, x, y, z = parts
    scaled = 1.0 / jnp.sqrt(plus(*(times(part, part) for part in (real, x, y, z))))
    return times(real, scaled), times(x, scaled), times(y, scaled), times(z, scaled)


def rotation_axes(quaternion: Quaternion) -> tuple[Vector, Vector, Vector]:
    """Return the columns of the rotation matrix: the axes of the rotated frame."""
    real, *parts = quaternion
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


def about_axis(axis: int, half_turn: tuple[Any, Any]) -> Quaternion:
    """Return the rotation about a coordinate axis, from sine and cosine of half its angle."""
    sine, cosine = half_turn
    parts: list[Any] = [0.0] * 3
    parts[axis] = sine
    return cosine, parts[0], parts[1], parts[2]


def from_matrix(matrix: np.ndarray) -> Quaternion:
    """Convert a known rotation matrix [3, 3] to a quaternion; components below 1e-9, which are rounding errors, become 0."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(matrix, np.float64).ravel())
    return floats(np.where(np.abs(quaternion) < 1e-9, 0.0, quaternion))  # type: ignore[return-value] - of four
