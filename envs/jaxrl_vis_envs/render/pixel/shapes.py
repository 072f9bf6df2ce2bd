"""Once per environment: every drawn object as a unit shape in the camera's frame.

An object is brought to a unit shape (ball, cylinder, cube, square; a mesh keeps its metres) by an affine map of the camera's
frame. What is left per pixel and object is a ray that is linear in the pixel's (u, v), and a handful of operations. All of it
is in a few small tables whose rows are the drawn objects, which any other method of finding the nearest hit needs too.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.render.scene import Scene

PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
HFIELD = int(mujoco.mjtGeom.mjGEOM_HFIELD)
SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
MESH = int(mujoco.mjtGeom.mjGEOM_MESH)

# Objects that are not drawn go this far behind the camera, in metres: no ray meets them, and no NaN is left.
_BEHIND = 1e6
# Metres: where MuJoCo sorts planes to.
FAR_AWAY = 1e10
# Metres: what is thinner is drawn as thin as this, so that a sheet is neither divided by 0 nor lost between two float32.
_THINNEST = 1e-5


class UnitShapes(NamedTuple):
    """The drawn objects as unit shapes: a point p of the camera's frame is ``origin + axes @ p`` in the shape's frame.

    Attributes:
        origin: [G, 3] float32, the camera in the shape's frame.
        axes: [G, 3, 3] float32, 1/metres (rotation from the camera's frame, then division by the half-sizes).
        extra: [G] float32. Sphere: radius in metres. Capsule: half-length over radius. Otherwise unused.
        extra_square: [G] float32. Sphere and capsule: squared radius in square metres. Otherwise unused.
        ball: [G, 4] float32, metres: a ball around the object, middle in the camera's frame and radius. A mesh's is not used.
        distance: [G] float32, metres, from the camera to the ball that MuJoCo sorts transparent objects by; [0] without any.
    """

    origin: jax.Array
    axes: jax.Array
    extra: jax.Array
    extra_square: jax.Array
    ball: jax.Array
    distance: jax.Array


def unit_shapes(
    scene: Scene, data: Any, camera_position: jax.Array, camera_rotation: jax.Array, camera_finite: jax.Array
) -> UnitShapes:
    """Brings every drawn object to a unit shape in the camera's frame.

    Args:
        scene: The scene.
        data: Has ``geom_xpos`` [ngeom, 3] and ``geom_xmat`` [ngeom, 3, 3] or [ngeom, 9], and the same of sites that are drawn.
        camera_position: [3] float32, metres, world.
        camera_rotation: [3, 3] float32, columns are the camera's axes in the world.
        camera_finite: [] bool; where false, nothing is seen.
    """
    position, rotation = _object_poses(scene, data)
    size = scene.size[np.array(scene.object_ids)]
    kinds = np.array(scene.object_types)[:, None]
    finite = camera_finite & jnp.all(jnp.isfinite(position), -1) & jnp.all(jnp.isfinite(rotation), (-2, -1))
    finite &= ~_without_area(kinds[:, 0], size)
    position = jnp.where(finite[:, None], position, 0.0)
    rotation = jnp.where(finite[:, None, None], rotation, 0.0)
    # Written out rather than as matrix products, which accelerators would do at low precision, and a CPU on one core.
    away = position - camera_position
    offset = _added(lambda k: away[:, k, None] * camera_rotation[k])  # [G, 3] in the camera's frame
    relative = _added(lambda k: rotation[:, k, :, None] * camera_rotation[k])  # [G, shape axis, camera axis]
    offset = jnp.where(finite[:, None], offset, jnp.array([0.0, 0.0, _BEHIND], jnp.float32))
    relative = jnp.where(finite[:, None, None], relative, jnp.eye(3, dtype=jnp.float32))

    half = _half_sizes(kinds, size)
    # A ball looks the same from everywhere: leaving its rotation out saves operations in every pixel, unless it has a texture.
    bare = np.array(scene.atlas.mappings)[:, None] == 0
    relative = jnp.where(((kinds == SPHERE) & bare)[:, :, None], jnp.eye(3, dtype=jnp.float32), relative)
    axes = relative / half[:, :, None]
    origin = -_added(lambda k: axes[:, :, k] * offset[:, k, None])
    capsules = kinds[:, 0] == CAPSULE
    # Where: a size that means nothing for a type may be 0.
    extra = jnp.where(capsules, size[:, 1] / jnp.where(capsules, size[:, 0], 1.0), size[:, 0])
    ball = jnp.concatenate([offset, _radii(kinds[:, 0], size)[:, None]], axis=1)
    distance = _distances(scene, away) if any(scene.transparent) else jnp.zeros(0, jnp.float32)
    return UnitShapes(origin, axes, extra, jnp.square(size[:, 0]), ball, distance)


def _distances(scene: Scene, away: jax.Array) -> jax.Array:
    """[G] metres, computed as MuJoCo does it, so that what is equally far for it is so here: planes are all far away."""
    # The bound keeps a compiler from rounding two of the squares once and the third twice.
    x, y, z = (jnp.minimum(away[:, axis] * away[:, axis], 1e37) for axis in range(3))
    near = jnp.sqrt(x + y + z) - scene.bound[np.array(scene.object_ids)]
    return jax.lax.stop_gradient(jnp.where(np.array(scene.object_types) == PLANE, FAR_AWAY, near))


def _added(term: Callable[[int], jax.Array]) -> jax.Array:
    """The sum of the terms 0, 1 and 2."""
    return term(0) + term(1) + term(2)


def _half_sizes(kinds: np.ndarray, size: jax.Array) -> jax.Array:
    """[G, 3] metres that become 1 in the unit shape's frame."""
    ones = jnp.ones_like(size[:, :1])
    radius = size[:, :1]
    half = jnp.where(kinds == PLANE, jnp.concatenate([size[:, :2], ones], 1), size)
    half = jnp.where((kinds == SPHERE) | (kinds == CAPSULE), jnp.broadcast_to(radius, size.shape), half)
    half = jnp.where(kinds == CYLINDER, jnp.concatenate([radius, radius, size[:, 1:2]], 1), half)
    return jnp.where((kinds == MESH) | (kinds == HFIELD), 1.0, jnp.maximum(half, _THINNEST))


def _without_area(kinds: np.ndarray, size: jax.Array) -> jax.Array:
    """[G] bool: which shapes have half-sizes of 0 that leave nothing of them to be seen, as MuJoCo draws them.

    A box, an ellipsoid or a cylinder with one of them is a sheet; a capsule without a length is not drawn at all.
    """
    zero = size <= 0.0
    none = jnp.where(np.isin(kinds, (SPHERE, CYLINDER)), zero[:, 0], False)
    none = jnp.where(kinds == CAPSULE, zero[:, 0] | zero[:, 1], none)
    return jnp.where(np.isin(kinds, (BOX, ELLIPSOID)), jnp.sum(zero, axis=1) > 1, none)


def _radii(kinds: np.ndarray, size: jax.Array) -> jax.Array:
    """[G] metres, of a ball around each shape (planes: around the part that is drawn)."""
    a, b, c = size[:, 0], size[:, 1], size[:, 2]
    radius = jnp.sqrt(a * a + b * b + c * c)
    radius = jnp.where(kinds == SPHERE, a, radius)
    radius = jnp.where(kinds == CAPSULE, a + b, radius)
    radius = jnp.where(kinds == ELLIPSOID, jnp.maximum(jnp.maximum(a, b), c), radius)
    return jnp.where((kinds == CYLINDER) | (kinds == PLANE), jnp.sqrt(a * a + b * b), radius)


def _object_poses(scene: Scene, data: Any) -> tuple[jax.Array, jax.Array]:
    """Positions [G, 3] and rotations [G, 3, 3] of the drawn objects in the world, float32."""
    position = jnp.asarray(data.geom_xpos, jnp.float32)
    rotation = jnp.asarray(data.geom_xmat, jnp.float32).reshape(-1, 3, 3)
    if any(index >= scene.geom_count for index in scene.object_ids):
        position = jnp.concatenate([position, jnp.asarray(data.site_xpos, jnp.float32)])
        rotation = jnp.concatenate([rotation, jnp.asarray(data.site_xmat, jnp.float32).reshape(-1, 3, 3)])
    ids = np.array(scene.object_ids)
    return position[ids], rotation[ids]
