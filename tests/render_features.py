"""Small scenes, each of which shows one thing that the renderer can do: a type of geom, of light, of texture, of camera.

All have a floor, things on mocap bodies called ``thing...`` and a camera on a mocap body called ``eye``, so that poses can be
drawn at random (see `render_models.set_pose`). Lengths in metres.
"""

import dataclasses

_SUN = '<light directional="true" dir=".3 .4 -1" diffuse=".4 .35 .3" specular=".2 .2 .2"/>'
_FLOOR = '<geom name="floor" type="plane" size="0 0 .1" rgba=".6 .5 .4 1"/>'


@dataclasses.dataclass(frozen=True)
class Feature:
    """Parts of a scene's XML.

    Attributes:
        sheet: The page of docs/renderer/ that shows it.
        title: What it shows, for people.
        things: Attributes of one geom each, without the position.
        assets: Inside ``<asset>``.
        world: Inside ``<worldbody>``: lights and what does not move.
        camera: Attributes of the camera.
        visual: Inside ``<visual>``.
        extra: Further bodies.
    """

    sheet: str
    title: str
    things: tuple[str, ...]
    assets: str = ""
    world: str = _SUN + _FLOOR
    camera: str = 'fovy="50"'
    visual: str = ""
    extra: str = ""


_MATERIALS = """
    <texture type="skybox" builtin="gradient" rgb1=".9 .6 .2" rgb2=".1 .2 .5" width="256" height="256"/>
    <material name="shiny" rgba=".2 .6 .3 1" specular=".9" shininess=".4"/>
    <material name="glowing" rgba=".3 .2 .7 1" emission=".5" specular=".2" shininess=".1"/>
"""

_PLACES = ((-0.3, -0.25, 0.4), (0.3, -0.2, 0.35), (0.0, 0.3, 0.45), (-0.35, 0.35, 0.3), (0.4, 0.3, 0.5), (0.0, -0.05, 0.65))

_MIXED = (
    'type="sphere" size=".15" material="shiny"',
    'type="capsule" size=".08 .15" rgba=".9 .1 .1 1"',
    'type="ellipsoid" size=".08 .14 .2" material="glowing"',
    'type="cylinder" size=".1 .12" rgba=".1 .7 .8 1"',
    'type="box" size=".09 .12 .16"',
    'type="plane" size=".2 .15 .1" rgba=".8 .8 .2 1"',
)

FEATURES: dict[str, Feature] = {
    "primitives": Feature("geoms", "every primitive", _MIXED, _MATERIALS),
}


def scene_xml(feature: Feature) -> str:
    """The scene as MJCF."""
    things = "\n".join(
        f'<body name="thing{number}" mocap="true" pos="{x} {y} {z}"><geom name="thing{number}" {attributes}/></body>'
        for number, (attributes, (x, y, z)) in enumerate(zip(feature.things, _PLACES, strict=False))
    )
    return f"""
<mujoco>
  <visual><map znear="0.005" zfar="20"/>{feature.visual}</visual>
  <statistic extent="1" center="0 0 .35"/>
  <asset>{feature.assets}</asset>
  <worldbody>
    {feature.world}
    {things}
    {feature.extra}
    <body name="eye" mocap="true" pos="0 -1.5 1"><camera name="eye" {feature.camera}/></body>
  </worldbody>
</mujoco>
"""
