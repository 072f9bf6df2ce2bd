"""Scene of meshes, a height field and primitives."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis.bench.scenes import clutter
from jaxrl_vis_envs.render import Scene

SIZE = (21, 30)  # tiles hang over the image

_SCENE = """
<mujoco>
  <visual><headlight active="0"/></visual>
  <asset>
    <texture name="checks" type="2d" builtin="checker" rgb1=".9 .8 .6" rgb2=".2 .3 .5" width="32" height="32"/>
    <material name="checks" texture="checks"/><material name="glass" rgba=".2 .9 .4 .5"/>
    <mesh name="tetra" vertex="0 0 0  .2 0 0  0 .2 0  0 0 .2"/>
    <hfield name="ground" nrow="3" ncol="3" size=".4 .3 .2 .1" elevation="0 1 0 1 2 1 0 1 0"/>
  </asset>
  <worldbody>
    <camera name="front" pos="0 -1.6 .9" xyaxes="1 0 0 0 .5 .87" {lens}/>
    <light type="directional" dir=".5 .6 -1" ambient=".3 .3 .3" diffuse=".5 .4 .3" castshadow="true"/>
    <geom type="plane" size="3 3 .1" material="checks"/>
    <geom type="capsule" size=".06 .2" pos="-.4 0 .2" euler="60 0 20" rgba="1 0 0 1"/>
    <geom type="box" size=".1 .1 .1" pos=".5 -.3 .1" rgba="0 0 1 1"/>
    <geom type="hfield" hfield="ground" pos=".3 .6 .2" rgba=".5 .8 .3 1"/>
    <geom type="sphere" size=".1" pos="0 .1 .7" {glass}/>
    <geom name="veil" type="mesh" mesh="tetra" pos="-.4 -1 .6" {glass}/>
    {more}
  </worldbody>
</mujoco>
"""


def spec_of_scene(lens: str, glass: str, more: str) -> mujoco.MjSpec:
    """Build a scene of primitives, a height field and 41 meshes, of which one is at the near plane and two coincide."""
    spec = mujoco.MjSpec.from_string(_SCENE.format(lens=lens, glass=glass, more=more))
    rng = np.random.default_rng(0)
    for number in range(4):
        points, faces = clutter.mesh(number, rng)
        kept = np.unique(faces[::3])  # some of the corners, of which MuJoCo takes the hull
        spec.add_mesh(name=f"lump{number}", uservert=3.0 * points[kept[::40]].ravel())
    kind = mujoco.mjtGeom.mjGEOM_MESH
    for index in range(37):
        turn, place = rng.normal(size=4), [*rng.uniform(-0.7, 0.7, 2), rng.uniform(0.1, 0.6)]
        quat, rgba = turn / np.linalg.norm(turn), [*rng.uniform(0.2, 1.0, 3), 1.0]
        spec.worldbody.add_geom(type=kind, meshname=f"lump{index % 4}", pos=place, quat=quat, rgba=rgba)
    for name in ("earlier", "later"):
        spec.worldbody.add_geom(name=name, type=kind, meshname="lump0", pos=[0.0, -0.9, 0.3])
    spec.worldbody.add_geom(name="close", type=kind, meshname="tetra", pos=[0.02, -1.56, 0.84])
    return spec


def prepared(lens: str = "", glass: str = "", more: str = "", **options: Any) -> tuple[Scene, mujoco.MjModel, SimpleNamespace]:
    """Return the scene, its model, and its poses, as arrays.

    Args:
        lens: Attributes of the camera.
        glass: Attributes of a ball and a mesh.
        more: Further elements of the world.
        **options: Options of `Scene.from_mjmodel`.
    """
    mj_model = spec_of_scene(lens, glass, more).compile()
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    poses = {name: jnp.asarray(getattr(mj_data, name), jnp.float32) for name in ("geom_xpos", "geom_xmat", "xpos", "xmat")}
    size = dict(zip(("height", "width"), SIZE, strict=True))
    return Scene.from_mjmodel(mj_model, "front", **{**size, **options}), mj_model, SimpleNamespace(**poses)
