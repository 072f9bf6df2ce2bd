"""Where the camera stands, and the ray of every pixel.

Everything is drawn in the camera's frame (OpenGL's: x right, y up, looking along -z). A ray is ``t * (u, v, -1)``, so the ray
parameter t is the planar depth in metres, and nothing has to be converted afterwards.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render.scene import Scene


def camera_pose(scene: Scene, data: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Pose of the scene's camera in the world.

    Args:
        scene: The scene.
        data: `mjx.Data`, `mujoco.MjData` or anything with ``cam_xpos`` [ncam, 3] and ``cam_xmat`` [ncam, 3, 3] or [ncam, 9].

    Returns:
        Position [3] float32 in metres, rotation [3, 3] float32 whose columns are the camera's axes, and whether both are finite
        ([] bool). A pose that is not finite comes back as the identity.
    """
    position = jnp.asarray(data.cam_xpos, jnp.float32)[scene.camera_id]
    rotation = jnp.asarray(data.cam_xmat, jnp.float32).reshape(-1, 3, 3)[scene.camera_id]
    finite = jnp.all(jnp.isfinite(position)) & jnp.all(jnp.isfinite(rotation))
    position = jnp.where(finite, position, 0.0)
    rotation = jnp.where(finite, rotation, jnp.eye(3, dtype=jnp.float32))
    return position, rotation, finite


def pixel_rays(scene: Scene) -> tuple[jax.Array, jax.Array]:
    """The u and v of every pixel's ray ``(u, v, -1)`` in the camera's frame, through the middle of the pixel.

    Returns:
        u and v, each [H * W] float32 without unit, row by row from the top left. Flat, because XLA makes one loop over the
        last axis, and a long one vectorises better than a short one.
    """
    columns = (2.0 * np.arange(scene.width) + 1.0 - scene.width) / scene.height
    rows = (scene.height - 1.0 - 2.0 * np.arange(scene.height)) / scene.height
    unit_u = np.broadcast_to(columns[None, :], (scene.height, scene.width)).reshape(-1)
    unit_v = np.broadcast_to(rows[:, None], (scene.height, scene.width)).reshape(-1)
    half_height = jnp.tan(scene.fovy * (np.pi / 360.0))
    return jnp.asarray(unit_u, jnp.float32) * half_height, jnp.asarray(unit_v, jnp.float32) * half_height
