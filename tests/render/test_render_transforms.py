"""Renderer under JAX transformations: vmap of scan, scan of vmap, donation, several devices; and its memory use."""

import os
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxrl_vis_envs
from jaxrl_vis.bench.scenes.program_memory import largest_temporary
from jaxrl_vis_envs.render import Scene, quantize, render_planes

POSES = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "xpos", "xmat")
XML = """
<mujoco>
  <statistic extent="1"/>
  <asset><mesh name="m" vertex="-.2 -.2 0 .2 -.2 0 .2 .2 0 -.2 .2 0 0 0 .3"/></asset>
  <worldbody>
    <light directional="true" dir=".3 .3 -1"/>
    <geom type="plane" size="1 1 .1"/>
    <geom type="sphere" size=".15" pos=".2 0 .4"/>
    <geom type="{kind}" size=".15 .1 .1" {mesh} pos="-.2 0 .3" rgba=".8 .3 .2 {alpha}"/>
    <camera name="eye" pos="0 -1.2 1" xyaxes="1 0 0 0 .6 .8"/>
  </worldbody>
</mujoco>
"""
SIZE = 16


def setting(kind: str, alpha: float = 1.0, size: int = SIZE) -> tuple[Scene, dict]:
    mesh = 'mesh="m"' if kind == "mesh" else ""
    mj_model = mujoco.MjModel.from_xml_string(XML.format(kind=kind, mesh=mesh, alpha=alpha))
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    return Scene.from_mjmodel(mj_model, "eye", size, size), {name: jnp.asarray(getattr(mj_data, name)) for name in POSES}


def image(scene: Scene, poses: dict, height, quantized: bool = False):
    """Render RGB-D, [4, H, W], with everything raised by ``height``; if quantised, colours are converted to bytes first."""
    lifted = poses | {"geom_xpos": poses["geom_xpos"].at[1:, 2].add(height)}
    planes = render_planes(scene, SimpleNamespace(**lifted), quantized=quantized)
    rgb = planes.rgb / 255.0 if quantized else planes.rgb
    return jnp.concatenate([rgb, planes.depth[None]])


@pytest.mark.parametrize(("kind", "rgb"), [("mesh", False), ("capsule", True)])
def test_images_are_the_same_with_64_bit_jax(kind, rgb):
    def draw():
        scene, poses = setting(kind)
        poses = {name: jnp.asarray(value, float) for name, value in poses.items()}

        @jaxrl_vis_envs.jit
        def planes(poses, rgba):
            changed = scene.replace(rgba=rgba)
            return render_planes(changed, SimpleNamespace(**poses), rgb=rgb, segmentation=True, quantized=rgb)

        return planes(poses, jnp.asarray(scene.rgba, float))

    expected = draw()
    with jax.enable_x64(True):
        assert jnp.zeros(()).dtype == jnp.float64
        drawn = draw()
    for name in ("depth", "segmentation", *(["rgb"] if rgb else [])):
        ours, theirs = getattr(drawn, name), getattr(expected, name)
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(np.asarray(ours, float), np.asarray(theirs, float), atol=1e-5, rtol=1e-5, err_msg=name)


@pytest.mark.parametrize(
    ("kind", "alpha", "quantized", "size"),
    [("capsule", 1.0, False, SIZE), ("capsule", 1.0, True, 48), ("capsule", 0.4, False, SIZE), ("mesh", 1.0, False, SIZE)],
)
def test_vmap_of_scan_is_scan_of_vmap(kind, alpha, quantized, size):
    scene, poses = setting(kind, alpha, size)
    heights = jnp.array([[0.0, 0.05], [0.1, 0.15], [0.2, jnp.nan]])

    def draw(height):
        return image(scene, poses, height, quantized)

    @jaxrl_vis_envs.jit
    def vmap_of_scan(heights):
        return jax.vmap(lambda row: jax.lax.scan(lambda carry, h: (carry, draw(h)), None, row)[1])(heights)

    @jaxrl_vis_envs.jit
    def scan_of_vmap(heights):
        return jax.lax.scan(lambda carry, h: (carry, jax.vmap(draw)(h)), None, heights.T)[1]

    left, right = vmap_of_scan(heights), jnp.moveaxis(scan_of_vmap(heights), 0, 1)
    assert np.all(np.isfinite(left))
    assert np.mean(np.abs(left - right) < 1e-4) > 0.998
    images = np.asarray(left).reshape(6, -1)
    assert len(np.unique(images, axis=0)) == 6


def test_donated_buffers_are_reused():
    scene, poses = setting("mesh")

    def step(state):
        height, frames = state
        frame = quantize(image(scene, poses, height)[:3])
        return height + 0.1, jax.lax.dynamic_update_index_in_dim(frames, frame, jnp.int32(height * 10 + 0.5), 0)

    donating = jaxrl_vis_envs.jit(step, donate_argnums=0)
    state = (jnp.float32(0.0), jnp.zeros((3, 3, SIZE, SIZE), jnp.uint8))
    before = state[1]
    for _ in range(3):
        state = donating(state)
    assert before.is_deleted()
    assert len(np.unique(np.asarray(state[1]).reshape(3, -1), axis=0)) == 3


SHARDED = f"""
import sys
sys.path[:0] = [{__file__.rsplit("/", 1)[0]!r}, {__file__.rsplit("/", 2)[0]!r}]
import jax, numpy as np
from test_render_transforms import image, setting
import jaxrl_vis_envs
from jax.sharding import PartitionSpec
assert len(jax.devices()) == 2
if jax.__version_info__ >= (0, 11):  # see docs/scaling.md
    jax.config.update("jax_use_shardy_partitioner", False)
heights = np.linspace(0.0, 0.3, 4, dtype=np.float32)
mesh = jax.sharding.Mesh(np.array(jax.devices()), ("envs",))
spec = PartitionSpec("envs")
for kind, size, quantized in (("mesh", 16, False), ("capsule", 48, True)):
    scene, poses = setting(kind, size=size)
    drawn = jax.vmap(lambda height: image(scene, poses, height, quantized))
    sharded = jaxrl_vis_envs.jit(jax.shard_map(drawn, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))(heights)
    assert len(sharded.sharding.device_set) == 2
    np.testing.assert_allclose(sharded, jaxrl_vis_envs.jit(drawn)(heights), atol=1e-4)
    print(kind, "same")
"""


def test_shard_map_over_two_devices(clean_environment):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    environment = {**clean_environment, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", SHARDED], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.split() == ["mesh", "same", "capsule", "same"]


@pytest.mark.parametrize(("kind", "quantized"), [("capsule", False), ("capsule", True), ("mesh", False)])
def test_no_temporary_is_larger_than_twice_the_image(kind, quantized):
    scene, poses = setting(kind, size=64)

    def draw(height):
        lifted = poses | {"geom_xpos": poses["geom_xpos"].at[1:, 2].add(height)}
        planes = render_planes(scene, SimpleNamespace(**lifted), quantized=quantized)
        return planes.rgb, planes.depth

    compiled = jaxrl_vis_envs.jit(jax.vmap(draw)).lower(jax.ShapeDtypeStruct((4096,), jnp.float32)).compile()
    output = 4096 * 64 * 64 * (7 if quantized else 16)
    largest = largest_temporary(compiled)
    assert 4096 * 64 * 64 <= largest <= 2 * output
    # All of them together: keys, triangles, and the planes before they are put together.
    assert compiled.memory_analysis().temp_size_in_bytes <= 4 * output
