"""Transparent objects, blended over the opaque image as in MuJoCo.

MuJoCo sorts them by the distance of their nearest point and renders them twice, front to back and then back to front, so that a
single sheet of alpha a covers 1 - (1 - a)^2 of the background. Of objects at the same distance, the one declared first counts
as nearer. Every face of an object that faces the camera is blended: for a cup, its outside and its inner back. Depth and
segmentation treat transparent objects like any other.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.model import reading
from jaxrl_vis_envs.render.pixel import lights, lookup, raycast, shade, shapes, surface, texturing, triangles
from jaxrl_vis_envs.render.scene import Scene

# MuJoCo's factor for the alpha of planes seen from behind.
_PLANE_BACK = 0.3
# Relative depth tolerance for visibility behind an opaque surface, which may be the same surface drawn twice.
_DEPTH_TOLERANCE = 1e-6
# Maximum number of an object's overlapping faces that contribute to gradients; all contribute to images.
_MAX_GRADIENT_FACES = 8


class Sheet(NamedTuple):
    """Intersections with one transparent object.

    Attributes:
        index: Index of the object.
        row: Its properties, from the object table.
        hit: Intersections, [P].
        visible: [P] bool, True where they are in front of all opaque objects.
    """

    index: int
    row: lookup.Row
    hit: surface.Hit
    visible: jax.Array


class Film(NamedTuple):
    """Effect of an object on the colour c behind it: ``colour`` (three [P]) + ``transmission`` [P] * c."""

    colour: tuple
    transmission: jax.Array


def intersect_sheets(scene: Scene, unit: shapes.UnitShapes, rows: jax.Array, rays: Rays, depth: jax.Array) -> list[Sheet]:
    """Intersect rays with every transparent object in front of ``depth`` ([P] float32, metres, of opaque objects)."""
    depth = _max_visible_depth(depth)
    sheets = []
    for index in (index for index, clear in enumerate(scene.transparent) if clear):
        triangle = None
        if scene.object_types[index] in (shapes.MESH, shapes.HFIELD):
            frozen = jax.lax.stop_gradient(unit)
            t, triangle, _ = triangles.nearest_triangle(scene, frozen, rays, depth, only=index)
            visible = triangle >= 0
        else:
            t, meets = raycast.row_entry(scene, jax.lax.stop_gradient(unit), index, rays)
            visible = meets & (t > scene.znear) & (t < depth)
        if scene.transparent[index] == reading.CLEAR_FROM_BEHIND:
            visible = visible & raycast.is_behind(unit, index)
        row = lookup.read_row(rows[index])
        # A meaningless initial depth would cause NaN in gradients.
        t = jnp.where(visible, t, 1.0)
        sheets.append(
            Sheet(index, row, surface.intersect(scene, row, lookup.fetch_triangle(scene, triangle), rays, t), visible)
        )
    return sheets


def _max_visible_depth(depth: jax.Array) -> jax.Array:
    """Return the depth [P] (m) up to which transparent objects are visible, from the ``depth`` [P] (m) of opaque ones."""
    return jax.lax.stop_gradient(depth) * (1.0 + _DEPTH_TOLERANCE)


def nearest(sheets: list[Sheet], depth: jax.Array, index: jax.Array, normal: tuple) -> tuple[jax.Array, jax.Array, tuple]:
    """Update depth, index and normal of the nearest opaque object ([P] each) with those of nearer transparent ones."""
    for sheet in sheets:
        # Of two objects at the same depth, the one drawn later is visible; rows are in the opposite order.
        margin = jnp.where(sheet.index < index, _DEPTH_TOLERANCE, -_DEPTH_TOLERANCE) * depth
        nearer = sheet.visible & (sheet.hit.depth < depth + margin)
        depth = jnp.where(nearer, sheet.hit.depth, depth)
        index = jnp.where(nearer, sheet.index, index)
        normal = tuple(jnp.where(nearer, new, old) for new, old in zip(sheet.hit.normal, normal, strict=True))
    return depth, index, normal


def blend(
    scene: Scene,
    unit: shapes.UnitShapes,
    rows: jax.Array,
    light_table: jax.Array,
    sheets: list[Sheet],
    rays: Rays,
    depth: jax.Array,
    colour: tuple,
) -> tuple:
    """Blend the sheets over the ``colour`` (three [P]) of the opaque objects at ``depth`` [P] (m); return three [P]."""
    if not sheets:
        return colour
    declared = sorted(sheets, key=lambda sheet: scene.object_ids[sheet.index])
    films = []
    for sheet in declared:
        if sheet.hit.triangle is None:
            film = _add_face(_clear_film(rays), *face_colour(scene, unit, light_table, sheet, rays))
        else:
            film = _blend_faces(sheet.index, scene, unit, rows, light_table, rays, _max_visible_depth(depth))
        films.append(jnp.stack([*film.colour, film.transmission]))
    stack = jnp.stack(films)
    # Stable sort: objects at the same distance stay in order of declaration.
    order = jnp.argsort(unit.distance[np.array([sheet.index for sheet in declared])])
    for index in [*range(len(sheets)), *reversed(range(len(sheets)))]:
        film = stack[order[index]]
        colour = tuple(film[channel] + film[3] * c for channel, c in enumerate(colour))
    return colour


def face_colour(
    scene: Scene, unit: shapes.UnitShapes, light_table: jax.Array, sheet: Sheet, rays: Rays
) -> tuple[tuple, jax.Array]:
    """Compute colour (three [P]) and alpha [P] of one face; alpha is 0 where the face is not visible."""
    # Only opaque objects receive shadows.
    unshadowed = [light._replace(casts_shadows=False) for light in lights.unpack(scene, light_table)]
    face: Any = shade.light_surface(scene, unit, unshadowed, sheet.row, sheet.hit, rays)
    alpha = alpha_of(scene, unit, sheet.index)
    image = None
    if scene.atlas.images[sheet.index] is not None:
        image = texturing.texture_colour(scene, sheet.row, sheet.hit, scene.atlas.alpha[sheet.index])
    if image is not None:
        face = tuple(value * texel for value, texel in zip(face, image[:3], strict=True))
        # A plane that is transparent only from behind has an opaque material in MuJoCo; its texture's alpha applies too.
        alpha = alpha * image[3] if scene.atlas.alpha[sheet.index] else alpha
    return face, jnp.where(sheet.visible, alpha, 0.0)


def alpha_of(scene: Scene, unit: shapes.UnitShapes, row: int) -> jax.Array:
    """Return the alpha of an object from this side, without that of its texture: [] float32."""
    alpha = scene.rgba[scene.object_ids[row], 3]
    if scene.object_types[row] == shapes.PLANE:
        alpha = jnp.where(raycast.is_behind(unit, row), _PLANE_BACK * alpha, alpha)
    return alpha


def _add_face(film: Film, face: tuple, alpha: jax.Array) -> Film:
    """Blend one more face over the film."""
    return Film(
        tuple(old + alpha * (new - old) for old, new in zip(film.colour, face, strict=True)), film.transmission * (1.0 - alpha)
    )


def _clear_film(rays: Rays) -> Film:
    zero = jnp.zeros_like(rays.u)
    return Film((zero,) * 3, jnp.ones_like(rays.u))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _blend_faces(
    index: int, scene: Scene, unit: shapes.UnitShapes, rows: jax.Array, light_table: jax.Array, rays: Rays, depth: jax.Array
) -> Film:
    """Blend all faces of a mesh or a height field that face the camera, in MuJoCo's drawing order."""

    def blend_next(state: tuple) -> tuple:
        return _blend_next_face(index, scene, unit, rows, light_table, rays, depth, state)

    first = triangles.next_triangle(scene, unit, rays, depth, index, jnp.full(rays.u.shape, -1, jnp.int32))
    return jax.lax.while_loop(lambda state: jnp.any(state[1][1] >= 0), blend_next, (_clear_film(rays), first))[0]


def _blend_next_face(
    index: int,
    scene: Scene,
    unit: shapes.UnitShapes,
    rows: jax.Array,
    light_table: jax.Array,
    rays: Rays,
    depth: jax.Array,
    state: tuple,
) -> tuple:
    """Blend the next face over the film; return it with the depths and rows of the following triangles."""
    film, (t, triangle) = state
    visible = triangle >= 0
    row = lookup.read_row(rows[index])
    hit = surface.intersect(scene, row, lookup.fetch_triangle(scene, triangle), rays, jnp.where(visible, t, 1.0))
    film = _add_face(film, *face_colour(scene, unit, light_table, Sheet(index, row, hit, visible), rays))
    # Pixels without a triangle get none in later steps either.
    after = jnp.where(visible, triangle, jnp.iinfo(jnp.int32).max - 1)
    return film, triangles.next_triangle(scene, jax.lax.stop_gradient(unit), rays, depth, index, after)


@_blend_faces.defjvp
def _blend_faces_jvp(index: int, primals: tuple, tangents: tuple) -> tuple[Film, Film]:
    """Differentiate through the first faces only, since a loop with a data-dependent length cannot be transposed."""

    def blend_first(scene: Scene, unit: shapes.UnitShapes, *others: Any) -> Film:
        rows, light_table, rays, depth = others
        frozen = jax.lax.stop_gradient(unit)
        none = jnp.full(rays.u.shape, -1, jnp.int32)

        def blend_next(state: tuple, _: None) -> tuple:
            return _blend_next_face(index, scene, unit, rows, light_table, rays, depth, state), None

        first = triangles.next_triangle(scene, frozen, rays, depth, index, none)
        return jax.lax.scan(blend_next, (_clear_film(rays), first), None, length=_MAX_GRADIENT_FACES)[0][0]

    return _blend_faces(index, *primals), jax.jvp(blend_first, primals, tangents)[1]
