"""The grasping arm of `assets/stalk_arm.xml` among stalks: dimensions, model and closed-form inverse kinematics.

A prismatic joint along a vertical mast and two revolute joints (PRR): at every height of the slide, a point in the plane has
two solutions, with the elbow to the left or to the right. Joints are ordered (slide, shoulder, elbow); a revolute joint at 0
points towards the row, and positive angles turn towards negative x.
"""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.plants import bending
from jaxrl_vis_envs.plants.stand import MAST_DISTANCE

UPPER_ARM, FOREARM = 0.2, 0.5
"""Lengths of the links, m; the forearm ends between the jaws."""
SHOULDER = (0.0, -MAST_DISTANCE)
"""Position of the first revolute joint, m in the frame of a stand."""
SLIDE_RANGE = (0.4, 1.3)
"""Range of heights of the slide, m."""
SHOULDER_RANGE, ELBOW_RANGE = 3.3, 2.75
"""Limits of the revolute joints to either side, rad."""
OPENING = 0.04
"""Distance between the inner surfaces of the open jaws, m."""
JAW_RADIUS = 0.0025
PALM_BACK, PALM, TIPS = -0.028, -0.016, 0.0165
"""Positions of the palm's back and front and the jaws' tips along the forearm, from the middle of the grip, m."""
OUTER_HALF_WIDTH = OPENING / 2 + 2 * JAW_RADIUS
"""Distance from the middle of the open jaws to their outer surfaces, m."""
FOREARM_RADIUS = 0.011
JAWS = ("left_jaw", "right_jaw")
LINKS = ("palm", "forearm", "upper_arm")
"""Geoms besides the jaws that can touch stalks."""
ARM_JOINTS = 3
JOINTS = ARM_JOINTS + len(JAWS)
"""Number of joints of the arm and its jaws, which precede those of the stalks."""


def build(stalks: int) -> mujoco.MjModel:
    """Build the model of the arm among ``stalks`` stalks, without actuators: the caller applies forces to its joints."""

    def edit(spec: mujoco.MjSpec) -> None:
        for actuator in list(spec.actuators):
            spec.delete(actuator)
        bending.add_stalks(spec, stalks, JAWS + LINKS)

    return mjx_model.load_model("stalk_arm.xml", edit)


def build_servoed(stalks: int) -> mujoco.MjModel:
    """Build the model of the arm with fixed, open jaws, driven by position servos, among ``stalks`` stalks without knees.

    The pose of its mocap body "wind" only stores numbers.
    """

    def edit(spec: mujoco.MjSpec) -> None:
        for jaw in JAWS:
            spec.delete(spec.joint(jaw))
        bending.add_stalks(spec, stalks, JAWS + LINKS, knees=False)
        spec.worldbody.add_body(name="wind", mocap=True)

    return mjx_model.load_model("stalk_arm.xml", edit)


def planar_position(angles: Any, xp: Any = jnp) -> Any:
    """Return the position [..., 2] (m) of the grip relative to the first joint, for shoulder and elbow ``angles`` [..., 2],
    rad.
    """
    first, both = angles[..., 0], angles[..., 0] + angles[..., 1]
    x = -UPPER_ARM * xp.sin(first) - FOREARM * xp.sin(both)
    return xp.stack([x, UPPER_ARM * xp.cos(first) + FOREARM * xp.cos(both)], axis=-1)


def angles_at(position: Any, elbow_sign: Any, xp: Any = jnp) -> Any:
    """Return shoulder and elbow angles [..., 2] (rad) that bring the grip to ``position``.

    Args:
        position: [..., 2], m relative to the first joint. If it is out of reach, the arm points at it, stretched or folded.
        elbow_sign: [...], sign of the elbow angle, 1 or -1, which selects one of two solutions.
        xp: `jax.numpy` or `numpy`.
    """
    distance = xp.linalg.norm(position, axis=-1)
    cosine = (distance**2 - UPPER_ARM**2 - FOREARM**2) / (2 * UPPER_ARM * FOREARM)
    elbow = elbow_sign * xp.arccos(xp.clip(cosine, -1.0, 1.0))
    bearing = xp.arctan2(-position[..., 0], position[..., 1])
    between = xp.arctan2(FOREARM * xp.sin(elbow), UPPER_ARM + FOREARM * xp.cos(elbow))
    return xp.stack([bearing - between, elbow], axis=-1)


def joints_at(target: Any, elbow_sign: Any, xp: Any = jnp) -> Any:
    """Return slide, shoulder and elbow positions [..., 3] (m, rad, rad) with the grip at ``target``.

    Args:
        target: [..., 3], m in the frame of a stand; for positions out of reach see `angles_at`.
        elbow_sign: [...], sign of the elbow angle, 1 or -1, which selects one of two solutions.
        xp: `jax.numpy` or `numpy`.
    """
    position = target[..., :2] - xp.asarray(SHOULDER, dtype=target.dtype)
    return xp.concatenate([target[..., 2:], angles_at(position, elbow_sign, xp)], axis=-1)


def grip_at(joints: Any, xp: Any = jnp) -> Any:
    """Return the position [..., 3] (m, frame of a stand) of the grip for ``joints`` [..., 3]: the inverse of `joints_at`."""
    position = planar_position(joints[..., 1:3], xp) + xp.asarray(SHOULDER, dtype=joints.dtype)
    return xp.concatenate([position, joints[..., :1]], axis=-1)


def is_reachable(target: np.ndarray) -> np.ndarray:
    """Check if the grip can reach a position within link lengths and joint limits.

    Args:
        target: [..., 3], m in the frame of a stand.

    Returns:
        [..., 2] bool, for elbow signs 1 and -1.
    """
    target = np.asarray(target, float)
    distance = np.linalg.norm(target[..., :2] - np.array(SHOULDER), axis=-1)
    in_ring = (distance >= FOREARM - UPPER_ARM) & (distance <= FOREARM + UPPER_ARM)
    in_slide = (target[..., 2] >= SLIDE_RANGE[0]) & (target[..., 2] <= SLIDE_RANGE[1])
    by_side = []
    for side in (1.0, -1.0):
        angles = joints_at(target, np.full(target.shape[:-1], side), np)[..., 1:]
        in_range = (np.abs(angles[..., 0]) <= SHOULDER_RANGE) & (np.abs(angles[..., 1]) <= ELBOW_RANGE)
        by_side.append(in_ring & in_slide & in_range)
    return np.stack(by_side, axis=-1)


def grip_frame(joints: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return horizontal unit vectors [..., 2] across the jaws (to the right) and along the forearm, for ``joints`` [..., 3]."""
    turn = joints[..., 1] + joints[..., 2]
    along = jnp.stack([-jnp.sin(turn), jnp.cos(turn)], axis=-1)
    return jnp.stack([along[..., 1], -along[..., 0]], axis=-1), along
