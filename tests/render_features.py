"""Small scenes, each of which shows one feature of the renderer: a type of geom, light, texture or camera.

All have a floor, things on mocap bodies called ``thing...`` and a camera on a mocap body called ``eye``, so that poses can be
sampled (see `render_models.set_pose`). Lengths in metres.
"""

import dataclasses
import io
from typing import Any

import mujoco
import numpy as np
from PIL import Image


@dataclasses.dataclass(frozen=True)
class Feature:
    """Parts of a scene's XML.

    Attributes:
        sheet: Page of docs/renderer/ that shows the feature.
        title: Title of the feature on that page.
        things: Attributes of one geom each, without the position; up to six.
        assets: Elements of ``<asset>``.
        lights: Elements of the lights.
        floor: Attributes of the floor, a geom; none if empty.
        camera: Attributes of the camera.
        visual: Elements of ``<visual>``.
        sites: Attributes of one site each, on the things' bodies.
        stand_in: Replacement (old, new) in ``lights`` for the reference image; None for none. MuJoCo's own renderer omits
            lights of type "point", but draws a spot light of cutoff 180, which is OpenGL's point light.
        eye: Position of the camera before it is moved at random, on the same side of the floor, m.
        limits: Upper bounds of measures of the comparison, where the common ones would let a fault pass.
        sizes: Sizes of the first things, set after compilation, which would refuse some of them.
    """

    sheet: str
    title: str
    things: tuple[str, ...]
    assets: str = ""
    lights: str = '<light directional="true" dir=".3 .4 -1" diffuse=".4 .35 .3" specular=".2 .2 .2"/>'
    floor: str = 'type="plane" size="0 0 .1" rgba=".6 .5 .4 1"'
    camera: str = 'fovy="50"'
    visual: str = ""
    sites: tuple[str, ...] = ()
    stand_in: tuple[str, str] | None = None
    eye: str = "0 -1.5 1"
    limits: tuple[tuple[str, float], ...] = ()
    sizes: tuple[tuple[float, float, float], ...] = ()


_PLACES = ((-0.3, -0.25, 0.4), (0.3, -0.2, 0.35), (0.0, 0.3, 0.45), (-0.35, 0.35, 0.3), (0.4, 0.3, 0.5), (0.0, -0.05, 0.65))
_COLOURS = ("1 .3 .2 1", ".2 .8 .3 1", ".3 .4 1 1", ".9 .8 .2 1", ".7 .3 .8 1", ".2 .8 .8 1")

# The same six bodies, to be given a colour or a texture: a ball, a pill, an egg, a can, a brick and a board.
_SHAPES = (
    'type="sphere" size=".16"',
    'type="capsule" size=".09 .14"',
    'type="ellipsoid" size=".09 .14 .2"',
    'type="cylinder" size=".12 .13"',
    'type="box" size=".1 .13 .16"',
    'type="plane" size=".2 .15 .1"',
)
_BODIES = _SHAPES[:5]

_SKY = '<texture type="skybox" builtin="gradient" rgb1=".9 .6 .2" rgb2=".1 .2 .5" width="256" height="256"/>'
_WEDGE = '<mesh name="wedge" vertex="-.2 -.15 -.1 .2 -.15 -.1 .2 .15 -.1 -.2 .15 -.1 -.2 -.15 .15 -.2 .15 .15"/>'
_POINT = ('type="point"', 'type="spot" cutoff="180"')
_MESHES = (
    _WEDGE
    + '<mesh name="ring" builtin="supertorus" params="24 0.3 1 1" scale=".22 .22 .22"/>'
    + '<mesh name="cone" builtin="cone" params="24 .3" scale=".2 .2 .2"/>'
)
_HILLS = 'name="hills" nrow="12" ncol="16" size=".45 .35 .16 .05"'
# A mesh that says where on an image each of its corners lies.
_IMAGED = (
    '<mesh name="imaged" vertex="-.2 -.2 0 .2 -.2 0 .2 .2 0 -.2 .2 0 0 0 .3" texcoord="0 0 1 0 1 1 0 1 .5 .5"'
    ' face="0 2 1 0 3 2 0 1 4 1 2 4 2 3 4 3 0 4"/>'
)


def _elevation() -> str:
    rows, columns = np.mgrid[0:12, 0:16]
    heights = 0.5 + 0.5 * np.sin(0.9 * columns) * np.cos(0.7 * rows)
    return " ".join(f"{height:.3f}" for height in heights.reshape(-1))


_CHECKS = (
    '<texture name="checks" type="2d" builtin="checker" rgb1=".9 .8 .6" rgb2=".2 .3 .5" width="64" height="64"/>'
    '<material name="checks" texture="checks" texuniform="true"/>'
)
_CHECKED = 'type="plane" size="0 0 .1" material="checks"'
_HFIELD = f'<hfield {_HILLS} elevation="{_elevation()}"/>'


def _each(attributes: str, shapes: tuple[str, ...] = _SHAPES) -> tuple[str, ...]:
    return tuple(f"{shape} {attributes}" for shape in shapes)


def _coloured(shapes: tuple[str, ...] = _SHAPES) -> tuple[str, ...]:
    return tuple(f'{shape} rgba="{colour}"' for shape, colour in zip(shapes, _COLOURS, strict=False))


def _three(kind: str, *sizes: str) -> tuple[str, ...]:
    return tuple(f'type="{kind}" {size} rgba="{colour}"' for size, colour in zip(sizes, _COLOURS, strict=False))


def _geoms() -> dict[str, Feature]:
    def of(title: str, *things: str, **more: Any) -> Feature:
        return Feature("geoms", title, tuple(things), **{"assets": _SKY, **more})

    return {
        "primitives": Feature(
            "geoms",
            "every primitive, three materials",
            (
                'type="sphere" size=".15" material="shiny"',
                'type="capsule" size=".08 .15" rgba=".9 .1 .1 1"',
                'type="ellipsoid" size=".08 .14 .2" material="glowing"',
                'type="cylinder" size=".1 .12" rgba=".1 .7 .8 1"',
                'type="box" size=".09 .12 .16"',
                'type="plane" size=".2 .15 .1" rgba=".8 .8 .2 1"',
            ),
            _SKY
            + '<material name="shiny" rgba=".2 .6 .3 1" specular=".9" shininess=".4"/>'
            + '<material name="glowing" rgba=".3 .2 .7 1" emission=".5" specular=".2" shininess=".1"/>',
        ),
        "geom_plane": of(
            "plane, with an end and without", *_three("plane", 'size=".3 .2 .1"', 'size=".1 .35 .1"', 'size=".2 .2 .1"')
        ),
        "geom_sphere": of("sphere", *_three("sphere", 'size=".2"', 'size=".12"', 'size=".05"')),
        "geom_capsule": of("capsule", *_three("capsule", 'size=".1 .2"', 'size=".15 .05"', 'size=".03 .3"')),
        "geom_ellipsoid": of("ellipsoid", *_three("ellipsoid", 'size=".1 .2 .3"', 'size=".2 .2 .05"', 'size=".04 .06 .2"')),
        "geom_cylinder": of("cylinder", *_three("cylinder", 'size=".15 .2"', 'size=".2 .02"', 'size=".03 .3"')),
        "geom_box": of("box", *_three("box", 'size=".1 .15 .2"', 'size=".25 .2 .01"', 'size=".02 .03 .25"')),
        "geom_mesh": of(
            "mesh: flat, smooth, hollow", *_three("mesh", 'mesh="wedge"', 'mesh="ring"', 'mesh="cone"'), assets=_SKY + _MESHES
        ),
        "geom_hfield": of("height field", *_three("hfield", 'hfield="hills"', 'hfield="hills"'), assets=_SKY + _HFIELD),
        "geom_plane_below": of(
            "plane without end, seen from below",
            *_coloured(_BODIES[:3]),
            assets=_SKY + _CHECKS,
            floor=_CHECKED,
            eye="0 -1.5 -1",
            limits=(("plane_mean", 2.0),),
        ),
        # Without a light the normal does not count: OpenGL has none for what is flat.
        "geom_flat": of(
            "what is left where a size is 0: box, box, cylinder, ellipsoid, capsule (nothing)",
            *_coloured((_SHAPES[4], _SHAPES[4], _SHAPES[3], _SHAPES[2], _SHAPES[1])),
            lights="",
            visual='<headlight active="0"/>',
            sizes=((0.2, 0.25, 0.0), (0.0, 0.2, 0.3), (0.2, 0.0, 0.0), (0.2, 0.0, 0.25), (0.15, 0.0, 0.0)),
        ),
        "sites": Feature(
            "geoms",
            "sites",
            _coloured(_BODIES[:3]),
            _SKY,
            sites=('type="box" size=".05 .1 .2"', 'type="sphere" size=".15"', 'type="cylinder" size=".15 .05"'),
        ),
    }


def _lights() -> dict[str, Feature]:
    head = '<headlight ambient="{}" diffuse="{}" specular="{}"/>'
    dark = head.format("0 0 0", "0 0 0", "0 0 0")

    def of(title: str, lights: str, visual: str = dark, **more: Any) -> Feature:
        shiny = '<material name="wall" rgba=".8 .8 .8 1" specular=".3" shininess=".3"/>'
        return Feature(
            "lights",
            title,
            _coloured(_BODIES),
            _SKY + shiny,
            lights,
            'type="plane" size="2 2 .02" material="wall"',
            visual=visual,
            **more,
        )

    common = 'diffuse=".9 .8 .7" specular=".4 .4 .4"'
    return {
        "light_head": of("headlight", "", head.format(".1 .1 .1", ".6 .6 .6", ".5 .5 .5")),
        "light_ambient": of("ambient light alone", '<light diffuse="0 0 0" ambient=".4 .5 .6" pos="0 0 2"/>'),
        "light_none": of("no light", "", '<headlight active="0"/>'),
        "light_directional": of("directional light", f'<light directional="true" dir=".5 .3 -1" {common}/>'),
        "light_point": of("point light", f'<light type="point" pos=".4 -.5 1.2" {common}/>', stand_in=_POINT),
        "light_attenuated": of(
            "point light, attenuated",
            f'<light type="point" pos=".4 -.5 1.2" attenuation=".5 .3 .6" {common}/>',
            stand_in=_POINT,
        ),
        "light_spot": of("spot light", f'<light pos=".5 -.5 1.8" dir="-.25 .25 -1" cutoff="35" exponent="2" {common}/>'),
        "light_spot_wide": of(
            "spot light with a cutoff over 90", f'<light pos=".4 -.5 1.2" dir="-.5 .5 -1" cutoff="100" exponent="5" {common}/>'
        ),
        "light_spot_hard": of(
            "spot light with a hard edge", f'<light pos="0 0 2" dir="0 0 -1" cutoff="20" exponent="0" {common}/>'
        ),
        "light_three": of(
            "three lights and the headlight",
            '<light directional="true" dir=".5 .3 -1" diffuse=".3 .1 .1"/>'
            '<light type="spot" cutoff="180" pos="-1 1 1" diffuse=".1 .4 .1"/>'
            '<light pos=".5 -.5 1.8" dir="-.25 .25 -1" cutoff="40" diffuse=".1 .1 .6"/>',
            head.format(".2 .2 .2", ".3 .3 .3", "0 0 0"),
        ),
    }


def _textures() -> dict[str, Feature]:
    checker = '<texture name="pattern" type="{}" builtin="checker" rgb1=".9 .8 .6" rgb2=".2 .3 .5" width="64" height="{}"/>'
    gradient = '<texture name="pattern" type="{}" builtin="gradient" rgb1="1 .8 .1" rgb2=".1 .1 .7" width="64" height="{}"/>'
    marked = (
        '<texture name="pattern" type="{}" builtin="flat" mark="cross" markrgb="1 1 1" rgb1=".7 .3 .2" rgb2=".2 .3 .7"'
        ' width="65" height="{}"/>'
    )
    image = '<texture name="pattern" type="2d" file="image.png"/>'
    die = '<texture name="pattern" type="cube" file="image.png" gridsize="1 1"/>'
    plain = '<material name="pattern" texture="pattern"/>'
    uniform = '<material name="pattern" texture="pattern" texuniform="true" texrepeat="3 2"/>'
    repeated = '<material name="pattern" texture="pattern" texrepeat="2 3" rgba=".8 1 .8 1"/>'

    def flat(texture: str) -> str:
        return texture.format("2d", 64)

    def cube(texture: str) -> str:
        return texture.format("cube", 65 * 6 if "65" in texture else 64 * 6)

    def of(title: str, assets: str, shapes: tuple[str, ...] = _SHAPES, more: tuple[str, ...] = (), **rest: Any) -> Feature:
        return Feature("textures", title, _each('material="pattern"', shapes) + more, _SKY + assets, **rest)

    floor = 'type="plane" size="{}" material="pattern"'
    meshes = tuple(f'type="mesh" mesh="{name}"' for name in ("wedge", "ring", "cone"))
    return {
        "texture_2d_checker": of("2-D checker", flat(checker) + plain),
        "texture_2d_gradient": of("2-D gradient", flat(gradient) + plain),
        "texture_2d_image": of("2-D image", image + plain),
        "texture_2d_repeated": of("2-D image, repeated and tinted", image + repeated),
        "texture_2d_uniform": of("2-D image, repeated by the metre", image + uniform),
        "texture_floor": of(
            "2-D checker on a floor without end", flat(checker) + uniform, _BODIES[:2], floor=floor.format("0 0 .1")
        ),
        "texture_floor_finite": of(
            "2-D image on a floor with an end", image + repeated, _BODIES[:2], floor=floor.format("1 .7 .1")
        ),
        "texture_cube_checker": of("cube checker", cube(checker) + plain),
        "texture_cube_marked": of("cube with marked edges", cube(marked) + plain, _BODIES),
        "texture_cube_gradient": of("cube gradient", cube(gradient) + plain, _BODIES),
        "texture_cube_image": of("cube of one image", die + plain, _BODIES),
        "texture_cube_uniform": of("cube image, by the metre", die + uniform, _BODIES),
        "texture_mesh_2d": of(
            "2-D image on meshes, one with its own corners",
            _MESHES + _IMAGED + image + plain,
            (*meshes[:2], 'type="mesh" mesh="imaged"'),
        ),
        "texture_mesh_cube": of("cube image on meshes", _MESHES + die + plain, meshes),
        "texture_mesh_repeated": of(
            "2-D image on a mesh with its own corners, repeated",
            _IMAGED + image + repeated + uniform.replace('"pattern" texture', '"uniform" texture'),
            ('type="mesh" mesh="imaged"',) * 2,
            more=('type="mesh" mesh="imaged" material="uniform"',),
            limits=(("textured_mean", 1.0),),
        ),
        "texture_srgb": of(
            "images flagged as sRGB: 2-D, and a cube",
            image.replace("/>", ' colorspace="sRGB"/>')
            + plain
            + die.replace('"pattern"', '"die"').replace("/>", ' colorspace="sRGB"/>')
            + '<material name="die" texture="die"/>',
            _SHAPES[:2],
            more=tuple(f'{shape} material="die"' for shape in _SHAPES[3:5]),
        ),
        "texture_hfield": of("2-D image on a height field", _HFIELD + image + plain, ('type="hfield" hfield="hills"',) * 2),
    }


def _views() -> dict[str, Feature]:
    marks = '<texture type="skybox" builtin="checker" rgb1=".4 .6 .8" rgb2=".1 .1 .2" width="64" height="384"/>'
    glass = tuple(
        f'{shape} rgba="{colour[:-1]}{alpha}"'
        for shape, colour, alpha in zip(_SHAPES, _COLOURS, (0.3, 0.5, 0.7, 0.4, 0.6, 0.5))
    )
    lens = 'sensorsize=".036 .024" focal=".03 .035" principal=".003 -.002" resolution="128 128"'
    return {
        "sky_gradient": Feature("views", "sky: gradient", _coloured(_BODIES[:2]), _SKY, floor=""),
        "sky_checker": Feature("views", "sky: checker", _coloured(_BODIES[:2]), marks, floor=""),
        "transparency": Feature("views", "transparency", glass, _SKY),
        "camera_ortho": Feature(
            "views", "orthographic camera", _coloured(), _SKY, camera='projection="orthographic" fovy="1.6"'
        ),
        "camera_lens": Feature("views", "camera with a sensor, off its axis", _coloured(), _SKY, camera=lens),
        "camera_wide": Feature("views", "wide camera", _coloured(), _SKY, camera='fovy="110"'),
    }


FEATURES: dict[str, Feature] = {**_geoms(), **_lights(), **_textures(), **_views()}


def for_mujoco_renderer(feature: Feature) -> Feature:
    """Return the feature for MuJoCo's own renderer, with its stand-in applied; itself if it has none."""
    return dataclasses.replace(feature, lights=feature.lights.replace(*feature.stand_in)) if feature.stand_in else feature


def scene_spec(feature: Feature) -> mujoco.MjSpec:
    """Return the scene of a feature, not yet compiled."""
    things = []
    for number, (attributes, (x, y, z)) in enumerate(zip(feature.things, _PLACES, strict=False)):
        site = f'<site pos=".1 0 .1" rgba="1 .5 1 1" {feature.sites[number]}/>' if number < len(feature.sites) else ""
        things.append(
            f'<body name="thing{number}" mocap="true" pos="{x} {y} {z}"><geom name="thing{number}" {attributes}/>{site}</body>'
        )
    xml = f"""
<mujoco>
  <visual><map znear="0.005" zfar="20"/>{feature.visual}</visual>
  <statistic extent="1" center="0 0 .35"/>
  <asset>{feature.assets}</asset>
  <worldbody>
    {feature.lights}
    {f'<geom name="floor" {feature.floor}/>' if feature.floor else ""}
    {"".join(things)}
    <body name="eye" mocap="true" pos="{feature.eye}"><camera name="eye" {feature.camera}/></body>
  </worldbody>
</mujoco>
"""
    return mujoco.MjSpec.from_string(xml, assets={"image.png": _image()})


def _image() -> bytes:
    """Return a PNG of 48 x 48 pixels without symmetry: red increases to the right, green downwards, with a blue L."""
    rows, columns = np.mgrid[0:48, 0:48]
    pixels = np.stack([40 + 4 * columns, 40 + 4 * rows, np.full_like(rows, 60)], axis=-1).astype(np.uint8)
    pixels[8:40, 8:14] = pixels[34:40, 8:30] = (40, 60, 230)
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, format="PNG")
    return stream.getvalue()
