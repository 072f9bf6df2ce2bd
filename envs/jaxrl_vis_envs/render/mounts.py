"""Poses of cameras and lights, computed from the poses of bodies alone.

`mjx.Data` contains no light poses, and up-to-date camera poses only after `mjx.forward`: `mjx.kinematics` leaves stale ones.
The five modes of MuJoCo's cameras and lights are therefore computed here.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

_MODES = mujoco.mjtCamLight
_WORLD = 0
# MuJoCo's threshold for zero mass and zero length.
_MIN_VALUE = 1e-15
# Rounding error of a difference of two positions, relative to their distance from the origin.
_ROUNDING = 4e-7


class Mount(NamedTuple):
    """Attachment of a camera or a light to a body, a static part of the scene.

    Attributes:
        mode: A value of `mujoco.mjtCamLight`.
        body: Index of the body that it is fixed to or tracks.
        target: Index of the body that it aims at, -1 for none.
    """

    mode: int
    body: int
    target: int

    @property
    def aims(self) -> bool:
        """True if the mount aims at its target."""
        return self.target >= 0 and self.mode in (_MODES.mjCAMLIGHT_TARGETBODY, _MODES.mjCAMLIGHT_TARGETBODYCOM)

    @property
    def last_posed_body(self) -> int:
        """Highest index of the bodies whose poses are used; 0 if none, since the world does not move."""
        by_mass = self.mode == _MODES.mjCAMLIGHT_TRACKCOM
        target = self.target if self.aims and self.mode == _MODES.mjCAMLIGHT_TARGETBODY else _WORLD
        return max(_WORLD if by_mass else self.body, target)

    @property
    def weighed_body(self) -> int:
        """Index of the body whose subtree's centre of mass is used; -1 if none."""
        if self.mode == _MODES.mjCAMLIGHT_TRACKCOM:
            return self.body
        return self.target if self.aims and self.mode == _MODES.mjCAMLIGHT_TARGETBODYCOM else -1


class Bodies(NamedTuple):
    """Masses of a scene's bodies, for mounts that follow centres of mass.

    Attributes:
        mass: [nbody] float32, kg.
        parents: nbody indices of the parent bodies.
    """

    mass: jax.Array
    parents: tuple[int, ...]


def mount_position(bodies: Bodies, data: Any, mount: Mount, offset: jax.Array) -> tuple[jax.Array, jax.Array | None]:
    """Compute the position of a mount in the world.

    Args:
        bodies: Bodies of the scene.
        data: Physics data with ``xpos`` [nbody, 3], ``xmat`` [nbody, 3, 3] or [nbody, 9], and ``xipos`` [nbody, 3] if something
            follows a centre of mass.
        mount: The mount.
        offset: [3] float32, metres: in the frame of its body, or along the world's axes if it only tracks the body.

    Returns:
        Position [3] float32 in metres, and the rotation [3, 3] of the frame in which its orientation is expressed, or None for
        the world's.
    """
    if mount.mode == _MODES.mjCAMLIGHT_TRACKCOM:
        return centre_of_mass(bodies, data, mount.body) + offset, None
    if mount.body == _WORLD:
        return offset, None
    position = jnp.asarray(data.xpos, jnp.float32)[mount.body]
    if mount.mode == _MODES.mjCAMLIGHT_TRACK:
        return position + offset, None
    rotation = jnp.asarray(data.xmat, jnp.float32).reshape(-1, 3, 3)[mount.body]
    # Not a matrix product, which accelerators would compute at low precision.
    return position + jnp.sum(rotation * offset, -1), rotation


def target_position(bodies: Bodies, data: Any, mount: Mount) -> jax.Array:
    """Compute the point in the world that a mount aims at, [3] float32 (m)."""
    if mount.mode == _MODES.mjCAMLIGHT_TARGETBODYCOM:
        return centre_of_mass(bodies, data, mount.target)
    return jnp.zeros(3, jnp.float32) if mount.target == _WORLD else jnp.asarray(data.xpos, jnp.float32)[mount.target]


def centre_of_mass(bodies: Bodies, data: Any, body: int) -> jax.Array:
    """Compute the centre of mass of a body's subtree, [3] float32 (m), or of the body itself if the subtree has no mass."""
    members = np.array(_subtree(bodies.parents, body))
    own = jnp.asarray(data.xipos, jnp.float32)
    mass = bodies.mass[members]
    total = jnp.sum(mass)
    mean = jnp.sum(mass[:, None] * own[members], axis=0) / jnp.where(total < _MIN_VALUE, 1.0, total)
    return jnp.where(total < _MIN_VALUE, own[body], mean)


def _subtree(parents: tuple[int, ...], body: int) -> list[int]:
    """Return the indices of a body and all its descendants. In MuJoCo, bodies come after their parents."""
    members = {body}
    for index in range(body + 1, len(parents)):
        if parents[index] in members:
            members.add(index)
    return sorted(members)


def look_at(position: jax.Array, aim: jax.Array) -> jax.Array:
    """Compute the rotation [3, 3] of an upright camera at ``position`` that looks at ``aim``, as in `mj_camlight`."""
    back = position - aim
    rounding = _ROUNDING * (jnp.max(jnp.abs(position)) + jnp.max(jnp.abs(aim)))
    z = _unit(back, rounding)
    # The horizontal axis is undetermined for vertical directions and for differences within rounding error.
    x = _unit(jnp.stack([-back[1], back[0], jnp.zeros_like(back[0])]), rounding)
    y = jnp.stack([z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]])
    return jnp.stack([x, y, z], axis=1)


def _unit(vector: jax.Array, rounding: jax.Array) -> jax.Array:
    """Normalise a vector [3]; return the x axis if its norm does not exceed the rounding error."""
    square = jnp.sum(vector * vector)
    none = square <= jnp.square(rounding) + _MIN_VALUE * _MIN_VALUE
    return jnp.where(none, jnp.array([1.0, 0.0, 0.0], jnp.float32), vector / jnp.sqrt(jnp.where(none, 1.0, square)))
