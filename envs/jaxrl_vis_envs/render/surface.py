"""What a pixel sees of the object it sees: exact depth, normal, and the colour of the texture, once per pixel.

All is computed from one row of a table that is fetched for the pixel. The depth that comes in only says where to start: one
Newton step along the ray brings it onto the surface. As a function of poses, sizes and the camera that step has the derivative
of the depth, so nothing that searches for the nearest object has to be differentiated.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import camera, charts, model_reading, shapes, textures
from jaxrl_vis_envs.render.scene import Scene

Vector = tuple  # of three

# The largest share of the depth by which a start may be wrong; keys are some hundred times better.
_START_ERROR = 1e-3


class Row(NamedTuple):
    """Of one object, or of the object that each pixel sees: numbers, or arrays [P] float32."""

    axes: Vector  # of three vectors
    origin: Vector
    extra: jax.Array
    kind: jax.Array
    colour: Vector
    emission: jax.Array
    specular: jax.Array
    exponent: jax.Array
    texture: tuple  # nothing, or mapping, scales and shifts (5), first level, number of levels, six faces?, width, height


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
    triangle: tuple | None


def object_table(scene: Scene, unit: shapes.UnitShapes) -> jax.Array:
    """[G, columns] float32: everything about each drawn object that a pixel which sees it needs, in the order of `Row`."""
    columns = [
        *(unit.axes[:, row, column] for row in range(3) for column in range(3)),
        *(unit.origin[:, axis] for axis in range(3)),
        unit.extra,
    ]
    return jnp.stack(columns + look_columns(scene), axis=-1)


def look_columns(scene: Scene) -> list[jax.Array]:
    """The columns of `object_table` that do not depend on poses, from the kind on; [G] float32 each."""
    ids = np.array(scene.object_ids)
    columns = [jnp.asarray(scene.object_types, jnp.float32), *(scene.rgba[ids, channel] for channel in range(3))]
    columns += [scene.emission[ids], scene.specular[ids], 128.0 * scene.shininess[ids]]
    if scene.atlas.used:
        images = [image or textures.Image(0, 1, 1) for image in scene.atlas.images]
        columns.append(jnp.asarray(scene.atlas.mappings, jnp.float32))
        columns.extend(_texture_scales(scene, ids))
        columns.append(jnp.asarray([image.first_level for image in images], jnp.float32))
        columns.append(jnp.asarray([image.levels for image in images], jnp.float32))
        columns.append(jnp.asarray([image.faces == 6 for image in images], jnp.float32))
        sizes = np.array([scene.atlas.levels[image.first_level][1:] for image in images], np.float32)
        columns.extend(jnp.asarray(sizes[:, axis]) for axis in range(2))
    return columns


def _texture_scales(scene: Scene, ids: np.ndarray) -> list[jax.Array]:
    """How the coordinates of a point become those of the texture: five [G].

    For a flat one, coordinates across and up (see `charts`) are multiplied with the first two and the last two added; for a
    cube, the coordinates in the unit shape's frame are multiplied with the first three.
    """
    kinds, mappings = np.array(scene.object_types), np.array(scene.atlas.mappings)
    size = _visual_size(kinds, scene.size[ids])
    metres = np.isin(kinds, (shapes.MESH, shapes.HFIELD))
    uniform, cube = np.array(scene.atlas.uniform), mappings == textures.CUBE
    endless = jnp.any((size[:, :2] >= model_reading.ENDLESS) & (kinds == shapes.PLANE)[:, None], axis=1)
    scales, shifts = [], []
    for axis in range(3):
        half = size[:, axis]
        if axis == 2:
            scales.append(jnp.where(uniform, half, 1.0))
            continue
        # An endless plane repeats per metre, whatever the material says; a mesh's own frame is in metres already.
        over_object = jnp.where(metres, 1.0 / jnp.where(half > 0.0, half, 1.0), 1.0)
        per_metre = uniform | (half >= model_reading.ENDLESS)
        repeat = scene.texture_repeat[ids][:, axis] * jnp.where(per_metre, jnp.where(metres, 1.0, half), over_object)
        shift = jnp.where(half >= model_reading.ENDLESS, 0.0, 0.5 * repeat) + jnp.where(endless, 0.5, 0.0)
        shifts.append(jnp.where(metres, -0.5, shift))
        sign = 0.5 if axis == 0 else -0.5
        scales.append(jnp.where(cube, jnp.where(uniform, half, 1.0), sign * repeat))
    return scales + shifts


def _visual_size(kinds: np.ndarray, size: jax.Array) -> jax.Array:
    """[G, 3] metres: half-sizes along x, y and z of each object (of a capsule, without the caps)."""
    x, y, z = size[:, 0], size[:, 1], size[:, 2]
    ball, tube = kinds == shapes.SPHERE, np.isin(kinds, (shapes.CAPSULE, shapes.CYLINDER))
    return jnp.stack([x, jnp.where(ball | tube, x, y), jnp.where(tube, y, jnp.where(ball, x, z))], axis=1)


def read_row(values: jax.Array) -> Row:
    """Sorts the columns of `object_table` (its last axis) into a `Row`."""
    return row_of([values[..., column] for column in range(values.shape[-1])])


def row_of(v: list) -> Row:
    """A `Row` of the columns of `object_table`."""
    axes = tuple(tuple(v[3 * row : 3 * row + 3]) for row in range(3))
    return Row(axes, tuple(v[9:12]), v[12], v[13], tuple(v[14:17]), v[17], v[18], v[19], tuple(v[20:]))


def fetch(table: jax.Array, row: jax.Array) -> Row:
    """The row of every pixel: table [G, columns] and [P] int32 (below 0: the first row)."""
    return row_of(_look_up(table, row))


def fetch_triangle(scene: Scene, triangle: jax.Array | None) -> tuple | None:
    """What `meet` needs of the triangles of pixels: rows of `Scene.triangles` [P] int32, below 0 for none."""
    return None if triangle is None else (triangle >= 0, _look_up(scene.triangles, triangle))


def _look_up(table: jax.Array, row: jax.Array) -> list[jax.Array]:
    """The columns [P] of the rows [P] of a table."""
    index = jnp.maximum(row, 0)
    if jax.default_backend() == "cpu":
        # One row per pixel is kept and read by all that follows; a column at a time is looked up anew for every use.
        values = table.at[index].get(mode="promise_in_bounds")
        return [values[..., column] for column in range(table.shape[1])]
    # Elsewhere that is what keeps the rows of all pixels out of the memory.
    return [table[:, column].at[index].get(mode="promise_in_bounds") for column in range(table.shape[1])]


def meet(
    scene: Scene, row: Row, triangle: tuple | None, u: jax.Array, v: jax.Array, start: jax.Array, refined: bool = True
) -> Hit:
    """Where the rays meet the objects of ``row``, given a depth nearby.

    Args:
        scene: The scene.
        row: The object of each pixel.
        triangle: For each pixel, whether it sees a triangle ([P] bool), and that triangle's columns ([P] each) as in `meshes`;
            None in a scene without meshes.
        u: [P] float32, see `camera.pixel_rays`.
        v: [P] float32.
        start: [P] float32, metres, a depth that is right to a thousandth; not differentiated.
        refined: Whether to take the step from there onto the surface, which is the only part that has derivatives.
    """
    begin, direction, _ = camera.ray_parts(scene, u, v)
    ray = camera.mapped(row.axes, direction)
    local_start = tuple(o + s for o, s in zip(row.origin, camera.mapped(row.axes, begin), strict=True))
    start = jax.lax.stop_gradient(start)
    near = tuple(b + start * r for b, r in zip(local_start, ray, strict=True))
    gradient = _gradient(scene, row, near)
    height = 0.5 * (dot(gradient, gradient) - 1.0)
    if triangle is not None:
        seen, columns = triangle
        gradient = tuple(jnp.where(seen, columns[8 + axis], g) for axis, g in enumerate(gradient))
        height = jnp.where(seen, dot(gradient, near) + columns[11], height)
    slope = dot(gradient, ray)
    slope = jnp.where(jnp.abs(slope) < 1e-12, 1e-12, slope)
    depth, local = start, near
    if refined:
        step = jnp.clip(height / slope, -_START_ERROR * start, _START_ERROR * start)
        depth = start - step
        local = tuple(n - step * r for n, r in zip(near, ray, strict=True))
    facing = gradient = _gradient(scene, row, local)
    if triangle is not None:
        seen, columns = triangle
        gradient = tuple(jnp.where(seen, columns[8 + axis], g) for axis, g in enumerate(gradient))
        shares = _shares(columns, local, 1.0)
        mixed = [_mix(columns[12 + k : 19 + k : 3], shares) for k in range(3)]
        facing = tuple(jnp.where(seen, smooth, flat) for smooth, flat in zip(mixed, facing, strict=True))
    normal = normalized(_to_camera(row, facing))
    point = tuple(b + depth * d for b, d in zip(begin, direction, strict=True))
    return Hit(depth, point, local, gradient, slope, normal, triangle)


def _to_camera(row: Row, gradient: Vector) -> Vector:
    """A gradient in the unit shape's frame goes back to the camera's with the transpose of the map."""
    return tuple(sum(row.axes[i][j] * gradient[i] for i in range(3)) for j in range(3))


def outward(row: Row, hit: Hit) -> Vector:
    """The normal of a primitive at any length, in the camera's frame."""
    return _to_camera(row, hit.gradient)


def _shares(columns: list, local: Vector, moved: float) -> list:
    """Barycentric coordinates of the second and third corner at a point (``moved`` 1), or their change along a vector (0)."""
    return [dot(tuple(columns[4 * k : 4 * k + 3]), local) + moved * columns[4 * k + 3] for k in range(2)]


def _mix(corners: list, shares: list, base: float = 1.0) -> jax.Array:
    """A value between those at the three corners; with ``base`` 0 its change."""
    return base * corners[0] + shares[0] * (corners[1] - corners[0]) + shares[1] * (corners[2] - corners[0])


def corners(row: Row, hit: Hit) -> list[tuple[jax.Array, Hit]]:
    """What OpenGL lights instead of a triangle's points: its corners, each with its share of the point, [P].

    Where no mesh is seen, each corner is the point itself. (The triangles of a height field are many and flat.)
    """
    assert hit.triangle is not None
    seen, columns = hit.triangle
    seen = seen & (row.kind == shapes.MESH)
    second, third = _shares(columns, hit.local, 1.0)
    found = []
    for number, share in enumerate((1.0 - second - third, second, third)):
        local = tuple(columns[27 + 3 * number + axis] - row.origin[axis] for axis in range(3))
        facing = columns[12 + 3 * number : 15 + 3 * number]
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


def texture_colour(scene: Scene, row: Row, hit: Hit) -> Vector | None:
    """Red, green and blue that the colour is multiplied with, [P] each in [0, 1]; None in a scene without textures."""
    if not scene.atlas.used:
        return None
    if isinstance(scene.texels, jax.Array):
        return _texture_colour(scene, row, hit)
    # In a kernel, many a tile sees nothing that has a texture.
    plain = (jnp.ones_like(hit.depth),) * 3
    return jax.lax.cond(jnp.max(row.texture[0]) > 0.0, lambda: _texture_colour(scene, row, hit), lambda: plain)


def _texture_colour(scene: Scene, row: Row, hit: Hit) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`texture_colour` of a scene that has textures."""
    mapping, *scales, shift_across, shift_down, first_level, levels, six_faces, width, height = row.texture
    changes = _changes(scene, row, hit)
    flat = {kind for kind, how in zip(scene.object_types, scene.atlas.mappings, strict=True) if how == textures.FLAT}

    def chart(*local):
        across, up = charts.chart(flat, row.kind, row.extra, local)
        return scales[0] * across + shift_across, scales[1] * up + shift_down

    place: tuple = chart(*hit.local)
    moves = [jax.jvp(chart, hit.local, change)[1] for change in changes]
    face: jax.Array | int = 0
    repeats: jax.Array | bool = True
    if textures.UNWRAPPED in scene.atlas.mappings and hit.triangle is not None:
        unwrapped, columns = mapping == textures.UNWRAPPED, hit.triangle[1]
        shares = _shares(columns, hit.local, 1.0)
        place = tuple(jnp.where(unwrapped, _mix(columns[21 + k :: 2], shares), p) for k, p in enumerate(place))
        for number, change in enumerate(changes):
            turned = _shares(columns, change, 0.0)
            moves[number] = tuple(
                jnp.where(unwrapped, _mix(columns[21 + k :: 2], turned, 0.0), move) for k, move in enumerate(moves[number])
            )
    if textures.CUBE in scene.atlas.mappings:
        is_cube = mapping == textures.CUBE
        x, y, z = hit.local
        if shapes.CAPSULE in scene.object_types:
            middle = jnp.clip(z, -row.extra, row.extra)
            z = jnp.where(row.kind == shapes.CAPSULE, middle / jnp.maximum(row.extra, 1e-9) + (z - middle), z)
        scaled = tuple(scale * value for scale, value in zip(scales, (x, y, z), strict=True))
        cube_face, cube_place, choice = textures.cube_place(scaled)
        face = jnp.where(is_cube & (six_faces > 0.0), cube_face, 0)
        place = tuple(jnp.where(is_cube, c, p) for c, p in zip(cube_place, place, strict=True))
        repeats = ~is_cube
        for number, change in enumerate(changes):
            turned = textures.cube_move(choice, cube_place, tuple(s * c for s, c in zip(scales, change, strict=True)))
            moves[number] = tuple(jnp.where(is_cube, c, move) for c, move in zip(turned, moves[number], strict=True))
    spreads = [jnp.square(across * width) + jnp.square(down * height) for across, down in moves]
    colour = textures.sample(
        scene.texels,
        scene.atlas.levels,
        jnp.asarray(first_level, jnp.int32),
        jnp.asarray(levels, jnp.int32),
        face,
        place,
        jnp.maximum(spreads[0], spreads[1]),
        repeats,
    )
    red, green, blue = (jnp.where(mapping > 0.0, value, 1.0) for value in colour)
    return red, green, blue


def _changes(scene: Scene, row: Row, hit: Hit) -> list[Vector]:
    """How the point in the unit shape's frame moves over the surface from one pixel to the next, across and up."""
    perspective = scene.projection != "orthographic"
    direction = tuple(p / hit.depth for p in hit.point) if perspective else (0.0, 0.0, -1.0)
    ray = camera.mapped(row.axes, direction)
    changes = []
    for axis, pitch in enumerate(camera.pixel_pitch(scene)):
        across = tuple(row.axes[i][axis] * (pitch * hit.depth if perspective else pitch) for i in range(3))
        along = dot(hit.gradient, across) / hit.slope
        changes.append(tuple(a - along * r for a, r in zip(across, ray, strict=True)))
    return changes


def dot(left: Vector, right: Vector) -> jax.Array:
    """Scalar product of two vectors of three values."""
    return left[0] * right[0] + left[1] * right[1] + left[2] * right[2]


def normalized(vector: Vector) -> Vector:
    """The vector at length 1 (0 stays 0)."""
    scale = jax.lax.rsqrt(dot(vector, vector) + 1e-30)
    return vector[0] * scale, vector[1] * scale, vector[2] * scale
