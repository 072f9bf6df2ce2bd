"""Minimum number of arithmetic operations of an image: the renderer's own functions under perfect culling.

The compiler's count is not a substitute: it includes tests that a kernel skips, and nothing inside a kernel. Every operation
on a pixel counts as one (a fused multiply-add as two, a square root as one): once per pixel and object that must be tested, and
once per pixel for depth, normal, texture and colour. Work done once per environment is not counted.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import Scene, camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.pixel import lights, lookup, raycast, shade, shapes, surface

# Number of traced pixels: a size that no other axis has.
_PIXELS = 7919
# Copies, views and indexing, which are not arithmetic.
_MOVES = {"broadcast_in_dim", "squeeze", "reshape", "slice", "dynamic_slice", "concatenate", "gather", "iota", "transpose"}


def operations_per_pixel(scene: Scene, tests: np.ndarray, coloured: bool = True) -> float | None:
    """Return the number of operations per pixel of an image.

    Args:
        scene: Scene; the cost of haze, shadows and transparent objects is not included.
        tests: [ngeom] float, tests per pixel of each geom, see `models.needed_tests`.
        coloured: Whether to count shading in addition to depth, which the tests themselves yield.

    Returns:
        Number of operations; None for a scene with triangles, whose tests are not counted.
    """
    if {shapes.MESH, shapes.HFIELD} & set(scene.object_types):
        return None
    pixels = jax.ShapeDtypeStruct((_PIXELS,), jnp.float32)
    count = len(scene.object_ids)
    unit = shapes.UnitShapes(*(jnp.ones((count, *shape)) for shape in ((3,), (3, 3), (), (), (4,), ())))
    total = 0.0
    for row, geom in enumerate(scene.object_ids):

        def test(u: jax.Array, v: jax.Array, best: jax.Array, row: int = row) -> jax.Array:
            return jnp.minimum(best, raycast.object_key(scene, unit, row, Rays(u, v), best, raycast.code_mask(scene)))

        keys = jax.ShapeDtypeStruct((_PIXELS,), jnp.int32)
        total += float(tests[geom]) * _count(test, pixels, pixels, keys)
    total += _count(lambda u, v: camera.ray_parts(scene, Rays(u, v))[2], pixels, pixels)
    if not coloured:
        return total
    columns = lookup.object_table(scene, unit).shape[1]

    def finish(values: list[jax.Array], table: jax.Array, u: jax.Array, v: jax.Array, depth: jax.Array) -> Any:
        rays = Rays(u, v)
        row = lookup.make_row(values)
        hit = surface.intersect(scene, row, None, rays, depth)
        return hit.depth, shade.shade(scene, unit, lights.unpack(scene, table), row, hit, rays)

    table = jax.ShapeDtypeStruct((len(lights.facts(scene)), lights.COLUMNS), jnp.float32)
    return total + _count(finish, [pixels] * columns, table, pixels, pixels, pixels)


def _count(function: Callable, *arguments: Any) -> int:
    """Count the operations of a function on arrays over pixels."""
    equations = _equations(jax.make_jaxpr(function)(*arguments).jaxpr)
    return sum(equation.primitive.name not in _MOVES and _PIXELS in equation.outvars[0].aval.shape for equation in equations)


def _equations(jaxpr: Any) -> Iterator[Any]:
    """Yield the equations of a jaxpr and of the functions that it calls."""
    for equation in jaxpr.eqns:
        inner = [value for value in equation.params.values() if hasattr(value, "jaxpr") or hasattr(value, "eqns")]
        if not inner:
            yield equation
        for value in inner:
            yield from _equations(getattr(value, "jaxpr", value))
