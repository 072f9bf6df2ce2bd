"""Small scene with a bit of everything that the fast implementations support."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import mujoco

from jaxrl_vis_envs.render import Scene

# Every type, every light with a place of its own, a ball behind the camera and one around it; tiles hang over the image.
_SCENE = """
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
{objects}
    {more}
  </worldbody>
</mujoco>
"""
_ALL = """
    <geom type="plane" size=".4 .3 1" pos="-.6 .6 .8" euler="70 0 20" rgba=".9 .4 .5 1"/>
    <geom type="sphere" size=".2" pos="-.5 -.2 .3" material="faces"/>
    <geom type="sphere" size=".3" pos="0 -4 1" rgba="1 0 0 1"/>
    <geom type="sphere" size=".4" pos="0 -2.2 1.1" rgba="0 0 1 1"/>
    <geom type="capsule" size=".1 .2" pos="0 0 .4" euler="30 20 0" rgba="0 1 0 1"/>
    <geom type="ellipsoid" size=".1 .2 .3" pos=".5 .1 .4" euler="0 40 10" rgba="0 0 1 1"/>
    <geom type="cylinder" size=".15 .2" pos=".2 -.5 .25" euler="50 0 0" material="checks"/>
    <geom type="box" size=".1 .15 .2" pos="-.1 .4 .5" euler="20 30 40" material="faces"/>
    <site name="mark" type="box" size=".05 .05 .05" pos="-.3 -.6 .3" rgba="1 0 1 1"/>
"""
# As much as gradients need: what is textured, what is not, and what hides another.
_FEW = """
    <geom type="sphere" size=".2" pos="-.5 -.2 .3" material="faces"/>
    <geom type="capsule" size=".1 .2" pos="-.4 0 .4" euler="30 20 0" rgba="0 1 0 1"/>
"""


# A height at which no pixel's middle lies exactly between two texels: there the last bit decides.
ORTHOGRAPHIC = 'projection="orthographic" fovy="1.9"'
# With these there are more objects than bits in a word.
MORE_SPHERES = "\n".join(
    f'<geom type="sphere" size=".04" pos="{0.2 * x - 0.5} {0.2 * y - 0.4} .7"/>' for x in range(6) for y in range(6)
)


def small_scene(
    lens: str = "", more: str = "", height: int = 22, width: int = 37, few: bool = False, **scene_options: Any
) -> tuple[Scene, SimpleNamespace]:
    mj_model = mujoco.MjModel.from_xml_string(_SCENE.format(lens=lens, objects=_FEW if few else _ALL, more=more))
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    names = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat", "xpos", "xmat", "xipos")
    poses = SimpleNamespace(**{name: jnp.asarray(getattr(mj_data, name), jnp.float32) for name in names})
    return Scene.from_mjmodel(mj_model, "front", height, width, site_groups=(0,), **scene_options), poses
