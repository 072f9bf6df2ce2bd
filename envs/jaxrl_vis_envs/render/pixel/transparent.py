"""Objects that let light through, laid over the opaque image as MuJoCo does it.

MuJoCo sorts them by the distance of their nearest point and draws them twice, front to back and then back to front, so that a
single sheet of alpha a covers 1 - (1 - a)^2 of what is behind it. Of those that are equally far the one that is declared first
counts as the nearer. Every face of an object that looks to the camera covers something: of a cup that is its outside and its
inside behind. In depth and segmentation what is transparent counts like any other object.
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

# What MuJoCo leaves of a plane's alpha when it is seen from behind.
_PLANE_BACK = 0.3
# What is not further behind what is opaque than this share of the depth is seen: it may be the same surface drawn twice.
_SAME = 1e-6
# So many faces of an object, one over the other, count in gradients; in images all do.
_STEEP_FACES = 8


class Sheet(NamedTuple):
    """One transparent object: its row, its columns, where it is met and where that is before all that is opaque ([P] bool)."""

    index: int
    row: lookup.Row
    hit: surface.Hit
    seen: jax.Array


class Film(NamedTuple):
    """Effect of an object on the colour c behind it: ``colour + share * c``, [P] each, the colour of three."""

    colour: tuple
    share: jax.Array


def sheets(scene: Scene, unit: shapes.UnitShapes, rows: jax.Array, rays: Rays, depth: jax.Array) -> list[Sheet]:
    """The transparent objects before ``depth`` ([P] float32, metres, of what is opaque)."""
    depth = _reach(depth)
    found = []
    for index in (index for index, clear in enumerate(scene.transparent) if clear):
        triangle = None
        if scene.object_types[index] in (shapes.MESH, shapes.HFIELD):
            frozen = jax.lax.stop_gradient(unit)
            t, triangle, _ = triangles.nearest_triangle(scene, frozen, rays, depth, only=index)
            seen = triangle >= 0
        else:
            t, meets = raycast.row_entry(scene, jax.lax.stop_gradient(unit), index, rays)
            seen = meets & (t > scene.znear) & (t < depth)
        if scene.transparent[index] == reading.CLEAR_FROM_BEHIND:
            seen = seen & raycast.behind(unit, index)
        row = lookup.read_row(rows[index])
        # A start that means nothing would be a source of NaN in gradients.
        t = jnp.where(seen, t, 1.0)
        found.append(Sheet(index, row, surface.meet(scene, row, lookup.fetch_triangle(scene, triangle), rays, t), seen))
    return found


def _reach(depth: jax.Array) -> jax.Array:
    """Distances up to which transparent objects are seen, given the depth of opaque ones, [P] metres each."""
    return jax.lax.stop_gradient(depth) * (1.0 + _SAME)


def nearest(found: list[Sheet], depth: jax.Array, index: jax.Array, normal: tuple) -> tuple[jax.Array, jax.Array, tuple]:
    """Depth, row and normal of the nearest object of all, given those of the nearest opaque one; [P] each."""
    for sheet in found:
        # Of two that are equally far, the one that is drawn later; rows are in the opposite order.
        margin = jnp.where(sheet.index < index, _SAME, -_SAME) * depth
        nearer = sheet.seen & (sheet.hit.depth < depth + margin)
        depth = jnp.where(nearer, sheet.hit.depth, depth)
        index = jnp.where(nearer, sheet.index, index)
        normal = tuple(jnp.where(nearer, new, old) for new, old in zip(sheet.hit.normal, normal, strict=True))
    return depth, index, normal


def blend(
    scene: Scene,
    unit: shapes.UnitShapes,
    rows: jax.Array,
    light_table: jax.Array,
    found: list[Sheet],
    rays: Rays,
    depth: jax.Array,
    colour: tuple,
) -> tuple:
    """The colours [P] (three) of what is opaque and ``depth`` [P] away, with the sheets laid over them."""
    if not found:
        return colour
    declared = sorted(found, key=lambda sheet: scene.object_ids[sheet.index])
    films = []
    for sheet in declared:
        if sheet.hit.triangle is None:
            film = _cover(_bare_film(rays), *_coat(scene, unit, light_table, sheet, rays))
        else:
            film = _faces(sheet.index, scene, unit, rows, light_table, rays, _reach(depth))
        films.append(jnp.stack([*film.colour, film.share]))
    stack = jnp.stack(films)
    # Stable: what is equally far stays in the order in which it was declared.
    order = jnp.argsort(unit.distance[np.array([sheet.index for sheet in declared])])
    for place in [*range(len(found)), *reversed(range(len(found)))]:
        film = stack[order[place]]
        colour = tuple(film[channel] + film[3] * c for channel, c in enumerate(colour))
    return colour


def _coat(scene: Scene, unit: shapes.UnitShapes, light_table: jax.Array, sheet: Sheet, rays: Rays) -> tuple[tuple, jax.Array]:
    """Colour and alpha of one face, [P] each; where it is not seen, alpha is 0."""
    # Only what is opaque shows shadows.
    bare = [light._replace(shadows=False) for light in lights.unpack(scene, light_table)]
    own: Any = shade.lighted(scene, unit, bare, sheet.row, sheet.hit, rays)
    alpha = scene.rgba[scene.object_ids[sheet.index], 3]
    if scene.object_types[sheet.index] == shapes.PLANE:
        alpha = jnp.where(raycast.behind(unit, sheet.index), _PLANE_BACK * alpha, alpha)
    image = None
    if scene.atlas.images[sheet.index] is not None:
        image = texturing.texture_colour(scene, sheet.row, sheet.hit, scene.atlas.alpha[sheet.index])
    if image is not None:
        own = tuple(value * texel for value, texel in zip(own, image[:3], strict=True))
        # A plane that is only clear from behind has a material that MuJoCo calls opaque; the alpha of its texture counts too.
        alpha = alpha * image[3] if scene.atlas.alpha[sheet.index] else alpha
    return own, jnp.where(sheet.seen, alpha, 0.0)


def _cover(film: Film, own: tuple, alpha: jax.Array) -> Film:
    """The film with one more face over it."""
    return Film(tuple(old + alpha * (new - old) for old, new in zip(film.colour, own, strict=True)), film.share * (1.0 - alpha))


def _bare_film(rays: Rays) -> Film:
    zero = jnp.zeros_like(rays.u)
    return Film((zero,) * 3, jnp.ones_like(rays.u))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _faces(
    index: int, scene: Scene, unit: shapes.UnitShapes, rows: jax.Array, light_table: jax.Array, rays: Rays, depth: jax.Array
) -> Film:
    """All faces of a mesh or a height field that look to the camera, in the order in which MuJoCo draws them."""

    def lay(state: tuple) -> tuple:
        return _lay_face(index, scene, unit, rows, light_table, rays, depth, state)

    first = triangles.next_triangle(scene, unit, rays, depth, index, jnp.full(rays.u.shape, -1, jnp.int32))
    return jax.lax.while_loop(lambda state: jnp.any(state[1][1] >= 0), lay, (_bare_film(rays), first))[0]


def _lay_face(
    index: int,
    scene: Scene,
    unit: shapes.UnitShapes,
    rows: jax.Array,
    light_table: jax.Array,
    rays: Rays,
    depth: jax.Array,
    state: tuple,
) -> tuple:
    """The film with the next face over it; and depths and rows of the triangles after it."""
    film, (t, triangle) = state
    seen = triangle >= 0
    row = lookup.read_row(rows[index])
    hit = surface.meet(scene, row, lookup.fetch_triangle(scene, triangle), rays, jnp.where(seen, t, 1.0))
    film = _cover(film, *_coat(scene, unit, light_table, Sheet(index, row, hit, seen), rays))
    # Where there was none there is none further on.
    after = jnp.where(seen, triangle, jnp.iinfo(jnp.int32).max - 1)
    return film, triangles.next_triangle(scene, jax.lax.stop_gradient(unit), rays, depth, index, after)


@_faces.defjvp
def _slopes(index: int, primals: tuple, tangents: tuple) -> tuple[Film, Film]:
    """Differentiate through the first faces: a loop that ends where the image says has no transpose."""

    def few(scene: Scene, unit: shapes.UnitShapes, *others: Any) -> Film:
        rows, light_table, rays, depth = others
        frozen = jax.lax.stop_gradient(unit)
        none = jnp.full(rays.u.shape, -1, jnp.int32)

        def lay(state: tuple, _: None) -> tuple:
            return _lay_face(index, scene, unit, rows, light_table, rays, depth, state), None

        first = triangles.next_triangle(scene, frozen, rays, depth, index, none)
        return jax.lax.scan(lay, (_bare_film(rays), first), None, length=_STEEP_FACES)[0][0]

    return _faces(index, *primals), jax.jvp(few, primals, tangents)[1]
