"""Intersection of each pixel's ray with its visible object: exact depth, normal, and texture inputs.

Everything is computed from one table row fetched per pixel. The incoming depth is only an initial guess: one Newton step along
the ray moves it onto the surface. As a function of poses, sizes and camera, that step has the derivative of the depth, so the
search for the nearest object need not be differentiated.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.pixel import shapes
from jaxrl_vis_envs.render.pixel.arithmetic import Vector, dot, normalized
from jaxrl_vis_envs.render.pixel.lookup import Row, TriangleRow
from jaxrl_vis_envs.render.scene import Scene

# Maximum relative error of the initial depth; keys are about a hundred times better.
_START_ERROR = 1e-3


class Hit(NamedTuple):
    """Intersections of rays with objects. Arrays [P] float32.

    Attributes:
        depth: Planar depth, metres.
        point: Point in the camera's frame, metres.
        local: Point in the frame of the unit shape.
        gradient: Gradient of the surface in the frame of the unit shape.
        slope: Derivative of the surface's implicit function along the ray.
        normal: Unit normal in the camera's frame, outward (for a plane, towards the camera).
        triangle: Triangle rows, as passed to `intersect`.
    """

    depth: jax.Array
    point: Vector
    local: Vector
    gradient: Vector
    slope: jax.Array
    normal: Vector
    triangle: TriangleRow | None


def intersect(scene: Scene, row: Row, triangle: TriangleRow | None, rays: Rays, start: jax.Array, refined: bool = True) -> Hit:
    """Intersect rays with the objects of ``row``, given an approximate depth.

    Args:
        scene: The scene.
        row: Object at each pixel.
        triangle: Triangle at each pixel; None in a scene without meshes.
        rays: [P].
        start: [P] float32, metres, depth with a relative accuracy of 1e-3; not differentiated.
        refined: Take the Newton step onto the surface, the only part that has derivatives.
    """
    begin, direction, _ = camera.ray_parts(scene, rays)
    ray = camera.multiply(row.axes, direction)
    local_start = tuple(o + s for o, s in zip(row.origin, camera.multiply(row.axes, begin), strict=True))
    start = jax.lax.stop_gradient(start)
    near = tuple(b + start * r for b, r in zip(local_start, ray, strict=True))
    gradient = _gradient(scene, row, near)
    height = 0.5 * (dot(gradient, gradient) - 1.0)
    if triangle is not None:
        gradient = _override_gradient(triangle, gradient)
        height = jnp.where(triangle.hit, dot(gradient, near) + triangle.maps[2][3], height)
    slope = dot(gradient, ray)
    slope = jnp.where(jnp.abs(slope) < 1e-12, 1e-12, slope)
    depth, local = start, near
    if refined:
        step = jnp.clip(height / slope, -_START_ERROR * start, _START_ERROR * start)
        depth = start - step
        local = tuple(n - step * r for n, r in zip(near, ray, strict=True))
    facing = gradient = _gradient(scene, row, local)
    if triangle is not None:
        gradient = _override_gradient(triangle, gradient)
        smooth = mix(triangle.normals, barycentric(triangle, local))
        facing = tuple(jnp.where(triangle.hit, own, other) for own, other in zip(smooth, facing, strict=True))
    normal = normalized(_gradient_to_camera(row, facing))
    point = tuple(b + depth * d for b, d in zip(begin, direction, strict=True))
    return Hit(depth, point, local, gradient, slope, normal, triangle)


def _gradient_to_camera(row: Row, gradient: Vector) -> Vector:
    """Transform a gradient from the unit shape's frame to the camera's, by the transpose of the map."""
    return tuple(sum(row.axes[i][j] * gradient[i] for i in range(3)) for j in range(3))


def outward_normal(row: Row, hit: Hit) -> Vector:
    """Compute the unnormalised outward normal of a primitive in the camera's frame."""
    return _gradient_to_camera(row, hit.gradient)


def _override_gradient(triangle: TriangleRow, gradient: Vector) -> Vector:
    """Return the triangle's normal where a triangle is hit, the gradient elsewhere."""
    return tuple(jnp.where(triangle.hit, own, other) for own, other in zip(triangle.maps[2][:3], gradient, strict=True))


def barycentric(triangle: TriangleRow, point: Vector, is_tangent: bool = False) -> list[jax.Array]:
    """Compute the barycentric coordinates of corners 2 and 3 at a point, or (``is_tangent``) their change along a vector."""
    base = 0.0 if is_tangent else 1.0
    return [dot(map_[:3], point) + base * map_[3] for map_ in triangle.maps[:2]]


def mix(corners: tuple, parts: list[jax.Array], is_tangent: bool = False) -> list[jax.Array]:
    """Interpolate vectors between corners by `barycentric` coordinates, or (``is_tangent``) compute the vectors' change."""
    base = 0.0 if is_tangent else 1.0
    second, third = parts
    return [base * a + second * (b - a) + third * (c - a) for a, b, c in zip(*corners, strict=True)]


def corners(row: Row, hit: Hit) -> list[tuple[jax.Array, Hit]]:
    """Return the corners of each pixel's triangle as hits, with barycentric weights [P], because OpenGL lights the corners.

    Where no mesh is hit, all corners are the hit point itself. (The triangles of a height field are small and flat.)
    """
    assert hit.triangle is not None
    triangle = hit.triangle
    is_mesh = triangle.hit & (row.kind == shapes.MESH)
    second, third = barycentric(triangle, hit.local)
    corner_hits = []
    for number, share in enumerate((1.0 - second - third, second, third)):
        local = tuple(corner - o for corner, o in zip(triangle.corners[number], row.origin, strict=True))
        facing = triangle.normals[number]
        # The axes of a mesh are a rotation: its transpose maps back to the camera's frame.
        point, normal = _gradient_to_camera(row, local), _gradient_to_camera(row, facing)
        own = tuple(jnp.where(is_mesh, new, old) for new, old in zip(point, hit.point, strict=True))
        turned = tuple(jnp.where(is_mesh, new, old) for new, old in zip(normal, hit.normal, strict=True))
        corner_hits.append((jnp.where(is_mesh, share, 1.0 if number == 0 else 0.0), hit._replace(point=own, normal=turned)))
    return corner_hits


def _gradient(scene: Scene, row: Row, local: Vector) -> Vector:
    """Compute the outward gradient g in the unit shape's frame, such that (g.g - 1) / 2 is the height above the surface.

    Only the types present in the scene are computed.
    """
    x, y, z = local
    types = set(scene.object_types)
    gradient = (x, y, z)  # sphere and ellipsoid
    if shapes.CAPSULE in types:
        gradient = (x, y, jnp.where(row.kind == shapes.CAPSULE, z - jnp.clip(z, -row.extra, row.extra), z))
    if shapes.CYLINDER in types:
        is_cylinder = row.kind == shapes.CYLINDER
        # On the surface, either |z| is 1 and the radius at most 1, or the radius is 1 and |z| at most 1.
        on_cap = z * z >= x * x + y * y
        wall, cap = is_cylinder & ~on_cap, is_cylinder & on_cap
        gradient = (jnp.where(cap, 0.0, x), jnp.where(cap, 0.0, y), jnp.where(wall, 0.0, gradient[2]))
    if shapes.BOX in types:
        is_box = row.kind == shapes.BOX
        max_abs = jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.abs(z))
        gradient = tuple(
            jnp.where(is_box & (jnp.abs(value) < max_abs), 0.0, old) for value, old in zip(local, gradient, strict=True)
        )
    if shapes.PLANE in types:
        is_plane = row.kind == shapes.PLANE
        gradient = (
            jnp.where(is_plane, 0.0, gradient[0]),
            jnp.where(is_plane, 0.0, gradient[1]),
            jnp.where(is_plane, 1.0 + z, gradient[2]),
        )
    return gradient
