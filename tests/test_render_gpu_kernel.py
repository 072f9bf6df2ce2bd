"""The GPU kernel draws what the plain renderer draws; run by Pallas's interpreter, so no GPU is needed."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxrl_vis_envs.render import Scene, gpu_kernel, render_planes

# Every type, every light with a place of its own, a ball behind the camera and one around it; tiles hang over the picture.
_OBJECTS = """
<mujoco>
  <asset>
    <texture name="checks" type="2d" builtin="checker" rgb1=".9 .8 .6" rgb2=".2 .3 .5" width="32" height="32"/>
    <texture name="faces" type="cube" builtin="gradient" rgb1="1 .8 .1" rgb2=".1 .1 .7" width="32" height="192"/>
    <texture name="sky" type="skybox" builtin="checker" rgb1=".5 .7 .9" rgb2="0 .1 .2" width="32" height="192"/>
    <material name="checks" texture="checks" texrepeat="3 2" texuniform="true"/>
    <material name="faces" texture="faces"/>
  </asset>
  <visual><headlight ambient=".2 .2 .2" diffuse=".4 .4 .4" specular=".3 .3 .3"/></visual>
  <worldbody>
    <camera name="front" pos="0 -2.2 1" xyaxes="1 0 0 0 .35 .94" {lens}/>
    <light type="directional" dir="1 1 -2" diffuse=".3 .2 .1"/>
    <light type="spot" pos="0 -1 2" dir="0 .5 -1" cutoff="40" exponent="5" attenuation="1 .1 .05"/>
    <light type="point" pos="1 -1 1" specular=".5 .5 .5"/>
    <geom type="plane" size="0 0 1" material="checks"/>
    <geom type="plane" size=".4 .3 1" pos="-.6 .6 .8" euler="70 0 20" rgba=".9 .4 .5 1"/>
    <geom type="sphere" size=".2" pos="-.5 -.2 .3" material="faces"/>
    <geom type="sphere" size=".3" pos="0 -4 1" rgba="1 0 0 1"/>
    <geom type="sphere" size=".4" pos="0 -2.2 1.1" rgba="0 0 1 1"/>
    <geom type="capsule" size=".1 .2" pos="0 0 .4" euler="30 20 0" rgba="0 1 0 1"/>
    <geom type="ellipsoid" size=".1 .2 .3" pos=".5 .1 .4" euler="0 40 10" rgba="0 0 1 1"/>
    <geom type="cylinder" size=".15 .2" pos=".2 -.5 .25" euler="50 0 0" material="checks"/>
    <geom type="box" size=".1 .15 .2" pos="-.1 .4 .5" euler="20 30 40" material="faces"/>
    <site name="mark" type="box" size=".05 .05 .05" pos="-.3 -.6 .3" rgba="1 0 1 1"/>
    {more}
  </worldbody>
</mujoco>
"""


def small_scene(
    lens: str = "", more: str = "", height: int = 22, width: int = 37, textured: bool = False
) -> tuple[Scene, SimpleNamespace]:
    mj_model = mujoco.MjModel.from_xml_string(_OBJECTS.format(lens=lens, more=more))
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    names = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat", "xpos", "xmat", "subtree_com")
    poses = SimpleNamespace(**{name: jnp.asarray(getattr(mj_data, name), jnp.float32) for name in names})
    return Scene.from_mjmodel(mj_model, "front", height, width, site_groups=(0,), textured=textured), poses


@pytest.fixture
def with_kernel(monkeypatch):
    """Makes `render_planes` take the kernel from here on."""

    def switch() -> None:
        monkeypatch.setattr(gpu_kernel, "takes", gpu_kernel.supports)
        monkeypatch.setattr(gpu_kernel, "draw", functools.partial(gpu_kernel.draw, interpret=True))

    return switch


_ORTHOGRAPHIC = 'projection="orthographic" fovy="2"'


@pytest.mark.parametrize(("lens", "textured", "many"), [("", True, True), (_ORTHOGRAPHIC, False, False)])
def test_the_kernel_draws_the_same_picture(lens, textured, many, with_kernel):
    more = ""
    if many:  # more objects than bits in a word
        grid = [(x, y) for x in range(6) for y in range(6)]
        more = "\n".join(f'<geom type="sphere" size=".04" pos="{0.2 * x - 0.5} {0.2 * y - 0.4} .7"/>' for x, y in grid)
    scene, poses = small_scene(lens, more, textured=textured)
    assert gpu_kernel.supports(scene)

    def draw(poses):
        return render_planes(scene, poses, segmentation=True, normals=True, distance=True)

    expected = draw(poses)
    with_kernel()
    # A batch whose second picture is another one: a geom without a finite pose is not drawn.
    places = jnp.stack([poses.geom_xpos, poses.geom_xpos.at[2].set(jnp.nan)])
    # Two axes, as in training: seeds and environments.
    draw_all = jax.vmap(jax.vmap(lambda geom_xpos: draw(SimpleNamespace(**{**vars(poses), "geom_xpos": geom_xpos}))))
    drawn = jax.tree.map(lambda plane: plane[0], draw_all(places[None]))
    assert len(np.unique(np.asarray(expected.segmentation))) > 7
    for name, plane in expected._asdict().items():
        ours = np.asarray(getattr(drawn, name)[0], np.float64)
        np.testing.assert_allclose(ours, np.asarray(plane), rtol=1e-4, atol=2e-4, err_msg=name)
    assert 2 in np.asarray(drawn.segmentation[0]) and 2 not in np.asarray(drawn.segmentation[1])


def test_quantized_colours_are_the_quantized_colours(with_kernel):
    scene, poses = small_scene()
    expected = render_planes(scene, poses, quantized=True).rgb
    with_kernel()
    drawn = render_planes(scene, poses, depth=False, quantized=True)
    assert drawn.rgb.dtype == expected.dtype == jnp.uint8 and drawn.depth is None
    np.testing.assert_allclose(np.asarray(drawn.rgb, int), np.asarray(expected, int), atol=1)


def test_the_kernel_has_the_gradients_of_the_plain_renderer(with_kernel):
    scene, poses = small_scene(height=12, width=12)

    def loss(places, colours):
        planes = render_planes(scene.replace(rgba=colours), SimpleNamespace(**{**vars(poses), "geom_xpos": places}))
        return jnp.sum(jnp.sin(planes.depth)) + jnp.sum(planes.rgb)

    expected = jax.grad(loss, argnums=(0, 1))(poses.geom_xpos, scene.rgba)
    with_kernel()
    gradients = jax.grad(loss, argnums=(0, 1))(poses.geom_xpos, scene.rgba)
    assert all(np.abs(gradient).max() > 0.1 for gradient in expected)
    for ours, theirs in zip(gradients, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("size", [8, 32, 64, 84, 100, 128, 250])
def test_tiles_cover_the_picture_and_little_else(size):
    high, wide = gpu_kernel.tile_shape(size, size)
    drawn = -(-size // high) * -(-size // wide) * 128
    assert high * wide <= 128
    assert drawn <= max(1.3 * size * size, 128)
