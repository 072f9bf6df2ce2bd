"""Where links are, number by number (`folding`): poses, quaternions, and how far joints move a point."""

from typing import Any, NamedTuple

import numpy as np

from jaxrl_vis_envs.physics import dynamics, quaternions
from jaxrl_vis_envs.physics.algebra import Numbers
from jaxrl_vis_envs.physics.dynamics import Joint, Pose
from jaxrl_vis_envs.physics.folding import NOTHING, Vector, add, combine, cross, dot, floats, plus, subtract
from jaxrl_vis_envs.physics.links import WORLD, Link
from jaxrl_vis_envs.physics.quaternions import Quaternion

_HERE = Pose(NOTHING, tuple(floats(axis) for axis in np.eye(3)))  # type: ignore[arg-type] - three of three


class Root(NamedTuple):
    """A mocap body, which stands still during a step: its pose in the world, and the quaternion of that."""

    pose: Pose
    turn: Quaternion


def roots_of(used: tuple[int, ...], numbers: Numbers) -> dict[int, Root]:
    """The roots of trees that do not hang on the world.

    Args:
        used: Their links (`links.link_of_mocap`).
        numbers: Seven for each: the position, m, and a quaternion of any length.
    """
    roots = {}
    for index, link in enumerate(used):
        x, y, z, *turn = numbers[7 * index : 7 * (index + 1)]
        turn = quaternions.unit(turn)
        roots[link] = Root(Pose((x, y, z), quaternions.axes_of(turn)), turn)
    return roots


class Places:
    """Where links and joints are, in the frame of one link; for quaternions and what hangs on mocap bodies, in the world."""

    def __init__(self, tree: list[Link], joints: list[Joint], base: int, roots: dict[int, Root]) -> None:
        self._tree, self._joints, self._roots = tree, joints, roots
        self._poses = {base: _HERE}
        if base == WORLD:
            self._poses |= {link: root.pose for link, root in roots.items()}
        for index, (link, joint) in enumerate(zip(tree, joints, strict=True)):
            if link.parent in self._poses and index not in self._poses:
                self._poses[index] = dynamics.pose_after(link, joint, self._poses[link.parent])
        self._moments: dict[int, Vector] = {}
        self._turns: dict[int, Quaternion] = {WORLD: quaternions.WHOLE} | {link: root.turn for link, root in roots.items()}

    def point(self, link: int, shift: np.ndarray) -> Vector:
        """A point of a link, ``shift`` [3] (m) in its frame."""
        pose = self._poses[link]
        return add(pose.origin, combine(pose.axes, floats(shift)))

    def direction(self, link: int, direction: np.ndarray) -> Vector:
        """A ``direction`` [3] in the frame of a link."""
        return combine(self._poses[link].axes, floats(direction))

    def turn(self, link: int) -> Quaternion:
        """The quaternion of a link's frame."""
        if link not in self._turns:
            own, joint = self._tree[link], self._joints[link]
            turn = quaternions.multiply(self.turn(own.parent), quaternions.of_matrix(own.turn))
            if not own.slides:
                turn = quaternions.multiply(turn, quaternions.about(own.axis, joint.half_turn))
            self._turns[link] = turn
        return self._turns[link]

    def axis(self, joint: int) -> Vector:
        """What a joint turns about or slides along."""
        return self._poses[joint].axes[self._tree[joint].axis]

    def travel(self, joint: int, point: Vector) -> Vector:
        """How far a point moves per radian (or m) of a joint."""
        axis = self.axis(joint)
        return axis if self._tree[joint].slides else cross(axis, subtract(point, self._poses[joint].origin))

    def spin(self, joint: int) -> Vector:
        """How far what a joint carries turns per radian (or m) of it."""
        return NOTHING if self._tree[joint].slides else self.axis(joint)

    def lever(self, joint: int, direction: Vector, moment: Vector) -> Any:
        """How far a point moves along a direction per radian (or m) of a joint.

        Args:
            joint: Which joint.
            direction: Of length 1.
            moment: The vector product of the point and the direction.
        """
        link, axis = self._tree[joint], self.axis(joint)
        if link.slides:
            return dot(axis, direction)
        if joint not in self._moments:
            self._moments[joint] = cross(self._poses[joint].origin, axis)
        return plus(dot(axis, moment), dot(self._moments[joint], direction))
