"""Where the camera stands, and the ray of every pixel.

Everything is drawn in the camera's frame (OpenGL's: x right, y up, looking along -z). A ray is ``start + t * direction`` with a
direction whose z is -1, so the ray parameter t is the planar depth in metres, and nothing has to be converted afterwards. With
perspective the start is 0 and the direction (u, v, -1); an orthographic camera has the start (u, v, 0) and the direction
(0, 0, -1).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import mounts
from jaxrl_vis_envs.render.scene import Scene

_DEGREES = np.pi / 180.0


class Rays(NamedTuple):
    """The rays of pixels: where they meet the plane at depth 1 m (any depth, if orthographic). Float32 arrays of one shape.

    Attributes:
        u: Metres to the right of the camera's axis.
        v: Metres above it.
    """

    u: jax.Array
    v: jax.Array


def camera_pose(scene: Scene, data: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Pose of the scene's camera in the world.

    Args:
        scene: The scene.
        data: `mjx.Data`, `mujoco.MjData` or anything with the poses of bodies that `mounts.place` reads. A camera that is fixed
            to the world needs none.

    Returns:
        Position [3] float32 in metres, rotation [3, 3] float32 whose columns are the camera's axes, and whether both are finite
        ([] bool). A pose that is not finite comes back as the identity.
    """
    # A pose that the compiler knew would be folded into all that follows, which would round otherwise than for one that moves.
    fixed = barrier((scene.camera_position, scene.camera_axes))
    bodies = mounts.Bodies(scene.body_mass, scene.body_parents)
    position, frame = mounts.place(bodies, data, scene.camera_mount, fixed[0])
    rotation = fixed[1]
    # Written out rather than as matrix products, which accelerators would do at low precision.
    if scene.camera_mount.aims:
        rotation = mounts.looking(position, mounts.target(bodies, data, scene.camera_mount))
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
    """Keep XLA from computing a value again for every use. JAX 0.11 cannot transpose its own barrier."""
    return jax.lax.optimization_barrier(tree)


@barrier.defjvp
def _barrier_tangents(primals: tuple, tangents: tuple) -> tuple:
    return barrier(*primals), tangents[0]


def _rotation(vector: jax.Array) -> jax.Array:
    """[3] radians -> [3, 3], the identity at 0 with the right gradient there."""
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


def lens(scene: Scene) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Where the image lies on the plane at depth 1 m (or at any depth, if orthographic).

    Returns:
        Middle across and up, half the width and half the height, each [] float32 (m).
    """
    zero = jnp.zeros((), jnp.float32)
    if scene.projection == "intrinsic":
        middle = scene.principal / scene.focal
        half = 0.5 * scene.sensor / scene.focal
        return middle[0], -middle[1], half[0], half[1]
    half_height = 0.5 * scene.fovy if scene.projection == "orthographic" else jnp.tan(scene.fovy * (0.5 * _DEGREES))
    return zero, zero, half_height * (scene.width / scene.height), half_height


def pixel_rays(scene: Scene, rows: np.ndarray, columns: np.ndarray) -> Rays:
    """The rays through the middles of pixels.

    Args:
        scene: The scene.
        rows: Rows of the pixels, from the top; any shape.
        columns: Columns, the same shape.

    Returns:
        Rays of the shape of ``rows``.
    """
    middle_u, middle_v, half_u, half_v = lens(scene)
    unit_u = (2.0 * columns + 1.0 - scene.width) / scene.width
    unit_v = (scene.height - 1.0 - 2.0 * rows) / scene.height
    u = middle_u + jnp.asarray(unit_u, jnp.float32) * half_u
    return Rays(u, middle_v + jnp.asarray(unit_v, jnp.float32) * half_v)


def pixel_pitch(scene: Scene) -> tuple[jax.Array, jax.Array]:
    """How much u and v change from one pixel to the next, [] float32 each."""
    _, _, half_u, half_v = lens(scene)
    return half_u * (2.0 / scene.width), half_v * (2.0 / scene.height)


def ray_parts(scene: Scene, rays: Rays) -> tuple[tuple, tuple, jax.Array | float]:
    """Start and direction of rays in the camera's frame, and the inverse square of the direction's length.

    Returns:
        Three [P] arrays or numbers, three more, and [P] or a number. Numbers are what is the same for every ray.
    """
    u, v = rays
    if scene.projection == "orthographic":
        return (u, v, 0.0), (0.0, 0.0, -1.0), 1.0
    return (0.0, 0.0, 0.0), (u, v, -1.0), 1.0 / (u * u + v * v + 1.0)


def ray_length(scene: Scene, rays: Rays) -> jax.Array | float:
    """Metres along the rays for each metre of depth."""
    u, v = rays
    return 1.0 if scene.projection == "orthographic" else jnp.sqrt(u * u + v * v + 1.0)


def in_view(scene: Scene, middle: jax.Array, radius: jax.Array, rays: Rays, depth: jax.Array | None) -> jax.Array:
    """Which balls the rays through a block of pixels may meet.

    Args:
        scene: The scene.
        middle: [K, 3] float32, metres, camera's frame.
        radius: [K] float32, metres.
        rays: [P].
        depth: [P] float32, metres, beyond which nothing counts; None for no such depth.

    Returns:
        [K] bool; false for what is not finite.
    """
    ahead = -middle[:, 2]
    touching = (ahead + radius > scene.znear) & (ahead - radius < (scene.zfar if depth is None else jnp.max(depth)))
    for axis, coordinate in enumerate(rays):
        low, high = jnp.min(coordinate), jnp.max(coordinate)
        if scene.projection == "orthographic":
            touching &= (middle[:, axis] - high <= radius) & (low - middle[:, axis] <= radius)
        else:
            touching &= middle[:, axis] - high * ahead <= radius * jnp.sqrt(1.0 + high * high)
            touching &= low * ahead - middle[:, axis] <= radius * jnp.sqrt(1.0 + low * low)
    return touching


def mapped(matrix: Any, vector: tuple) -> tuple:
    """``matrix @ vector`` for a [3, 3] matrix (or rows of values) and three values, without the products with plain zeros."""
    rows = [[matrix[row, column] for column in range(3)] for row in range(3)] if hasattr(matrix, "shape") else matrix
    result = []
    for row in rows:
        terms = [
            -entry if isinstance(value, float) and value == -1.0 else entry * value
            for entry, value in zip(row, vector, strict=True)
            if not (isinstance(value, float) and value == 0.0)
        ]
        result.append(sum(terms[1:], terms[0]) if terms else 0.0)
    return tuple(result)
