"""Segments towards a light find every object that they meet in their cell of its grid, and few others."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrl_vis_envs.render.gpu import light_grid
from jaxrl_vis_envs.render.pixel import lights
from jaxrl_vis_envs.render.pixel.triangles import Segments

COUNT, RAYS = 300, 4000
DOWN, POSITIONS = [0.2, -0.1, -1.0], {"above": [0.3, 0.2, 3.0], "among": [0.1, 0.0, 0.5]}


def make_light(position: list[float] | None, ambient: float = 0.0) -> lights.Light:
    """Return a light at ``position``, or a directional one for None."""
    direction = jnp.asarray(DOWN, jnp.float32) / np.linalg.norm(DOWN).astype(np.float32)
    place = None if position is None else jnp.asarray(position, jnp.float32)
    colours = (jnp.full(3, ambient), jnp.ones(3), jnp.ones(3))
    return lights.Light(position is None, True, True, place, direction, *colours, jnp.asarray([1.0, 0.0, 0.0]), None, None)


def objects_of_cells(cells: light_grid.Cells) -> np.ndarray:
    """Return the mask [P, N] of each segment's objects."""
    order, words, rows = (np.asarray(array) for array in cells)
    found = np.bitwise_and.reduce(words.view(np.uint32)[rows], axis=0)
    bits = (found[:, :, None] >> np.arange(32, dtype=np.uint32) & 1).reshape(len(found), -1)
    mask = np.zeros((len(found), len(order)), bool)
    mask[:, order] = bits[:, : len(order)]
    return mask


@pytest.mark.parametrize("position", [None, *POSITIONS.values()], ids=["directional", *POSITIONS])
def test_cells_hold_every_object_that_a_segment_meets_and_few_others(position: list[float] | None) -> None:
    rng = np.random.default_rng(0)
    middle = rng.uniform([-1.0, -1.0, 0.0], [1.0, 1.0, 1.0], (COUNT, 3)).astype(np.float32)
    middle[7] = np.nan  # an object without a pose
    radius = rng.uniform(0.02, 0.12, COUNT).astype(np.float32)
    start = rng.uniform([-1.3, -1.3, -0.1], [1.3, 1.3, 1.1], (RAYS, 3))
    if position is not None:
        start[:200] = np.array(position) + rng.normal(scale=1e-3, size=(200, 3)) + [0.0, 0.0, -0.5]  # below the light
    light = make_light(position)
    offset = np.broadcast_to(-np.asarray(light.direction, np.float64), start.shape) if position is None else position - start
    distance = np.linalg.norm(offset, axis=1)
    direction = offset / distance[:, None]
    farthest = np.full(RAYS, np.inf) if position is None else distance
    farthest[-100:] = 0.0  # no segments
    segments = Segments(
        *(tuple(jnp.asarray(vector.T, jnp.float32)) for vector in (start, direction)),
        jnp.full(RAYS, 1e-4),
        jnp.asarray(farthest, jnp.float32),
    )
    cells = jax.jit(lambda given, centres: light_grid.shadow_cells(light, given, centres, radius))(segments, middle)
    held = objects_of_cells(cells)

    to_middle = middle[None].astype(np.float64) - start[:, None]
    along = np.clip(np.sum(to_middle * direction[:, None], axis=2), 0.0, farthest[:, None])
    apart = np.linalg.norm(to_middle - along[:, :, None] * direction[:, None], axis=2)
    with np.errstate(invalid="ignore"):
        meets = (apart < radius) & (farthest > 0.0)[:, None]
    assert meets.sum() > 500
    assert not (meets & ~held).any()
    assert not held[-100:].any() and not held[:, 7].any()
    assert held.sum() < 6 * meets.sum()


@pytest.mark.parametrize("cone", [False, True])
def test_a_light_adds_nothing_where_it_may_not_brighten(cone: bool) -> None:
    rng = np.random.default_rng(1)
    point, normal = rng.uniform(-1.0, 1.0, (2, 3, 500))
    normal /= np.linalg.norm(normal, axis=0)
    vectors: list[Any] = [tuple(jnp.asarray(vector, jnp.float32)) for vector in (point, normal)]

    def factors(light: lights.Light) -> np.ndarray:
        found = lights.light_factors(light, *vectors, (0.0, 0.0, 1.0), jnp.full(500, 10.0), None)
        shares = (light.ambient[0], light.diffuse[0], light.specular[0])
        return np.asarray(sum(jnp.abs(factor * share) for factor, share in zip(found, shares, strict=True)))

    light = make_light(POSITIONS["above"])
    if cone:
        light = light._replace(cosine_cutoff=jnp.float32(0.95), exponent=jnp.float32(2.0))
    brightens = np.asarray(lights.may_brighten(light, *vectors))
    assert 50 < brightens.sum() < 450
    np.testing.assert_array_equal(brightens, factors(light) > 0.0)
    with_ambient = light._replace(ambient=jnp.full(3, 0.1))
    np.testing.assert_array_equal(np.asarray(lights.may_brighten(with_ambient, *vectors)), factors(with_ambient) > 0.0)
