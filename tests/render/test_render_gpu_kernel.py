"""GPU kernel renders the image of the plain renderer; run by Pallas's interpreter, so no GPU is needed."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scene import MORE_SPHERES, ORTHOGRAPHIC, small_scene

import jaxrl_vis_envs
from jaxrl_vis_envs.render import render_planes
from jaxrl_vis_envs.render.gpu import kernel
from jaxrl_vis_envs.render.gpu.tiles import tile_shape


@pytest.fixture
def with_kernel(monkeypatch):
    """Return a function that makes `render_planes` use the kernel from then on."""

    def switch() -> None:
        monkeypatch.setattr(kernel, "can_render", lambda scene, outputs: kernel.supports(scene))
        monkeypatch.setattr(kernel, "draw", functools.partial(kernel.draw, interpret=True))

    return switch


@pytest.mark.parametrize(("lens", "textured", "more"), [("", True, MORE_SPHERES), (ORTHOGRAPHIC, False, "")])
def test_kernel_renders_the_same_image(lens, textured, more, with_kernel):
    scene, poses = small_scene(lens, more, textured=textured)
    assert kernel.supports(scene)

    def draw(poses):
        return render_planes(scene, poses, segmentation=True, normals=True, distance=True)

    expected = jaxrl_vis_envs.jit(lambda: draw(poses))()
    with_kernel()
    # A batch whose second image is another one: a geom without a finite pose is not drawn.
    places = jnp.stack([poses.geom_xpos, poses.geom_xpos.at[2].set(jnp.nan)])
    # Two axes, as in training: seeds and environments.
    draw_all = jax.vmap(jax.vmap(lambda geom_xpos: draw(SimpleNamespace(**{**vars(poses), "geom_xpos": geom_xpos}))))
    drawn = jax.tree.map(lambda plane: plane[0], jaxrl_vis_envs.jit(draw_all)(places[None]))
    assert len(np.unique(np.asarray(expected.segmentation))) > 7
    for name, plane in expected._asdict().items():
        ours = np.asarray(getattr(drawn, name)[0], np.float64)
        np.testing.assert_allclose(ours, np.asarray(plane), rtol=1e-4, atol=2e-4, err_msg=name)
    assert 2 in np.asarray(drawn.segmentation[0]) and 2 not in np.asarray(drawn.segmentation[1])


def test_quantized_output_equals_quantizing_the_output(with_kernel):
    scene, poses = small_scene()
    expected = jaxrl_vis_envs.jit(lambda: render_planes(scene, poses, quantized=True).rgb)()
    with_kernel()
    drawn = jaxrl_vis_envs.jit(lambda: render_planes(scene, poses, depth=False, quantized=True))()
    assert drawn.rgb.dtype == expected.dtype == jnp.uint8 and drawn.depth is None
    np.testing.assert_allclose(np.asarray(drawn.rgb, int), np.asarray(expected, int), atol=1)


def test_the_kernel_has_the_gradients_of_the_plain_renderer(with_kernel):
    scene, poses = small_scene(height=12, width=12, few=True)

    def loss(places, colours):
        planes = render_planes(scene.replace(rgba=colours), SimpleNamespace(**{**vars(poses), "geom_xpos": places}))
        return jnp.sum(jnp.sin(planes.depth)) + jnp.sum(planes.rgb)

    expected = jaxrl_vis_envs.jit(jax.grad(loss, argnums=(0, 1)))(poses.geom_xpos, scene.rgba)
    with_kernel()
    gradients = jaxrl_vis_envs.jit(jax.grad(loss, argnums=(0, 1)))(poses.geom_xpos, scene.rgba)
    assert all(np.abs(gradient).max() > 0.1 for gradient in expected)
    for ours, theirs in zip(gradients, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("size", [8, 32, 64, 84, 100, 128, 250])
def test_tiles_cover_the_image_with_little_overhang(size):
    high, wide = tile_shape(size, size)
    drawn = -(-size // high) * -(-size // wide) * 128
    assert high * wide <= 128
    assert drawn <= max(1.3 * size * size, 128)
