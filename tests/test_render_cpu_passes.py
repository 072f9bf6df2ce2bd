"""The passes of a CPU draw what the plain renderer draws, and have its gradients."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scene import MORE_SPHERES, ORTHOGRAPHIC, small_scene

from jaxrl_vis_envs.compilation import world_jit
from jaxrl_vis_envs.render import cpu_passes, render_planes


@pytest.fixture
def plainly(monkeypatch):
    """Makes `render_planes` draw without the passes from here on."""
    return lambda: monkeypatch.setattr(cpu_passes, "takes", lambda scene: False)


@pytest.mark.parametrize(
    ("lens", "more", "options"),
    [
        ("", MORE_SPHERES, {"textured": True}),
        ("", "", {"textured": False, "shadows": True}),
        (ORTHOGRAPHIC, "", {"textured": True}),
    ],
    ids=["many", "shadows", "orthographic"],
)
def test_the_passes_draw_the_same_picture(lens, more, options, plainly):
    scene, poses = small_scene(lens, more, height=24, width=40, **options)
    assert cpu_passes.takes(scene)

    def draw_all(places):
        def draw(geom_xpos):
            moved = SimpleNamespace(**{**vars(poses), "geom_xpos": geom_xpos})
            return render_planes(scene, moved, segmentation=True, quantized=True)

        return world_jit(jax.vmap(draw))(places)

    # A batch whose second picture is another one: a geom without a finite pose is not drawn.
    places = jnp.stack([poses.geom_xpos, poses.geom_xpos.at[2].set(jnp.nan)])
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


def test_the_passes_have_the_gradients_of_the_plain_renderer(plainly):
    scene, poses = small_scene(height=12, width=12, few=True)

    def loss(places):
        planes = render_planes(scene, SimpleNamespace(**{**vars(poses), "geom_xpos": places}), quantized=True)
        return jnp.sum(jnp.sin(planes.depth))

    gradient = world_jit(jax.grad(loss))(poses.geom_xpos)
    plainly()
    expected = world_jit(jax.grad(loss))(poses.geom_xpos)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-4)


def test_packed_normals_come_back():
    directions = jax.random.normal(jax.random.key(0), (3, 1000)) * jnp.array([[1e-3], [1.0], [30.0]])
    found = jnp.stack(cpu_passes._unpack_normal(cpu_passes._pack_normal(tuple(directions))))
    np.testing.assert_allclose(found, directions / jnp.linalg.norm(directions, axis=0), atol=1e-4)
