"""Which object each pixel sees, and how far away: analytic intersections of rays with unit shapes.

Every object is brought to a unit shape (ball, cylinder, cube, square) by a linear map of the camera's frame, once per object.
What is left per pixel and object is a ray that is linear in the pixel's (u, v), and a handful of operations. The objects are
unrolled and everything is elementwise over pixels, so that XLA makes one pass of it without anything in memory between.

An object counts where a ray enters it in front of the near plane: from inside an object one looks through it, as with OpenGL's
culled back faces. A plane is seen from both sides.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.render.scene import Scene

_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
_CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
_CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)

# Keeps a division by a ray component that is exactly 0 finite; far too small to change any other number.
_TINY = 1e-20
# Objects with a pose that is not finite go this far behind the camera, in metres: no ray meets them, and no NaN is left.
_BEHIND = 1e6


class UnitShapes(NamedTuple):
    """The drawn objects as unit shapes: a point p of the camera's frame is ``origin + axes @ p`` in the shape's frame.

    Attributes:
        origin: [G, 3] float32, the camera in the shape's frame.
        axes: [G, 3, 3] float32, 1/metres (rotation from the camera's frame, then division by the half-sizes).
        extra: [G] float32. Sphere: radius in metres. Capsule: half-length over radius. Otherwise unused.
        extra_square: [G] float32. Sphere and capsule: squared radius in square metres. Otherwise unused.
    """

    origin: jax.Array
    axes: jax.Array
    extra: jax.Array
    extra_square: jax.Array


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
    finite = camera_finite & jnp.all(jnp.isfinite(position), -1) & jnp.all(jnp.isfinite(rotation), (-2, -1))
    position = jnp.where(finite[:, None], position, 0.0)
    rotation = jnp.where(finite[:, None, None], rotation, 0.0)
    # Written out rather than as matrix products, which accelerators would do at low precision.
    offset = jnp.sum((position - camera_position)[:, :, None] * camera_rotation, axis=1)  # [G, 3] in the camera's frame
    relative = jnp.sum(rotation[:, :, :, None] * camera_rotation[None, :, None, :], axis=1)  # [G, shape axis, camera axis]
    offset = jnp.where(finite[:, None], offset, jnp.array([0.0, 0.0, _BEHIND]))
    relative = jnp.where(finite[:, None, None], relative, jnp.eye(3))

    size = scene.size[np.array(scene.object_ids)]
    kinds = np.array(scene.object_types)[:, None]
    radius = size[:, :1]
    ones = jnp.ones_like(radius)
    half = jnp.where(kinds == _PLANE, jnp.concatenate([size[:, :2], ones], 1), size)
    half = jnp.where((kinds == _SPHERE) | (kinds == _CAPSULE), jnp.broadcast_to(radius, size.shape), half)
    half = jnp.where(kinds == _CYLINDER, jnp.concatenate([radius, radius, size[:, 1:2]], 1), half)
    # A ball looks the same from everywhere: leaving its rotation out saves operations in every pixel.
    relative = jnp.where((kinds == _SPHERE)[:, :, None], jnp.eye(3), relative)
    axes = relative / half[:, :, None]
    origin = -jnp.sum(axes * offset[:, None, :], axis=-1)
    extra = jnp.where(kinds[:, 0] == _CAPSULE, size[:, 1] / size[:, 0], size[:, 0])
    return UnitShapes(origin, axes, extra, jnp.square(size[:, 0]))


def _object_poses(scene: Scene, data: Any) -> tuple[jax.Array, jax.Array]:
    """Positions [G, 3] and rotations [G, 3, 3] of the drawn objects in the world, float32."""
    position = jnp.asarray(data.geom_xpos, jnp.float32)
    rotation = jnp.asarray(data.geom_xmat, jnp.float32).reshape(-1, 3, 3)
    if any(index >= scene.geom_count for index in scene.object_ids):
        position = jnp.concatenate([position, jnp.asarray(data.site_xpos, jnp.float32)])
        rotation = jnp.concatenate([rotation, jnp.asarray(data.site_xmat, jnp.float32).reshape(-1, 3, 3)])
    ids = np.array(scene.object_ids)
    return position[ids], rotation[ids]


def nearest_hit(
    scene: Scene, shapes: UnitShapes, u: jax.Array, v: jax.Array, want_winner: bool
) -> tuple[jax.Array, jax.Array | None]:
    """The nearest object along every ray.

    Args:
        scene: The scene.
        shapes: The drawn objects.
        u: [P] float32, see `camera.pixel_rays`.
        v: [P] float32.
        want_winner: Whether to say which object it is; the depth alone is cheaper.

    Returns:
        Depth [P] float32, planar metres, ``scene.zfar`` where nothing is hit; and the winner [P] int32, an index into the drawn
        objects, -1 where nothing is hit (None if not wanted).
    """
    ray_square = u * u + v * v + 1.0
    inverse_ray_square = 1.0 / ray_square
    depth = jnp.broadcast_to(scene.zfar, u.shape)
    winner = jnp.full(u.shape, -1, jnp.int32)
    for index, kind in enumerate(scene.object_types):
        origin = [shapes.origin[index, axis] for axis in range(3)]
        extra = (shapes.extra[index], shapes.extra_square[index])
        if kind == _SPHERE:
            t, meets = _sphere(origin, (u, v), extra[0], inverse_ray_square)
        else:
            axes = shapes.axes[index]
            ray = [axes[axis, 0] * u + axes[axis, 1] * v - axes[axis, 2] for axis in range(3)]
            t, meets = _INTERSECTIONS[kind](origin, ray, extra, inverse_ray_square)
        nearer = meets & (t > scene.znear) & (t < depth)
        depth = jnp.where(nearer, t, depth)
        if want_winner:
            winner = jnp.where(nearer, index, winner)
    return depth, winner if want_winner else None


# Each intersection takes the ray's origin and direction in the unit shape's frame, and returns where the ray enters (t, in
# metres of planar depth) and whether it does. t is finite everywhere, and smooth wherever the ray does enter.


def _safe_root(square: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Square root where positive, and whether it is; 1 elsewhere, so that no gradient is infinite."""
    positive = square > 0.0
    return jnp.sqrt(jnp.where(positive, square, 1.0)), positive


def _sphere(origin: list, uv: tuple, radius: Any, inverse_ray_square: jax.Array) -> tuple:
    """The unit ball, not rotated: the ray's direction is (u, v, -1) over the radius.

    The ray is followed to its point nearest to the centre first. Subtracting there, and not between the large terms of the
    usual quadratic formula, keeps a small ball that is far away sharp in float32.
    """
    u, v = uv
    middle = (origin[2] - origin[0] * u - origin[1] * v) * inverse_ray_square  # in radii
    x, y, z = origin[0] + middle * u, origin[1] + middle * v, origin[2] - middle
    root, meets = _safe_root((1.0 - (x * x + y * y + z * z)) * inverse_ray_square)
    return (middle - root) * radius, meets


def _ellipsoid(origin: list, ray: list, extra: tuple, inverse_ray_square: jax.Array) -> tuple:
    del extra, inverse_ray_square
    inverse = 1.0 / (ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
    middle = -(origin[0] * ray[0] + origin[1] * ray[1] + origin[2] * ray[2]) * inverse
    x, y, z = (origin[axis] + middle * ray[axis] for axis in range(3))
    root, meets = _safe_root((1.0 - (x * x + y * y + z * z)) * inverse)
    return middle - root, meets


def _tube(origin: list, ray: list) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The endless cylinder of radius 1 around z: middle of the chord, half its length, and whether there is one."""
    inverse = 1.0 / (ray[0] * ray[0] + ray[1] * ray[1] + _TINY)
    middle = -(origin[0] * ray[0] + origin[1] * ray[1]) * inverse
    x, y = origin[0] + middle * ray[0], origin[1] + middle * ray[1]
    root, meets = _safe_root((1.0 - (x * x + y * y)) * inverse)
    return middle, root, meets


def _capsule(origin: list, ray: list, extra: tuple, inverse_ray_square: jax.Array) -> tuple:
    """A tube with a ball at each end: where the ray enters the tube beyond an end, that end's ball decides."""
    half_length, radius_square = extra
    middle, root, meets = _tube(origin, ray)
    side = middle - root
    height = origin[2] + side * ray[2]
    centre = jnp.clip(height, -half_length, half_length)
    on_side = meets & (height == centre)
    inverse = inverse_ray_square * radius_square
    below = origin[2] - jnp.where(height > 0.0, half_length, -half_length)
    nearest = -(origin[0] * ray[0] + origin[1] * ray[1] + below * ray[2]) * inverse
    x, y, z = origin[0] + nearest * ray[0], origin[1] + nearest * ray[1], below + nearest * ray[2]
    ball_root, meets_ball = _safe_root((1.0 - (x * x + y * y + z * z)) * inverse)
    return jnp.where(on_side, side, nearest - ball_root), meets & (on_side | meets_ball)


def _cylinder(origin: list, ray: list, extra: tuple, inverse_ray_square: jax.Array) -> tuple:
    """The tube and the slab |z| <= 1: inside both from the later entry to the earlier exit."""
    del extra, inverse_ray_square
    middle, root, meets = _tube(origin, ray)
    inverse = 1.0 / (ray[2] + _TINY)
    slab_middle, slab_half = -origin[2] * inverse, jnp.abs(inverse)
    enter = jnp.maximum(middle - root, slab_middle - slab_half)
    leave = jnp.minimum(middle + root, slab_middle + slab_half)
    return enter, meets & (enter < leave)


def _box(origin: list, ray: list, extra: tuple, inverse_ray_square: jax.Array) -> tuple:
    """Three slabs: inside all of them from the latest entry to the earliest exit."""
    del extra, inverse_ray_square
    enters, leaves = [], []
    for axis in range(3):
        inverse = 1.0 / (ray[axis] + _TINY)
        middle, half = -origin[axis] * inverse, jnp.abs(inverse)
        enters.append(middle - half)
        leaves.append(middle + half)
    enter = jnp.maximum(jnp.maximum(enters[0], enters[1]), enters[2])
    leave = jnp.minimum(jnp.minimum(leaves[0], leaves[1]), leaves[2])
    return enter, enter < leave


def _plane(origin: list, ray: list, extra: tuple, inverse_ray_square: jax.Array) -> tuple:
    """The square |x|, |y| <= 1 at z = 0, seen from both sides."""
    del extra, inverse_ray_square
    t = -origin[2] / (ray[2] + _TINY)
    x, y = origin[0] + t * ray[0], origin[1] + t * ray[1]
    return t, jnp.maximum(jnp.abs(x), jnp.abs(y)) <= 1.0


_INTERSECTIONS = {_PLANE: _plane, _CAPSULE: _capsule, _ELLIPSOID: _ellipsoid, _CYLINDER: _cylinder, _BOX: _box}
