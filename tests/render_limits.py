"""Scenes whose images by our renderer differ from MuJoCo's, as listed in docs/renderer.md; their camera is called `cam`."""

from typing import NamedTuple

_FLOOR = '<geom type="plane" size="2 2 .5" rgba=".7 .7 .6 1"/>'
_LAMP = '<light pos="0 -1 3" dir="0 .3 -1" diffuse=".6 .6 .6"/>'
_CAMERA = '<camera name="cam" pos="0 -1.6 1.1" xyaxes="1 0 0 0 .55 .83"/>'
_SKY = '<texture type="skybox" builtin="gradient" rgb1=".4 .6 .9" rgb2=".1 .1 .2" width="64" height="64"/>'


class Limit(NamedTuple):
    """Scene: its caption, its MJCF, and True for ``effects`` if MuJoCo renders shadows and reflections in it."""

    title: str
    xml: str
    effects: bool = False


def _scene(body: str, assets: str = "", more: str = "", lamp: str = _LAMP, camera: str = _CAMERA, floor: str = _FLOOR) -> str:
    return (
        f'<mujoco>{more}<statistic extent="2" center="0 0 0"/><asset>{assets}</asset>'
        f"<worldbody>{lamp}{floor}{camera}{body}</worldbody></mujoco>"
    )


LIMITS = {
    "spot": Limit(
        "edge of a spot light",
        _scene("", lamp='<light pos=".3 -.2 1.5" dir="-.1 .2 -1" diffuse=".8 .8 .7" cutoff="20" exponent="1"/>'),
    ),
    "seams": Limit(
        "faces of a cube texture",
        _scene(
            '<geom type="sphere" size=".4" pos="0 0 .4" material="c" euler="20 30 10"/>',
            '<texture name="c" type="cube" builtin="flat" mark="edge" rgb1=".8 .3 .2" markrgb="1 1 1" width="32" height="32"/>'
            '<material name="c" texture="c"/>',
        ),
    ),
    "reflections": Limit(
        "reflections, shadows",
        _scene(
            '<geom type="box" size=".2 .2 .2" pos="0 .2 .25" rgba=".8 .2 .2 1"/>',
            '<material name="m" reflectance=".5" rgba=".3 .4 .5 1"/>',
            floor='<geom type="plane" size="2 2 .1" material="m"/>',
        ),
        effects=True,
    ),
    "points": Limit(
        "point light (without the switch)",
        _scene(
            '<geom type="sphere" size=".3" pos="0 0 .3" rgba=".8 .3 .3 1"/>',
            lamp='<light type="point" pos=".5 -1 1.5" diffuse=".7 .7 .7"/>',
        ),
    ),
    "sky": Limit(
        "beyond the sky",
        _scene(
            '<geom type="box" size="1 .3 2" pos="-2 12 1" rgba=".7 .3 .3 1"/>'
            '<geom type="box" size=".6 .3 1" pos="2 7 1" rgba=".3 .7 .3 1"/>',
            _SKY,
            '<visual><map zfar="8"/></visual>',
            camera='<camera name="cam" pos="0 -1 1.5" xyaxes="1 0 0 0 .1 1"/>',
            floor='<geom type="plane" size="0 0 .5" rgba=".6 .6 .5 1"/>',
        ),
    ),
    "floor": Limit(
        "an endless floor, far out",
        _scene(
            '<geom type="sphere" size=".3" pos="31 0 .3" rgba=".8 .3 .3 1"/>',
            '<texture name="c" type="2d" builtin="checker" rgb1=".8 .8 .8" rgb2=".3 .3 .3" width="64" height="64"/>'
            '<material name="c" texture="c" texrepeat="2 2" texuniform="true"/>',
            '<visual><map zfar="15"/></visual>',
            lamp='<light type="directional" dir="0 .3 -1"/>',
            camera='<camera name="cam" pos="31 -1.6 1.1" xyaxes="1 0 0 0 .55 .83"/>',
            floor='<geom type="plane" size="0 0 .1" material="c"/>',
        ),
    ),
    "backs": Limit(
        "a plane from behind, plane_backs=False",
        _scene(
            '<geom type="plane" size=".5 .5 .1" pos="0 0 .3" euler="-110 0 0" rgba=".2 .5 .9 1"/>'
            '<geom type="sphere" size=".2" pos="0 .4 .3" rgba=".8 .3 .3 1"/>'
        ),
    ),
}
