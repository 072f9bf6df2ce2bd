"""Unit shapes: every rendered object in the camera's frame, once per environment.

An affine map of the camera's frame transforms an object to a unit shape (ball, cylinder, cube, square; a mesh keeps metric
units). A ray in the shape's frame is linear in the pixel's (u, v), so only a handful of operations per pixel and object remain.
The maps are stored in a few small tables with one row per object, which other methods of finding the nearest hit can also use.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.render import cords
from jaxrl_vis_envs.render.scene import Scene

PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
HFIELD = int(mujoco.mjtGeom.mjGEOM_HFIELD)
SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
MESH = int(mujoco.mjtGeom.mjGEOM_MESH)

# Distance by which hidden objects are moved behind the camera, metres, so that no ray intersects them and no NaN remains.
_BEHIND = 1e6
# Distance that MuJoCo assigns to planes when sorting, metres.
FAR_AWAY = 1e10
# Minimum half-size, metres: thinner sheets would cause a division by 0 or vanish in float32 rounding.
_MIN_HALF_SIZE = 1e-5


class UnitShapes(NamedTuple):
    """Rendered objects as unit shapes: a point p of the camera's frame is ``origin + axes @ p`` in the shape's frame.

    Attributes:
        origin: [G, 3] float32, position of the camera in the shape's frame.
        axes: [G, 3, 3] float32, rotation from the camera's frame (the identity for untextured spheres), then division by the
            half-sizes: 1/metres, but unitless for meshes and height fields, which are not scaled.
        extra: [G] float32. Sphere: radius in metres. Capsule: half-length over radius. Otherwise unused.
        extra_square: [G] float32. Sphere and capsule: squared radius in square metres. Otherwise unused.
        ball: [G, 4] float32, metres: bounding sphere, centre in the camera's frame and radius. Unused for a mesh.
        distance: [G] float32, metres, distance by which MuJoCo sorts transparent objects; [0] without any.
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
    """Convert every rendered object to a unit shape in the camera's frame.

    Args:
        scene: The scene.
        data: Physics data with ``geom_xpos`` [ngeom, 3] and ``geom_xmat`` [ngeom, 3, 3] or [ngeom, 9], and the same for
            rendered sites.
        camera_position: [3] float32, metres, world.
        camera_rotation: [3, 3] float32, columns are the camera's axes in the world.
        camera_finite: [] bool; if False, nothing is visible.
    """
    position, rotation, size = _objects(scene, data)
    kinds = np.array(scene.object_types)[:, None]
    finite = camera_finite & jnp.all(jnp.isfinite(position), -1) & jnp.all(jnp.isfinite(rotation), (-2, -1))
    finite &= ~_without_area(kinds[:, 0], size)
    position = jnp.where(finite[:, None], position, 0.0)
    rotation = jnp.where(finite[:, None, None], rotation, 0.0)
    # Not matrix products, which accelerators would compute at low precision and CPUs on one core.
    from_camera = position - camera_position
    offset = _sum3(lambda k: from_camera[:, k, None] * camera_rotation[k])  # [G, 3] in the camera's frame
    relative = _sum3(lambda k: rotation[:, k, :, None] * camera_rotation[k])  # [G, shape axis, camera axis]
    offset = jnp.where(finite[:, None], offset, jnp.array([0.0, 0.0, _BEHIND], jnp.float32))
    relative = jnp.where(finite[:, None, None], relative, jnp.eye(3, dtype=jnp.float32))

    half = _half_sizes(kinds, size)
    # An untextured ball is rotationally symmetric: omitting its rotation saves operations in every pixel.
    bare = np.array(scene.atlas.mappings)[:, None] == 0
    relative = jnp.where(((kinds == SPHERE) & bare)[:, :, None], jnp.eye(3, dtype=jnp.float32), relative)
    axes = relative / half[:, :, None]
    origin = -_sum3(lambda k: axes[:, :, k] * offset[:, k, None])
    capsules = kinds[:, 0] == CAPSULE
    # Masked, because sizes that a type does not use may be 0.
    extra = jnp.where(capsules, size[:, 1] / jnp.where(capsules, size[:, 0], 1.0), size[:, 0])
    ball = jnp.concatenate([offset, _radii(kinds[:, 0], size)[:, None]], axis=1)
    distance = _distances(scene, from_camera) if any(scene.transparent) else jnp.zeros(0, jnp.float32)
    return UnitShapes(origin, axes, extra, jnp.square(size[:, 0]), ball, distance)


def _distances(scene: Scene, from_camera: jax.Array) -> jax.Array:
    """Return sorting distances [G] (m), computed exactly as in MuJoCo so that ties agree; planes are at `FAR_AWAY`."""
    # The clamp prevents fused multiply-adds, which would round the three squares differently.
    x, y, z = (jnp.minimum(from_camera[:, axis] * from_camera[:, axis], 1e37) for axis in range(3))
    near = jnp.sqrt(x + y + z) - scene.bound[np.array(scene.object_ids)]
    return jax.lax.stop_gradient(jnp.where(np.array(scene.object_types) == PLANE, FAR_AWAY, near))


def _sum3(term: Callable[[int], jax.Array]) -> jax.Array:
    """Return the sum of the terms 0, 1 and 2."""
    return term(0) + term(1) + term(2)


def _half_sizes(kinds: np.ndarray, size: jax.Array) -> jax.Array:
    """Return the lengths [G, 3] (m) that become 1 in the unit shape's frame."""
    ones = jnp.ones_like(size[:, :1])
    radius = size[:, :1]
    half = jnp.where(kinds == PLANE, jnp.concatenate([size[:, :2], ones], 1), size)
    half = jnp.where((kinds == SPHERE) | (kinds == CAPSULE), jnp.broadcast_to(radius, size.shape), half)
    half = jnp.where(kinds == CYLINDER, jnp.concatenate([radius, radius, size[:, 1:2]], 1), half)
    return jnp.where((kinds == MESH) | (kinds == HFIELD), 1.0, jnp.maximum(half, _MIN_HALF_SIZE))


def _without_area(kinds: np.ndarray, size: jax.Array) -> jax.Array:
    """Return the mask [G] of shapes with half-sizes of 0 that MuJoCo does not render.

    A box, an ellipsoid or a cylinder with one half-size of 0 is a sheet; a capsule without length is not rendered at all.
    """
    zero = size <= 0.0
    none = jnp.where(np.isin(kinds, (SPHERE, CYLINDER)), zero[:, 0], False)
    none = jnp.where(kinds == CAPSULE, zero[:, 0] | zero[:, 1], none)
    return jnp.where(np.isin(kinds, (BOX, ELLIPSOID)), jnp.sum(zero, axis=1) > 1, none)


def _radii(kinds: np.ndarray, size: jax.Array) -> jax.Array:
    """Return the radii [G] (m) of the bounding spheres (for planes, of the finite part)."""
    a, b, c = size[:, 0], size[:, 1], size[:, 2]
    radius = jnp.sqrt(a * a + b * b + c * c)
    radius = jnp.where(kinds == SPHERE, a, radius)
    radius = jnp.where(kinds == CAPSULE, a + b, radius)
    radius = jnp.where(kinds == ELLIPSOID, jnp.maximum(jnp.maximum(a, b), c), radius)
    return jnp.where((kinds == CYLINDER) | (kinds == PLANE), jnp.sqrt(a * a + b * b), radius)


def _objects(scene: Scene, data: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return positions [G, 3] and rotations [G, 3, 3] of the rendered objects in the world, and sizes [G, 3] (m), float32."""
    position = jnp.asarray(data.geom_xpos, jnp.float32)
    rotation = jnp.asarray(data.geom_xmat, jnp.float32).reshape(-1, 3, 3)
    if scene.site_count and any(index >= scene.geom_count for index in scene.object_ids):
        position = jnp.concatenate([position, jnp.asarray(data.site_xpos, jnp.float32)])
        rotation = jnp.concatenate([rotation, jnp.asarray(data.site_xmat, jnp.float32).reshape(-1, 3, 3)])
    ids = np.array(scene.object_ids)
    first = scene.geom_count + scene.site_count
    rows = np.flatnonzero(ids >= first)
    if not len(rows):
        return position[ids], rotation[ids], scene.size[ids]
    # Objects are in descending order except for a reflecting one, so the capsules of each tendon are contiguous.
    cord = cords.capsules(scene, data, tuple(dict.fromkeys((ids[rows] - first).tolist())))
    others = np.where(ids < first, ids, 0)
    width = scene.size[ids[rows], 0]
    size = jnp.stack([width, cord.half, width], axis=1)
    return (
        position[others].at[rows].set(cord.position),
        rotation[others].at[rows].set(cord.rotation),
        scene.size[ids].at[rows].set(size),
    )
