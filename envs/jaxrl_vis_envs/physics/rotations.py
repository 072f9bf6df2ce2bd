"""Quaternions and frames: the functions of MJX's private module `mujoco.mjx._src.math` that this package uses."""

from mujoco.mjx._src.math import (
    axis_angle_to_quat,
    make_frame,
    normalize,
    normalize_with_norm,
    quat_inv,
    quat_mul,
    quat_to_mat,
    rotate,
)

__all__ = [
    "axis_angle_to_quat",
    "make_frame",
    "normalize",
    "normalize_with_norm",
    "quat_inv",
    "quat_mul",
    "quat_to_mat",
    "rotate",
]
