"""Pixel rays, and spheres in view.

All geometry is expressed in the camera's frame (OpenGL's: x right, y up, looking along -z). A ray is ``start + t * direction``
with a direction whose z is -1, so the ray parameter t is the planar depth in metres and needs no conversion. A perspective
camera has the start 0 and the direction (u, v, -1); an orthographic one has the start (u, v, 0) and the direction (0, 0, -1).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render.scene import Scene
from jaxrl_vis_envs.render.viewpoint import barrier as barrier
from jaxrl_vis_envs.render.viewpoint import camera_pose as camera_pose
from jaxrl_vis_envs.render.viewpoint import lens as lens

INFINITE = 1e9
"""Value that stands for an infinite bound, see `sphere_sides`."""


class Rays(NamedTuple):
    """Pixel rays, by their intersection with the plane at depth 1 m (at any depth, if orthographic). Float32 arrays of one
    shape.

    Attributes:
        u: Metres to the right of the camera's axis.
        v: Metres above it.
    """

    u: jax.Array
    v: jax.Array


def pixel_rays(scene: Scene, rows: np.ndarray, columns: np.ndarray) -> Rays:
    """Compute the rays through pixel centres.

    Args:
        scene: The scene.
        rows: Row indices of the pixels, from the top; any shape.
        columns: Column indices, of the same shape.

    Returns:
        Rays of the shape of ``rows``.
    """
    middle_u, middle_v, half_u, half_v = lens(scene)
    unit_u = (2.0 * columns + 1.0 - scene.width) / scene.width
    unit_v = (scene.height - 1.0 - 2.0 * rows) / scene.height
    u = middle_u + jnp.asarray(unit_u, jnp.float32) * half_u
    return Rays(u, middle_v + jnp.asarray(unit_v, jnp.float32) * half_v)


def pixel_pitch(scene: Scene) -> tuple[jax.Array, jax.Array]:
    """Compute the change of u and of v from one pixel to the next, [] float32 each."""
    _, _, half_u, half_v = lens(scene)
    return half_u * (2.0 / scene.width), half_v * (2.0 / scene.height)


def ray_parts(scene: Scene, rays: Rays) -> tuple[tuple, tuple, jax.Array | float]:
    """Return origins and directions of rays in the camera's frame, and the inverse squared length of the directions.

    Returns:
        Origin and direction as three components each, and the inverse squared length. Each is an array [P], or a scalar if it
        is the same for all rays.
    """
    u, v = rays
    if scene.projection == "orthographic":
        return (u, v, 0.0), (0.0, 0.0, -1.0), 1.0
    return (0.0, 0.0, 0.0), (u, v, -1.0), 1.0 / (u * u + v * v + 1.0)


def ray_length(scene: Scene, rays: Rays) -> jax.Array | float:
    """Compute the distance along the rays per metre of depth."""
    u, v = rays
    return 1.0 if scene.projection == "orthographic" else jnp.sqrt(u * u + v * v + 1.0)


def in_view(scene: Scene, middle: jax.Array, radius: jax.Array, rays: Rays, depth: jax.Array | None) -> jax.Array:
    """Test which bounding spheres may intersect the rays of a block of pixels (a conservative frustum test).

    Args:
        scene: The scene.
        middle: [K, 3] float32, sphere centres in the camera's frame, m.
        radius: [K] float32, m.
        rays: [P].
        depth: [P] float32, maximum depth per ray, m; None for the scene's ``zfar``.

    Returns:
        [K] bool; False for non-finite spheres.
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


def sphere_sides(scene: Scene, middle: jax.Array, radius: jax.Array) -> jax.Array:
    """Return the bounds in the image of spheres: [K, 4] float32, minimum and maximum u, minimum and maximum v.

    Args:
        scene: The scene.
        middle: [K, 3] float32, centres in the camera's frame, m.
        radius: [K] float32, m.

    Returns:
        The bounds; infinite (`INFINITE`) around the camera, and inverted behind it, so that nothing lies between them.
    """
    x, y, depth = middle[:, 0], middle[:, 1], -middle[:, 2]
    radius = radius * (1.0 + 1e-4) + 1e-6
    if scene.projection == "orthographic":
        sides = [x - radius, x + radius, y - radius, y + radius]
        behind, around = depth < -radius, jnp.zeros(depth.shape, bool)
    else:
        square = depth * depth - radius * radius
        safe = jnp.where(square > 0.0, square, 1.0)
        sides = []
        for along in (x, y):
            root = radius * jnp.sqrt(jnp.maximum(along * along + square, 0.0))
            sides += [(along * depth - root) / safe, (along * depth + root) / safe]
        behind, around = depth <= -radius, depth <= radius
    low, high = jnp.where(around, -INFINITE, 0.0), jnp.where(around, INFINITE, 0.0)
    sides = [jnp.where(around, high if i % 2 else low, side) for i, side in enumerate(sides)]
    return jnp.stack([jnp.where(behind, -INFINITE if i % 2 else INFINITE, side) for i, side in enumerate(sides)], axis=1)


def multiply(matrix: Any, vector: tuple) -> tuple:
    """Multiply a matrix [3, 3] (or its rows) by a vector of three values, omitting products with constants 0 and -1."""
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
