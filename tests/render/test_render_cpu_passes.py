"""CPU passes render the image of the plain renderer, with its gradients."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scene import MORE_SPHERES, ORTHOGRAPHIC, small_scene

import jaxrl_vis_envs
from jaxrl_vis_envs.render import camera, render_planes
from jaxrl_vis_envs.render.cpu import packing, passes, tiles
from jaxrl_vis_envs.render.outputs import Outputs
from jaxrl_vis_envs.render.pixel import arithmetic
from jaxrl_vis_envs.render.pixel.prepare import prepare


@pytest.fixture
def plainly(monkeypatch):
    """Return a function that makes `render_planes` ignore the passes from then on."""
    return lambda: monkeypatch.setattr(passes, "can_render", lambda scene, outputs: False)


@pytest.mark.parametrize(
    ("lens", "more", "shape", "options"),
    [
        ("", MORE_SPHERES, (24, 40), {"textured": True}),
        ("", "", (24, 40), {"textured": False, "shadows": True}),
        # Large enough for tiles, which hang over the border.
        (ORTHOGRAPHIC, "", (50, 53), {"textured": True}),
    ],
    ids=["many", "shadows", "orthographic"],
)
def test_passes_render_the_same_image(lens, more, shape, options, plainly):
    height, width = shape
    scene, poses = small_scene(lens, more, height, width, **options)
    assert passes.can_render(scene, Outputs(rgb=True, depth=True, segmentation=True, quantized=True))

    def draw_all(places):
        def draw(geom_xpos):
            moved = SimpleNamespace(**{**vars(poses), "geom_xpos": geom_xpos})
            return render_planes(scene, moved, segmentation=True, quantized=True)

        return jaxrl_vis_envs.jit(jax.vmap(draw))(places)

    # A batch whose second image is another one: a geom without a finite pose is not drawn. In the third, the capsule is alone
    # in its corner.
    moved = poses.geom_xpos.at[5].set(jnp.array([0.7, 1.0, 0.9]))
    places = jnp.stack([poses.geom_xpos, poses.geom_xpos.at[2].set(jnp.nan), moved])
    drawn = draw_all(places)
    plainly()
    expected = draw_all(places)
    assert drawn.rgb.dtype == expected.rgb.dtype == jnp.uint8
    np.testing.assert_array_equal(drawn.segmentation, expected.segmentation)
    np.testing.assert_allclose(drawn.depth, expected.depth, rtol=1e-5)
    difference = np.abs(np.asarray(drawn.rgb, int) - np.asarray(expected.rgb, int))
    # Colours of textures are rounded to 1/1023 on the way, an eighth of a grey level, and so few others round differently.
    assert difference.max() <= 1 and difference.mean() <= 0.125
    assert len(np.unique(np.asarray(drawn.segmentation[0]))) > 7
    assert 2 in np.asarray(drawn.segmentation[0]) and 2 not in np.asarray(drawn.segmentation[1])
    alone = np.asarray(drawn.segmentation[2]) == 5
    assert alone.sum() >= 8 and not np.any(np.asarray(drawn.segmentation[:2])[:, alone] == 5)


def test_once_runs_for_the_whole_batch_or_not_at_all():
    """The loop has zero or one iterations, also in a batch, whose condition is one for all."""

    def double(flags, x):
        seen = tiles._anywhere(flags)
        return jnp.stack([tiles.once(flag, lambda zero: 2 * x + zero, x) for flag in seen])

    flags = jnp.array([[False, True, False], [False, False, True]])
    np.testing.assert_array_equal(jax.vmap(double)(flags, jnp.array([3, 5])), [[3, 6, 6], [5, 10, 10]])
    np.testing.assert_array_equal(double(flags[0], jnp.int32(3)), [3, 6, 3])
    nested = jax.vmap(jax.vmap(double))(flags[None, :, :], jnp.array([[3, 5]]))
    np.testing.assert_array_equal(nested, [[[3, 6, 6], [5, 10, 10]]])


def test_visible_objects_are_in_their_tiles_masks():
    scene, poses = small_scene(height=64, width=64)
    layout = tiles.layout(scene)
    rays = camera.pixel_rays(scene, layout.rows, layout.columns)
    seen = np.asarray(tiles.visible_in_tiles(scene, prepare(scene, poses).unit, rays))
    labels = np.asarray(render_planes(scene, poses, rgb=False, segmentation=True).segmentation)
    for tile, (rows, columns) in enumerate(zip(layout.rows, layout.columns, strict=True)):
        shown = set(labels[rows, columns].tolist()) - {-1}
        assert shown <= {scene.object_ids[row] for row in np.flatnonzero(seen[tile])}
    # It is worth it: a tile has less than half of the objects in it.
    assert seen.mean() < 0.5


def test_the_passes_have_the_gradients_of_the_plain_renderer(plainly):
    scene, poses = small_scene(height=12, width=12, few=True)

    def loss(places):
        planes = render_planes(scene, SimpleNamespace(**{**vars(poses), "geom_xpos": places}), quantized=True)
        return jnp.sum(jnp.sin(planes.depth))

    gradient = jaxrl_vis_envs.jit(jax.grad(loss))(poses.geom_xpos)
    plainly()
    expected = jaxrl_vis_envs.jit(jax.grad(loss))(poses.geom_xpos)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-4)


def test_packed_normals_round_trip():
    directions = jax.random.normal(jax.random.key(0), (3, 1000)) * jnp.array([[1e-3], [1.0], [30.0]])
    found = jnp.stack(packing.unpack_normal(packing.pack_normal(tuple(directions))))
    np.testing.assert_allclose(found, directions / jnp.linalg.norm(directions, axis=0), atol=1e-4)


_powers = jax.jit(arithmetic.power)
_slopes = jax.jit(jax.vmap(jax.grad(arithmetic.power), in_axes=(0, None)))


@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0, 10.0, 64.0, 128.0])
def test_powers_are_accurate_to_a_fifth_of_a_grey_level(exponent):
    base = np.concatenate([np.linspace(0.0, 1.0, 20_001), 1.0 - np.geomspace(1e-7, 1e-2, 1000)]).astype(np.float32)
    found = _powers(base, jnp.float32(exponent))
    np.testing.assert_allclose(found, np.maximum(base, np.float64(1e-6)) ** exponent, atol=1.0 / 5 / 255)
    slope = _slopes(base[1:], jnp.float32(exponent))
    np.testing.assert_allclose(slope, exponent * np.float64(base[1:]) ** (exponent - 1.0), rtol=1e-3, atol=1e-6)
