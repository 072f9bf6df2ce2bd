"""The grasping arm of `assets/stalk_arm.xml` among stalks: its dimensions, its model and its closed-form inverse kinematics.

A prismatic joint up and down a mast and two revolute joints (PRR): at every height that the slide has, there are two ways
to a point of the plane, with the elbow to the left or to the right. Joints are ordered (slide, shoulder, elbow); a joint at 0
points at the row, and positive angles turn towards negative x.
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
"""Lengths of the links, m; the forearm's ends between the jaws."""
SHOULDER = (0.0, -MAST_DISTANCE)
"""Where the first revolute joint is, m in the frame of a stand."""
SLIDE_RANGE = (0.4, 1.3)
"""Heights of the slide, m."""
SHOULDER_RANGE, ELBOW_RANGE = 3.3, 2.75
"""Greatest turn of the revolute joints to either side, rad."""
OPENING = 0.04
"""Distance between the inner sides of the open jaws, m."""
JAW_RADIUS = 0.0025
PALM_BACK, PALM, TIPS = -0.028, -0.016, 0.0165
"""Back and front of the palm and tips of the jaws, from the middle of the grip along the forearm, m."""
OUTER_HALF_WIDTH = OPENING / 2 + 2 * JAW_RADIUS
"""From the middle of the open jaws to their outer sides, m."""
FOREARM_RADIUS = 0.011
JAWS = ("left_jaw", "right_jaw")
LINKS = ("palm", "forearm", "upper_arm")
"""Geoms that touch stalks besides the jaws."""
ARM_JOINTS = 3
JOINTS = ARM_JOINTS + len(JAWS)
"""Joints of the arm and its jaws, which come before those of the stalks."""


def build(stalks: int) -> mujoco.MjModel:
    """The model of the arm among stalks, driven by whoever applies forces to its joints."""

    def edit(spec: mujoco.MjSpec) -> None:
        for actuator in list(spec.actuators):
            spec.delete(actuator)
        bending.add_stalks(spec, stalks, JAWS + LINKS)

    return mjx_model.load_model("stalk_arm.xml", edit)


def build_servoed(stalks: int) -> mujoco.MjModel:
    """The model of the arm with open jaws that do not move, driven by position servos, among stalks without knees.

    A mocap body called "wind" holds nothing.
    """

    def edit(spec: mujoco.MjSpec) -> None:
        for jaw in JAWS:
            spec.delete(spec.joint(jaw))
        bending.add_stalks(spec, stalks, JAWS + LINKS, knees=False)
        spec.worldbody.add_body(name="wind", mocap=True)

    return mjx_model.load_model("stalk_arm.xml", edit)


def in_plane(angles: Any, numeric: Any = jnp) -> Any:
    """Where the grip is, from the first joint: [..., 2] m, for ``angles`` [..., 2] of shoulder and elbow, rad."""
    first, both = angles[..., 0], angles[..., 0] + angles[..., 1]
    x = -UPPER_ARM * numeric.sin(first) - FOREARM * numeric.sin(both)
    return numeric.stack([x, UPPER_ARM * numeric.cos(first) + FOREARM * numeric.cos(both)], axis=-1)


def angles_at(place: Any, side: Any, numeric: Any = jnp) -> Any:
    """Angles [..., 2] of shoulder and elbow (rad) that bring the grip to ``place`` [..., 2] (m, from the first joint).

    Args:
        place: Out of reach, the arm points there, stretched or folded.
        side: [...], the sign of the elbow's angle: 1 or -1, the two solutions.
        numeric: `jax.numpy` or `numpy`.
    """
    distance = numeric.linalg.norm(place, axis=-1)
    cosine = (distance**2 - UPPER_ARM**2 - FOREARM**2) / (2 * UPPER_ARM * FOREARM)
    elbow = side * numeric.arccos(numeric.clip(cosine, -1.0, 1.0))
    bearing = numeric.arctan2(-place[..., 0], place[..., 1])
    between = numeric.arctan2(FOREARM * numeric.sin(elbow), UPPER_ARM + FOREARM * numeric.cos(elbow))
    return numeric.stack([bearing - between, elbow], axis=-1)


def joints_at(target: Any, side: Any, numeric: Any = jnp) -> Any:
    """Slide, shoulder and elbow [..., 3] (m, rad, rad) with the grip at ``target`` [..., 3] (m, frame of a stand).

    Args:
        target: Where it should be; for places out of reach see `angles_at`.
        side: [...], the sign of the elbow's angle: 1 or -1, the two solutions.
        numeric: `jax.numpy` or `numpy`.
    """
    place = target[..., :2] - numeric.asarray(SHOULDER, dtype=target.dtype)
    return numeric.concatenate([target[..., 2:], angles_at(place, side, numeric)], axis=-1)


def grip_at(joints: Any, numeric: Any = jnp) -> Any:
    """Where the grip is, [..., 3] m in the frame of a stand, for ``joints`` [..., 3]: the inverse of `joints_at`."""
    place = in_plane(joints[..., 1:3], numeric) + numeric.asarray(SHOULDER, dtype=joints.dtype)
    return numeric.concatenate([place, joints[..., :1]], axis=-1)


def is_within(target: np.ndarray) -> np.ndarray:
    """Whether lengths and joint limits let the grip be at ``target`` [..., 3] (m): [..., 2] bool, for the elbow at 1 and -1."""
    target = np.asarray(target, float)
    distance = np.linalg.norm(target[..., :2] - np.array(SHOULDER), axis=-1)
    in_ring = (distance >= FOREARM - UPPER_ARM) & (distance <= FOREARM + UPPER_ARM)
    in_slide = (target[..., 2] >= SLIDE_RANGE[0]) & (target[..., 2] <= SLIDE_RANGE[1])
    each = []
    for side in (1.0, -1.0):
        angles = joints_at(target, np.full(target.shape[:-1], side), np)[..., 1:]
        in_range = (np.abs(angles[..., 0]) <= SHOULDER_RANGE) & (np.abs(angles[..., 1]) <= ELBOW_RANGE)
        each.append(in_ring & in_slide & in_range)
    return np.stack(each, axis=-1)


def grip_frame(joints: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Unit vectors [..., 2] across the jaws, to the right, and along the forearm, for ``joints`` [..., 3]."""
    turn = joints[..., 1] + joints[..., 2]
    along = jnp.stack([-jnp.sin(turn), jnp.cos(turn)], axis=-1)
    return jnp.stack([along[..., 1], -along[..., 0]], axis=-1), along
