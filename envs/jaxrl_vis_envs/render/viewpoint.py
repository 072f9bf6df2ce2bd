"""Pose and lens of a scene's camera, its intrinsic matrix, and points from depths.

Imported by `scene`, which offers these functions as methods of `Scene`. They take any object with the camera's fields of
`Scene`.

Two frames of the camera occur. The renderer's own is OpenGL's: x right, y up, looking along -z. Matrices and points for users
are in OpenCV's: x right, y down, looking along z.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import mounts

_DEGREES = np.pi / 180.0
# From OpenGL's axes of a camera to OpenCV's.
_FLIP = np.array([1.0, -1.0, -1.0], np.float32)


def camera_pose(scene: Any, data: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute the pose of the scene's camera in the world.

    Args:
        scene: The scene.
        data: `mjx.Data`, `mujoco.MjData` or any object with the body poses that `mounts.mount_position` reads. Unused for a
            camera fixed to the world.

    Returns:
        Position [3] float32 in metres, rotation [3, 3] float32 whose columns are the camera's axes, and a flag ([] bool) that
        both are finite. A non-finite pose is replaced by the identity.
    """
    # Without the barrier, XLA would constant-fold a fixed pose into later operations, which rounds differently.
    fixed = barrier((scene.camera_position, scene.camera_axes))
    bodies = mounts.Bodies(scene.body_mass, scene.body_parents)
    position, frame = mounts.mount_position(bodies, data, scene.camera_mount, fixed[0])
    rotation = fixed[1]
    # Not matrix products, which accelerators would compute at low precision.
    if scene.camera_mount.aims:
        rotation = mounts.look_at(position, mounts.target_position(bodies, data, scene.camera_mount))
    elif frame is not None:
        rotation = jnp.sum(frame[:, :, None] * rotation[None], axis=1)
    position = position + jnp.sum(rotation * scene.camera_shift, axis=1)
    rotation = jnp.sum(rotation[:, :, None] * _rotation(scene.camera_turn)[None], axis=1)
    finite = jnp.all(jnp.isfinite(position)) & jnp.all(jnp.isfinite(rotation))
    position = jnp.where(finite, position, 0.0)
    rotation = jnp.where(finite, rotation, jnp.eye(3, dtype=jnp.float32))
    return position, rotation, finite


@jax.custom_jvp
def barrier(tree: Any) -> Any:
    """Prevent XLA from recomputing values for every use. Differentiable in both modes; JAX 0.11's own barrier is not."""
    return jax.lax.optimization_barrier(tree)


@barrier.defjvp
def _barrier_tangents(primals: tuple, tangents: tuple) -> tuple:
    return barrier(*primals), tangents[0]


def _rotation(vector: jax.Array) -> jax.Array:
    """Convert a rotation vector [3] (rad) to a matrix [3, 3], with the correct gradient at 0."""
    square = jnp.sum(vector * vector)
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    sine = jnp.where(small, 1.0 - square / 6.0, jnp.sin(angle) / angle)
    cosine = jnp.where(small, 0.5, (1.0 - jnp.cos(angle)) / (angle * angle))
    x, y, z = vector[0], vector[1], vector[2]
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    identity = jnp.eye(3, dtype=jnp.float32)
    return identity + sine * cross + cosine * (vector[:, None] * vector[None, :] - square * identity)


def lens(scene: Any) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Compute the image's extent on the plane at depth 1 m (or at any depth, if orthographic).

    Returns:
        Centre u, centre v, half width and half height, each [] float32 (m).
    """
    zero = jnp.zeros((), jnp.float32)
    if scene.projection == "intrinsic":
        middle = scene.principal / scene.focal
        half = 0.5 * scene.sensor / scene.focal
        return middle[0], -middle[1], half[0], half[1]
    half_height = 0.5 * scene.fovy if scene.projection == "orthographic" else jnp.tan(scene.fovy * (0.5 * _DEGREES))
    return zero, zero, half_height * (scene.width / scene.height), half_height


def intrinsic_matrix(scene: Any) -> jax.Array:
    """Compute the intrinsic matrix [3, 3] float32 in OpenCV's convention; see `Scene.intrinsics`."""
    if scene.projection == "orthographic":
        raise ValueError("an orthographic camera has no intrinsic matrix: its pixels do not depend on the depth")
    middle_u, middle_v, half_u, half_v = lens(scene)
    focal_x, focal_y = 0.5 * scene.width / half_u, 0.5 * scene.height / half_v
    centre_x = 0.5 * (scene.width - 1) - middle_u * focal_x
    centre_y = 0.5 * (scene.height - 1) + middle_v * focal_y
    zero, one = jnp.zeros_like(focal_x), jnp.ones_like(focal_x)
    rows = [[focal_x, zero, centre_x], [zero, focal_y, centre_y], [zero, zero, one]]
    return jnp.stack([jnp.stack(row) for row in rows]).astype(jnp.float32)


def extrinsic_matrix(scene: Any, data: Any) -> jax.Array:
    """Compute the transform [4, 4] float32 from the world to the camera's frame; see `Scene.extrinsics`."""
    position, rotation, _ = camera_pose(scene, data)
    rotation = rotation * _FLIP
    # Not a matrix product, which accelerators would compute at low precision.
    shift = -jnp.sum(rotation * position[:, None], axis=0)
    last = jnp.array([[0.0, 0.0, 0.0, 1.0]], jnp.float32)
    return jnp.concatenate([jnp.concatenate([rotation.T, shift[:, None]], axis=1), last])


def depth_points(scene: Any, depth: jax.Array, data: Any = None) -> jax.Array:
    """Compute the point [H, W, 3] float32 of each pixel; see `Scene.points`."""
    shape = (scene.height, scene.width)
    if jnp.shape(depth) != shape:
        raise ValueError(f"depth of one image has the shape {shape}, got {jnp.shape(depth)}; jax.vmap over a batch")
    depth = jnp.asarray(depth, jnp.float32)
    rows, columns = np.indices(shape)
    middle_u, middle_v, half_u, half_v = lens(scene)
    right = middle_u + jnp.asarray((2.0 * columns + 1.0 - scene.width) / scene.width, jnp.float32) * half_u
    up = middle_v + jnp.asarray((scene.height - 1.0 - 2.0 * rows) / scene.height, jnp.float32) * half_v
    spread = 1.0 if scene.projection == "orthographic" else depth
    points = jnp.stack([right * spread, -up * spread, depth], axis=-1)
    if data is None:
        return points
    position, rotation, _ = camera_pose(scene, data)
    return position + jnp.sum((rotation * _FLIP) * points[..., None, :], axis=-1)
