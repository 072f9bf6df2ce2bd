"""Where the ray of a pixel meets the object that it sees: exact depth, normal, and what the texture needs.

All is computed from one row of a table that is fetched for the pixel. The depth that comes in only says where to start: one
Newton step along the ray brings it onto the surface. As a function of poses, sizes and the camera that step has the derivative
of the depth, so nothing that searches for the nearest object has to be differentiated.
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

# The largest share of the depth by which a start may be wrong; keys are some hundred times better.
_START_ERROR = 1e-3


class Hit(NamedTuple):
    """Where a ray meets an object. Arrays [P] float32.

    Attributes:
        depth: Planar depth, metres.
        point: In the camera's frame, metres.
        local: In the frame of the unit shape.
        gradient: Across the surface, in the frame of the unit shape.
        slope: How fast the ray runs against the gradient.
        normal: Unit, outward (of a plane: towards the camera), in the camera's frame.
        triangle: What `meet` was given.
    """

    depth: jax.Array
    point: Vector
    local: Vector
    gradient: Vector
    slope: jax.Array
    normal: Vector
    triangle: TriangleRow | None


def meet(scene: Scene, row: Row, triangle: TriangleRow | None, rays: Rays, start: jax.Array, refined: bool = True) -> Hit:
    """Where the rays meet the objects of ``row``, given a depth nearby.

    Args:
        scene: The scene.
        row: The object of each pixel.
        triangle: The triangle of each pixel; None in a scene without meshes.
        rays: [P].
        start: [P] float32, metres, a depth that is right to a thousandth; not differentiated.
        refined: Whether to take the step from there onto the surface, which is the only part that has derivatives.
    """
    begin, direction, _ = camera.ray_parts(scene, rays)
    ray = camera.mapped(row.axes, direction)
    local_start = tuple(o + s for o, s in zip(row.origin, camera.mapped(row.axes, begin), strict=True))
    start = jax.lax.stop_gradient(start)
    near = tuple(b + start * r for b, r in zip(local_start, ray, strict=True))
    gradient = _gradient(scene, row, near)
    height = 0.5 * (dot(gradient, gradient) - 1.0)
    if triangle is not None:
        gradient = _across(triangle, gradient)
        height = jnp.where(triangle.seen, dot(gradient, near) + triangle.maps[2][3], height)
    slope = dot(gradient, ray)
    slope = jnp.where(jnp.abs(slope) < 1e-12, 1e-12, slope)
    depth, local = start, near
    if refined:
        step = jnp.clip(height / slope, -_START_ERROR * start, _START_ERROR * start)
        depth = start - step
        local = tuple(n - step * r for n, r in zip(near, ray, strict=True))
    facing = gradient = _gradient(scene, row, local)
    if triangle is not None:
        gradient = _across(triangle, gradient)
        smooth = mix(triangle.normals, shares(triangle, local))
        facing = tuple(jnp.where(triangle.seen, own, other) for own, other in zip(smooth, facing, strict=True))
    normal = normalized(_to_camera(row, facing))
    point = tuple(b + depth * d for b, d in zip(begin, direction, strict=True))
    return Hit(depth, point, local, gradient, slope, normal, triangle)


def _to_camera(row: Row, gradient: Vector) -> Vector:
    """A gradient in the unit shape's frame goes back to the camera's with the transpose of the map."""
    return tuple(sum(row.axes[i][j] * gradient[i] for i in range(3)) for j in range(3))


def outward(row: Row, hit: Hit) -> Vector:
    """The normal of a primitive at any length, in the camera's frame."""
    return _to_camera(row, hit.gradient)


def _across(triangle: TriangleRow, gradient: Vector) -> Vector:
    """The direction across the triangle where one is seen, the gradient elsewhere."""
    return tuple(jnp.where(triangle.seen, own, other) for own, other in zip(triangle.maps[2][:3], gradient, strict=True))


def shares(triangle: TriangleRow, place: Vector, moved: bool = False) -> list[jax.Array]:
    """Barycentric coordinates of the second and third corner at a point, or (``moved``) their change along a vector."""
    base = 0.0 if moved else 1.0
    return [dot(map_[:3], place) + base * map_[3] for map_ in triangle.maps[:2]]


def mix(corners: tuple, parts: list[jax.Array], moved: bool = False) -> list[jax.Array]:
    """Vectors between those at the three corners, given the `shares`; or (``moved``) their change, given that of the shares."""
    base = 0.0 if moved else 1.0
    second, third = parts
    return [base * a + second * (b - a) + third * (c - a) for a, b, c in zip(*corners, strict=True)]


def corners(row: Row, hit: Hit) -> list[tuple[jax.Array, Hit]]:
    """What OpenGL lights instead of a triangle's points: its corners, each with its share of the point, [P].

    Where no mesh is seen, each corner is the point itself. (The triangles of a height field are many and flat.)
    """
    assert hit.triangle is not None
    triangle = hit.triangle
    seen = triangle.seen & (row.kind == shapes.MESH)
    second, third = shares(triangle, hit.local)
    found = []
    for number, share in enumerate((1.0 - second - third, second, third)):
        local = tuple(corner - o for corner, o in zip(triangle.corners[number], row.origin, strict=True))
        facing = triangle.normals[number]
        # The axes of a mesh are a rotation: its transpose leads back to the camera's frame.
        point, normal = _to_camera(row, local), _to_camera(row, facing)
        own = tuple(jnp.where(seen, new, old) for new, old in zip(point, hit.point, strict=True))
        turned = tuple(jnp.where(seen, new, old) for new, old in zip(normal, hit.normal, strict=True))
        found.append((jnp.where(seen, share, 1.0 if number == 0 else 0.0), hit._replace(point=own, normal=turned)))
    return found


def _gradient(scene: Scene, row: Row, local: Vector) -> Vector:
    """Outward gradient g in the unit shape's frame, so that (g.g - 1) / 2 is the height above the surface.

    Only the types in the scene cost anything.
    """
    x, y, z = local
    types = set(scene.object_types)
    gradient = (x, y, z)  # sphere and ellipsoid
    if shapes.CAPSULE in types:
        gradient = (x, y, jnp.where(row.kind == shapes.CAPSULE, z - jnp.clip(z, -row.extra, row.extra), z))
    if shapes.CYLINDER in types:
        is_cylinder = row.kind == shapes.CYLINDER
        # On the surface either |z| is 1 and the radius less, or the radius is 1 and |z| less.
        on_cap = z * z >= x * x + y * y
        wall, cap = is_cylinder & ~on_cap, is_cylinder & on_cap
        gradient = (jnp.where(cap, 0.0, x), jnp.where(cap, 0.0, y), jnp.where(wall, 0.0, gradient[2]))
    if shapes.BOX in types:
        is_box = row.kind == shapes.BOX
        most = jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.abs(z))
        gradient = tuple(
            jnp.where(is_box & (jnp.abs(value) < most), 0.0, old) for value, old in zip(local, gradient, strict=True)
        )
    if shapes.PLANE in types:
        is_plane = row.kind == shapes.PLANE
        gradient = (
            jnp.where(is_plane, 0.0, gradient[0]),
            jnp.where(is_plane, 0.0, gradient[1]),
            jnp.where(is_plane, 1.0 + z, gradient[2]),
        )
    return gradient
