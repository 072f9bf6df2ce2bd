"""Poses of cameras and lights, from the poses of bodies alone.

`mjx.Data` has no poses of lights, and those of cameras only after `mjx.forward`: what `mjx.kinematics` leaves behind is where
they were at some other time. So the five modes of MuJoCo's cameras and lights are computed here.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

_MODES = mujoco.mjtCamLight
_WORLD = 0
# What MuJoCo takes for no mass, and for no length.
_LEAST = 1e-15
# The rounding of a difference of two places, as a share of how far out they are.
_ROUNDING = 4e-7


class Mount(NamedTuple):
    """Attachment of a camera or a light to a body: a static part of the scene.

    Attributes:
        mode: A value of `mujoco.mjtCamLight`.
        body: Index of the body that it rides on or follows.
        target: Index of the body that it looks at, -1 for none.
    """

    mode: int
    body: int
    target: int

    @property
    def aims(self) -> bool:
        """Returns whether the target decides where it looks."""
        return self.target >= 0 and self.mode in (_MODES.mjCAMLIGHT_TARGETBODY, _MODES.mjCAMLIGHT_TARGETBODYCOM)

    @property
    def posed(self) -> int:
        """The last body whose pose is read; 0 for none, since the world stays where it is."""
        by_mass = self.mode == _MODES.mjCAMLIGHT_TRACKCOM
        target = self.target if self.aims and self.mode == _MODES.mjCAMLIGHT_TARGETBODY else _WORLD
        return max(_WORLD if by_mass else self.body, target)

    @property
    def weighed(self) -> int:
        """The body whose centre of mass is read, that of all that hangs on it too; -1 for none."""
        if self.mode == _MODES.mjCAMLIGHT_TRACKCOM:
            return self.body
        return self.target if self.aims and self.mode == _MODES.mjCAMLIGHT_TARGETBODYCOM else -1


class Bodies(NamedTuple):
    """Masses of a scene's bodies, for mounts that follow centres of mass.

    Attributes:
        mass: [nbody] float32, kg.
        parents: nbody indices, of the body that each one hangs on.
    """

    mass: jax.Array
    parents: tuple[int, ...]


def place(bodies: Bodies, data: Any, mount: Mount, offset: jax.Array) -> tuple[jax.Array, jax.Array | None]:
    """Position of a mount in the world.

    Args:
        bodies: Of the scene.
        data: Has ``xpos`` [nbody, 3], ``xmat`` [nbody, 3, 3] or [nbody, 9], and ``xipos`` [nbody, 3] where something follows
            a centre of mass.
        mount: The mount.
        offset: [3] float32, metres: in the frame of its body, or along the world's axes where it only follows.

    Returns:
        The position [3] float32 in metres, and the rotation [3, 3] of the frame that its orientation is given in, None for the
        world's.
    """
    if mount.mode == _MODES.mjCAMLIGHT_TRACKCOM:
        return centre_of_mass(bodies, data, mount.body) + offset, None
    if mount.body == _WORLD:
        return offset, None
    position = jnp.asarray(data.xpos, jnp.float32)[mount.body]
    if mount.mode == _MODES.mjCAMLIGHT_TRACK:
        return position + offset, None
    rotation = jnp.asarray(data.xmat, jnp.float32).reshape(-1, 3, 3)[mount.body]
    # Written out rather than as a matrix product, which accelerators would do at low precision.
    return position + jnp.sum(rotation * offset, -1), rotation


def target(bodies: Bodies, data: Any, mount: Mount) -> jax.Array:
    """Point that a mount aims at, [3] float32 (m)."""
    if mount.mode == _MODES.mjCAMLIGHT_TARGETBODYCOM:
        return centre_of_mass(bodies, data, mount.target)
    return jnp.zeros(3, jnp.float32) if mount.target == _WORLD else jnp.asarray(data.xpos, jnp.float32)[mount.target]


def centre_of_mass(bodies: Bodies, data: Any, body: int) -> jax.Array:
    """Centre of mass of a body's subtree, [3] float32 (m); without any mass, the body's own."""
    members = np.array(_subtree(bodies.parents, body))
    own = jnp.asarray(data.xipos, jnp.float32)
    mass = bodies.mass[members]
    total = jnp.sum(mass)
    mean = jnp.sum(mass[:, None] * own[members], axis=0) / jnp.where(total < _LEAST, 1.0, total)
    return jnp.where(total < _LEAST, own[body], mean)


def _subtree(parents: tuple[int, ...], body: int) -> list[int]:
    """The body and all that hangs on it. Bodies come after their parents in MuJoCo."""
    members = {body}
    for index in range(body + 1, len(parents)):
        if parents[index] in members:
            members.add(index)
    return sorted(members)


def looking(position: jax.Array, aim: jax.Array) -> jax.Array:
    """Rotation [3, 3] of a camera at ``position`` that looks at ``aim``, upright, as `mj_camlight` has it."""
    back = position - aim
    rounding = _ROUNDING * (jnp.max(jnp.abs(position)) + jnp.max(jnp.abs(aim)))
    z = _unit(back, rounding)
    # Straight up or down nothing says where the right is, and neither does a difference that is nothing but rounding.
    x = _unit(jnp.stack([-back[1], back[0], jnp.zeros_like(back[0])]), rounding)
    y = jnp.stack([z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]])
    return jnp.stack([x, y, z], axis=1)


def _unit(vector: jax.Array, rounding: jax.Array) -> jax.Array:
    """The vector [3] at length 1; where it is no longer than the rounding, along x."""
    square = jnp.sum(vector * vector)
    none = square <= jnp.square(rounding) + _LEAST * _LEAST
    return jnp.where(none, jnp.array([1.0, 0.0, 0.0], jnp.float32), vector / jnp.sqrt(jnp.where(none, 1.0, square)))
