"""Poses of links in scalars (`partial_arithmetic`): points, rotations, and their derivatives with respect to the joints."""

from typing import Any, NamedTuple

import numpy as np

from jaxrl_vis_envs.physics.scalar import dynamics, quaternions
from jaxrl_vis_envs.physics.scalar.dynamics import JointTransform, Pose
from jaxrl_vis_envs.physics.scalar.links import WORLD, Link
from jaxrl_vis_envs.physics.scalar.partial_arithmetic import ZERO, Vector, add, combine, cross, dot, floats, plus, subtract
from jaxrl_vis_envs.physics.scalar.quaternions import Quaternion
from jaxrl_vis_envs.physics.scalar.sparse_algebra import Column

_IDENTITY = Pose(ZERO, tuple(floats(axis) for axis in np.eye(3)))  # type: ignore[arg-type] - three of three


class MocapPose(NamedTuple):
    """Pose of a mocap body in the world, which is constant during a step, and its rotation as a unit quaternion."""

    pose: Pose
    quaternion: Quaternion


def mocap_poses(links: tuple[int, ...], coordinates: Column) -> dict[int, MocapPose]:
    """Return the poses of mocap bodies by link.

    Args:
        links: Links of the mocap bodies (`links.mocap_link`).
        coordinates: Seven scalars per body: position, m, and a quaternion of any norm.
    """
    poses = {}
    for index, link in enumerate(links):
        x, y, z, *quaternion = coordinates[7 * index : 7 * (index + 1)]
        quaternion = quaternions.normalize(quaternion)
        poses[link] = MocapPose(Pose((x, y, z), quaternions.rotation_axes(quaternion)), quaternion)
    return poses


class LinkFrames:
    """Frames of links and joints, expressed in the frame of one link: the base frame.

    Frames of mocap bodies and their descendants are available only if the base is the world. Quaternions are relative to the
    world whatever the base is.

    Args:
        tree: Links of the model, one per joint.
        joints: Transforms of the joints; `quaternion` needs the half turns of those above its link.
        base: Link of the base frame, or `WORLD`; only its descendants have frames.
        mocap: Poses of mocap bodies, by link.
    """

    def __init__(self, tree: list[Link], joints: list[JointTransform], base: int, mocap: dict[int, MocapPose]) -> None:
        self._tree, self._joints = tree, joints
        self._poses = {base: _IDENTITY}
        if base == WORLD:
            self._poses |= {link: body.pose for link, body in mocap.items()}
        for index, (link, joint) in enumerate(zip(tree, joints, strict=True)):
            if link.parent in self._poses and index not in self._poses:
                self._poses[index] = dynamics.child_pose(link, joint, self._poses[link.parent])
        self._moments: dict[int, Vector] = {}
        self._quaternions: dict[int, Quaternion] = {WORLD: quaternions.IDENTITY}
        self._quaternions |= {link: body.quaternion for link, body in mocap.items()}

    def origin_and_axes(self, link: int) -> tuple[Vector, tuple[Vector, Vector, Vector]]:
        """Return origin and axes of a link's frame in the base frame."""
        return self._poses[link].origin, self._poses[link].axes

    def point(self, link: int, position: np.ndarray) -> Vector:
        """Transform a point, ``position`` [3] (m), from the link's frame to the base frame."""
        pose = self._poses[link]
        return add(pose.origin, combine(pose.axes, floats(position)))

    def direction(self, link: int, direction: np.ndarray) -> Vector:
        """Rotate a ``direction`` [3] from the link's frame to the base frame."""
        return combine(self._poses[link].axes, floats(direction))

    def quaternion(self, link: int) -> Quaternion:
        """Return the rotation of a link's frame in the world, a unit quaternion."""
        if link not in self._quaternions:
            own, joint = self._tree[link], self._joints[link]
            quaternion = quaternions.multiply(self.quaternion(own.parent), quaternions.from_matrix(own.rotation))
            if not own.slides:
                quaternion = quaternions.multiply(quaternion, quaternions.about_axis(own.axis, joint.half_turn))
            self._quaternions[link] = quaternion
        return self._quaternions[link]

    def joint_axis(self, joint: int) -> Vector:
        """Return the axis that a joint turns about or slides along, in the base frame."""
        return self._poses[joint].axes[self._tree[joint].axis]

    def point_derivative(self, joint: int, point: Vector) -> Vector:
        """Return the derivative of a ``point`` moved by a joint with respect to that joint, m/rad or m/m; base frame."""
        axis = self.joint_axis(joint)
        return axis if self._tree[joint].slides else cross(axis, subtract(point, self._poses[joint].origin))

    def rotation_derivative(self, joint: int) -> Vector:
        """Return the rotation vector of links moved by a joint per unit of that joint, rad/rad or rad/m; base frame."""
        return ZERO if self._tree[joint].slides else self.joint_axis(joint)

    def derivative_along(self, joint: int, direction: Vector, moment: Vector) -> Any:
        """Return the derivative of a point's position along a direction with respect to a joint that moves it, m/rad or m/m.

        Args:
            joint: Index of the joint.
            direction: Unit vector in the base frame.
            moment: Cross product of the point and the direction.
        """
        link, axis = self._tree[joint], self.joint_axis(joint)
        if link.slides:
            return dot(axis, direction)
        if joint not in self._moments:
            self._moments[joint] = cross(self._poses[joint].origin, axis)
        return plus(dot(axis, moment), dot(self._moments[joint], direction))
