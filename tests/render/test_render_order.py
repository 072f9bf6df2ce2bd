"""Visibility as in MuJoCo: transparent faces, ties, coincident surfaces, and paper-thin layers."""

import functools
import io

import jax
import mujoco
import numpy as np
import pytest
from PIL import Image

import jaxrl_vis_envs
from jaxrl_vis_envs.compiling.compilation import compiler_options
from jaxrl_vis_envs.render import Scene, render, render_planes
from jaxrl_vis_envs.render.cpu import passes
from jaxrl_vis_envs.render.gpu import kernel
from jaxrl_vis_envs.render.model import meshes
from jaxrl_vis_envs.render.outputs import Outputs

# Without a light MuJoCo gives everything three tenths of its colour; with the rest of it as emission it has its own.
HEADER = """
<mujoco>
  <visual><headlight active="0"/></visual>
  <asset>
    <texture name="half" type="2d" file="half.png" nchannel="4"/>
    <material name="own" emission=".7"/>
    <material name="mirror" emission=".7" reflectance=".3"/>
    <material name="leaf" emission=".7" texture="half" rgba="1 1 1 .9"/>
    <material name="solid leaf" emission=".7" texture="half"/>
    <mesh name="two floors" vertex="{sheets}" face="0 1 2 0 2 3 4 5 6 4 6 7 0 3 2 0 2 1" inertia="shell"/>
  </asset>
  <worldbody>
    <camera name="above" pos="0 0 3" fovy="45"/>
    {body}
  </worldbody>
</mujoco>
"""
SHEETS = " ".join(f"{x} {y} {z}" for z in (0.0, 0.2) for x, y in ((-0.3, -0.3), (0.3, -0.3), (0.3, 0.3), (-0.3, 0.3)))
BACK = np.array([0.5, 0.5, 0.5])
FLOOR = '<geom type="plane" size="9 9 .1" pos="0 0 -.5" material="own" rgba=".5 .5 .501 1"/>'
RED, BLUE = np.array([0.9, 0.1, 0.2]), np.array([0.1, 0.2, 0.9])


def load(body: str, floor: str = FLOOR) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Load a scene over a grey floor, with a texture whose left half is transparent; return the model and its poses."""
    pixels = np.full((8, 8, 4), [200, 100, 50, 255], np.uint8)
    pixels[:, :4, 3] = 0
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "png")
    xml = HEADER.format(sheets=SHEETS, body=floor + body)
    mj_model = mujoco.MjModel.from_xml_string(xml, {"half.png": file.getvalue()})
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    return mj_model, mj_data


def geom(kind: str, size: str, pos: str, colour: np.ndarray, alpha: float = 0.5, more: str = 'material="own"') -> str:
    rgba = " ".join(map(str, (*colour, alpha)))
    return f'<geom type="{kind}" size="{size}" pos="{pos}" rgba="{rgba}" {more}/>'


def laid(*colours: np.ndarray, alpha: float = 0.5) -> np.ndarray:
    """Blend sheets over the floor, nearest first: front to back, and then back to front."""
    shown = BACK
    for colour in (*colours, *reversed(colours)):
        shown = shown + alpha * (colour - shown)
    return shown


def colours_at(body: str, places: list[tuple[float, float]], size: int = 31) -> np.ndarray:
    """Return the colours visible at points on the floor (m), [points, 3] in [0, 1]."""
    mj_model, mj_data = load(body)
    planes = render_planes(Scene.from_mjmodel(mj_model, "above", size, size), mj_data, depth=False)
    scale = size / (2.0 * 3.5 * np.tan(np.deg2rad(22.5)))
    rows = [round((size - 1) / 2 - y * scale) for _, y in places]
    columns = [round((size - 1) / 2 + x * scale) for x, _ in places]
    return np.asarray(planes.rgb)[:, rows, columns].T


@pytest.mark.parametrize("turned", [False, True])
def test_first_declared_of_equidistant_objects_is_nearer(turned):
    balls = [geom("sphere", ".4", "-.1 0 0", RED), geom("sphere", ".4", ".1 0 0", BLUE)]
    # Planes all count as equally far, whatever is above.
    planes = [geom("plane", ".2 .2 .1", f"0 .9 {height}", colour) for height, colour in ((0.1, RED), (0.3, BLUE))]
    body = "".join((balls + planes)[:: -1 if turned else 1])
    order = (BLUE, RED) if turned else (RED, BLUE)
    np.testing.assert_allclose(colours_at(body, [(0.0, 0.0), (0.0, 0.9)]), [laid(*order)] * 2, atol=2e-3)


def test_all_front_faces_of_a_transparent_mesh_are_blended():
    body = f'<geom type="mesh" mesh="two floors" material="own" rgba=".9 .1 .2 .5"/>{geom("box", ".1 .1 .1", "1 0 0", RED)}'
    twice, once = colours_at(body, [(0.0, 0.0), (1.1, 0.0)])
    np.testing.assert_allclose(twice, laid(RED, RED), atol=2e-3)
    np.testing.assert_allclose(once, laid(RED), atol=2e-3)


def test_faces_of_a_transparent_mesh_have_gradients():
    mj_model, mj_data = load('<geom type="mesh" mesh="two floors" material="own" rgba=".9 .1 .2 .5"/>')
    scene = Scene.from_mjmodel(mj_model, "above", 5, 5)

    def red(alpha):
        planes = render_planes(scene.replace(rgba=scene.rgba.at[1, 3].set(alpha)), mj_data, depth=False)
        return planes.rgb[0, 2, 2]

    quick = {**compiler_options(), "xla_backend_optimization_level": 0}  # it runs once
    value, slope = jax.jit(jax.value_and_grad(red), compiler_options=quick)(0.3)
    np.testing.assert_allclose(value, 0.9 - 0.4 * 0.7**4, atol=2e-3)
    np.testing.assert_allclose(slope, 4 * 0.4 * 0.7**3, atol=1e-2)


def test_texture_alpha_applies_to_transparent_objects_only():
    body = '<geom type="plane" size=".4 .4 .1" pos="-.8 0 0" material="leaf"/>'
    body += '<geom type="box" size=".3 .3 .1" pos=".8 0 0" material="leaf"/>'
    body += '<geom type="plane" size=".4 .4 .1" pos="0 .9 0" material="solid leaf"/>'
    places = [(-1.0, 0.0), (-0.6, 0.0), (0.7, 0.0), (1.15, 0.0), (-0.2, 0.9), (0.2, 0.9)]
    seen = colours_at(body, places, 63)
    leaf = np.array([200, 100, 50]) / 255
    expected = [BACK, laid(leaf, alpha=0.9)] * 2 + [leaf] * 2
    np.testing.assert_allclose(seen, expected, atol=5e-3)


def test_coincident_transparent_and_opaque_boxes_are_both_visible():
    """A transparent box coincides with an opaque one, declared before it and after it."""
    for order in (1, -1):
        body = "".join([geom("box", ".3 .3 .2", "0 0 0", RED, 1.0), geom("box", ".3 .3 .2", "0 0 0", BLUE)][::order])
        (seen,) = colours_at(body, [(0.0, 0.0)])
        np.testing.assert_allclose(seen, RED + 0.75 * (BLUE - RED), atol=2e-3)


def test_reflecting_objects_are_drawn_first_but_labelled_in_order():
    mirror = 'material="mirror"'
    body = geom("box", ".3 .3 .2", "0 0 0", RED, 1.0) + geom("box", ".3 .3 .2", "0 0 0", BLUE, 1.0, mirror)
    body += geom("box", ".3 .3 .2", ".8 0 0", BLUE, 1.0, mirror) + geom("box", ".3 .3 .2", ".8 0 0", RED, 1.0)
    mj_model, mj_data = load(body)
    scene = Scene.from_mjmodel(mj_model, "above", 31, 31)
    frame = render(scene, mj_data)
    # Only the first one reflects in MuJoCo.
    assert frame.segmentation[15, 15] == 2 and frame.segmentation[15, 23] == 4
    np.testing.assert_allclose(frame.rgb[15, [15, 23]] / 255, [RED, RED], atol=3e-3)
    assert scene.reordered and not passes.can_render(scene, Outputs(True, True, True, quantized=True))


THIN = 3e-5  # m


@pytest.fixture(scope="module")
def papers():
    """Scene and data of sheets on a desk among so many geoms that rows are separate from keys, seen from 3 m."""
    desk = geom("box", ".9 .9 .5", "0 0 -.5", BACK, 1.0)
    papers = "".join(
        geom("box", f".1 .4 {THIN / 2}", f"{x} 0 {THIN / 2}", RED, 1.0)
        + geom("plane", ".1 .2 .1", f"{x} 0 {2 * THIN}", BLUE, 1.0)
        for x in (-0.6, -0.2, 0.2, 0.6)
    )
    crumbs = "".join(geom("sphere", ".01", f"{-0.8 + 0.02 * i} .8 0", RED, 1.0) for i in range(60))
    mj_model, mj_data = load(desk + crumbs + papers)
    return Scene.from_mjmodel(mj_model, "above", 24, 24), mj_data


@pytest.mark.parametrize("way", ["plain", "passes", "kernel"])
def test_paper_among_many_geoms_stays_on_the_desk(papers, way, monkeypatch):
    scene, mj_data = papers
    assert len(scene.object_ids) > 63
    if way == "kernel":
        assert kernel.supports(scene)
        monkeypatch.setattr(kernel, "can_render", lambda scene, outputs: True)
        monkeypatch.setattr(kernel, "draw", functools.partial(kernel.draw, interpret=True))
    draw = jaxrl_vis_envs.jit(lambda: render_planes(scene, mj_data, segmentation=True, quantized=way == "passes"))
    labels = np.asarray(draw().segmentation)
    scale = 24 / (2.0 * 3.0 * np.tan(np.deg2rad(22.5)))
    columns = [round(11.5 + x * scale) for x in (-0.6, -0.2, 0.2, 0.6)]
    sheets = np.array([scene.geom_count - 8 + 2 * i for i in range(4)])
    np.testing.assert_array_equal(labels[11:13, columns], [sheets + 1] * 2)
    row = round(11.5 + 0.3 * scale)
    np.testing.assert_array_equal(labels[row, columns], sheets)


def test_smoothing_threshold_matches_float32_rounding():
    """The cosine of the angle between faces is exactly MuJoCo's threshold for smooth shading: float32 rounding decides."""
    ridge = "-.2 0 0 .2 0 0 -.2 .8 .6 .2 .8 .6 -.2 1.6 0 .2 1.6 0 -.2 .8 -.05 .2 .8 -.05"
    faces = "0 1 3 0 3 2 2 3 5 2 5 4 0 6 7 0 7 1 4 5 7 4 7 6 0 2 6 2 4 6 1 7 3 3 7 5"
    xml = f"""<mujoco><asset><mesh name="ridge" vertex="{ridge}" face="{faces}"/></asset>
      <worldbody><geom type="mesh" mesh="ridge"/><camera name="above" pos="0 0 3"/></worldbody></mujoco>"""
    rows = np.asarray(Scene.from_mjmodel(mujoco.MjModel.from_xml_string(xml), "above").triangles)
    rows = rows[np.any(rows[:, meshes.NORMALS], axis=1)]
    flat, corners = rows[:, meshes.MAP][:, None, 8:11], rows[:, meshes.NORMALS].reshape(-1, 3, 3)
    # Counted by images: with these, MuJoCo's is met to a hundredth of a grey level in the mean.
    assert len(rows) == 12 and np.sum(np.max(np.abs(corners - flat), axis=2) > 1e-5) == 11


def test_point_lights_unknown_to_mujoco():
    lights = '<light type="image" texture="half"/><light type="point" pos="0 0 2"/><light type="spot" pos="0 0 2" cutoff="30"/>'
    mj_model, _ = load(lights)
    types = mujoco.mjtLightType
    assert Scene.from_mjmodel(mj_model, "above").light_types == (types.mjLIGHT_POINT, types.mjLIGHT_SPOT)
    assert Scene.from_mjmodel(mj_model, "above", lights="mujoco").light_types == (types.mjLIGHT_SPOT,)
    with pytest.raises(ValueError, match="lights must be one of 'all', 'mujoco', got 'some'"):
        Scene.from_mjmodel(mj_model, "above", lights="some")
