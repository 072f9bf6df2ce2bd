"""Scenes, poses and peers of `bench render`, without GL and without a GPU."""

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from benchmarks.peers import image_comparison, warp
from jaxrl_vis import bench
from jaxrl_vis.bench import record, variation
from jaxrl_vis.bench.scenes import images, models, operations
from jaxrl_vis.errors import RequestError
from jaxrl_vis_envs.render import Scene, render

BALL = """
<mujoco>
  <statistic extent="1"/>
  <worldbody>
    <body pos="0 2 0"><freejoint/><geom type="sphere" size=".2"/></body>
    <geom type="plane" size="3 3 .1" pos="0 0 -1"/>
    <camera xyaxes="1 0 0 0 0 1" fovy="60"/>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def ball(tmp_path: Path) -> str:
    path = tmp_path / "ball.xml"
    path.write_text(BALL)
    return str(path)


@pytest.mark.parametrize(("scene", "geoms"), [("finger", 8), ("fetch_reach", 19), ("primitives", 127)])
def test_scenes_load_ready_for_a_fair_comparison(scene: str, geoms: int) -> None:
    mj_model = models.load(scene)
    assert mj_model.ngeom == geoms
    assert mj_model.ncam >= 1
    assert mj_model.vis.quality.offsamples == 0
    assert not mj_model.light_castshadow.any()


def test_primitives_are_mixed() -> None:
    types = models.load("primitives").geom_type
    assert sorted(np.unique(types, return_counts=True)[1].tolist()) == [1, 25, 25, 25, 25, 26]


def test_textures_can_be_left_out() -> None:
    with_them, without = models.load("finger"), models.load("finger", textures=False)
    assert (with_them.mat_texid >= 0).any() and not (without.mat_texid >= 0).any()
    skybox = mujoco.mjtTexture.mjTEXTURE_SKYBOX
    assert (with_them.tex_type == skybox).any() and not (without.tex_type == skybox).any()


@pytest.mark.parametrize(
    ("content", "complaint"),
    [(None, "no scene .*finger, fetch_reach, primitives"), ("<mujoco/>", "no camera"), ("<robot", "is not a MuJoCo model")],
)
def test_invalid_scenes_raise_one_line(content: str | None, complaint: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(RequestError, match=complaint) as caught:
        models.load(str(path))
    assert "\n" not in str(caught.value)


def test_missing_suite_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(models.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(RequestError, match="pip install --no-deps dm_control"):
        models.load("finger")


def test_poses_are_random_repeatable_and_within_limits() -> None:
    mj_model = models.load("finger")
    first, again, other = (models.random_poses(mj_model, 6, seed) for seed in (1, 1, 2))
    assert len({row.tobytes() for row in np.concatenate([first["geom_xpos"], other["geom_xpos"]])}) == 12
    for name, rows in first.items():
        np.testing.assert_array_equal(rows, again[name])
        assert np.all(np.isfinite(rows))
    mj_data, rng = mujoco.MjData(mj_model), np.random.default_rng(0)
    limited = mj_model.jnt_limited.astype(bool)
    for _ in range(20):
        models.scatter_joints(mj_model, mj_data, rng)
        assert np.all(mj_data.qpos[limited] >= mj_model.jnt_range[limited, 0])
        assert np.all(mj_data.qpos[limited] <= mj_model.jnt_range[limited, 1])


def test_free_bodies_stay_near_their_start_with_unit_quaternions(ball: str) -> None:
    mj_model = models.load(ball)
    mj_data, rng = mujoco.MjData(mj_model), np.random.default_rng(0)
    turns = []
    for _ in range(50):
        models.scatter_joints(mj_model, mj_data, rng)
        assert np.all(np.abs(mj_data.qpos[:3] - [0.0, 2.0, 0.0]) <= 0.1)
        assert np.linalg.norm(mj_data.qpos[3:]) == pytest.approx(1.0)
        turns.append(2.0 * np.arccos(np.clip(mj_data.qpos[3], -1.0, 1.0)))
    assert max(turns) <= 0.5 + 1e-6 and max(turns) > 0.3


def test_needed_tests_count_the_pixels_of_a_ball_and_every_plane(ball: str) -> None:
    mj_model = models.load(ball)
    mj_data = mujoco.MjData(mj_model)
    models.forward(mj_model, mj_data)
    poses = {name: np.asarray(getattr(mj_data, name), np.float32)[None] for name in models.POSES}
    # The ball's edge lies at tan(asin(.2 / 2)) of an image that reaches to tan(30 degrees).
    disc = np.pi * (np.tan(np.arcsin(0.1)) / np.tan(np.pi / 6)) ** 2 / 4
    assert models.needed_tests(mj_model, poses, 128).tolist() == pytest.approx([1.0, disc], abs=2e-3)
    poses["geom_xpos"][:, 1] = [0.0, -2.0, 0.0]  # behind the camera
    assert models.needed_tests(mj_model, poses, 128).tolist() == [1.0, 0.0]


def test_operations_are_those_of_the_tests_and_of_one_shading(ball: str) -> None:
    mj_model = models.load(ball)
    scene = Scene.from_mjmodel(mj_model, 0, 8, 8)

    def count(plane: float, ball: float, coloured: bool = True) -> float:
        found = operations.operations_per_pixel(scene, np.array([plane, ball]), coloured)
        assert found is not None
        return found

    shading, plane, sphere = count(0, 0), count(1, 0) - count(0, 0), count(0, 1) - count(0, 0)
    # Of a plane: three products of a ray with an axis, the division, a point, its bounds, and the comparison of keys.
    assert 20 < plane < 50 < shading
    assert count(1, 0.5) == pytest.approx(shading + plane + 0.5 * sphere)
    assert count(1, 0.5) - count(1, 0.5, coloured=False) > 50
    assert operations._count(lambda x, y: jnp.sqrt(x * y + 1.0), *[jax.ShapeDtypeStruct((7919,), jnp.float32)] * 2) == 3


def test_unchanging_images_are_refused() -> None:
    rows = np.arange(8, dtype=np.float32)[:, None]
    with pytest.raises(AssertionError, match="8 of 8 images stay the same"):
        variation.assert_new_images(lambda batch: (jnp.asarray(batch), None), [rows, rows])
    with pytest.raises(AssertionError, match="only 1 of 8 images differ"):
        variation.assert_new_images(lambda batch: 0 * batch, [rows, rows + 8])
    variation.assert_new_images(lambda batch: batch, [rows, rows + 8])


def test_calls_alternate_between_batches() -> None:
    draw = variation.cycle_batches(lambda batch: batch, [1, 2])
    assert [draw() for _ in range(5)] == [1, 2, 1, 2, 1]


def test_a_scene_keeps_a_record_for_each_output(ball: str, tmp_path: Path) -> None:
    found = bench.run("render", scene=ball, envs=(3,), image_size=8, repeats=1, results=tmp_path)
    assert [(entry.config["textures"], entry.config["pixels"]) for entry in found] == [
        (textures, output) for textures in (False, True) for output in ("rgbd", "rgbd8", "depth")
    ]
    assert all(entry.value > 0.0 and entry.config["scene"] == ball for entry in found)
    assert all(entry.details["drawn"] == 2 and entry.details["needed_tests_per_pixel"] >= 1.0 for entry in found)
    assert len(record.load(record.results_path("render", tmp_path))) == len(found)


def test_a_scene_that_stands_still_is_not_measured(tmp_path: Path) -> None:
    path = tmp_path / "still.xml"
    path.write_text(BALL.replace("<freejoint/>", ""))
    with pytest.raises(AssertionError, match="broadcast"):
        bench.run("render", scene=str(path), envs=(3,), image_size=8, repeats=1, results=tmp_path)


def test_agreement_counts_sky_and_closeness() -> None:
    ours = np.array([[[np.inf, 2.0, 2.0, np.inf]]])
    theirs = np.array([[[np.inf, 2.01, 2.2, 1.0]]])
    assert image_comparison.depth_agreement(ours, theirs) == 0.5


@pytest.fixture(scope="module")
def drawn_ball(tmp_path_factory: pytest.TempPathFactory) -> image_comparison.Comparison:
    path = tmp_path_factory.mktemp("scene") / "ball.xml"
    path.write_text(BALL)
    mj_model = models.load(str(path))
    batches = [models.random_poses(mj_model, 3, seed) for seed in (1, 2)]
    case = images.Case({"image_size": 16, "images": 3}, mj_model, batches)
    return image_comparison.compare(case, repeats=1, rate=1.0)


def test_a_peer_must_draw_the_same(drawn_ball: image_comparison.Comparison) -> None:
    ours = drawn_ball
    assert ours.agreement(ours.colours, ours.depth) == {"depth_agreement": 1.0, "colour_difference": 0.0}
    brighter = np.minimum(ours.colours.astype(int) + 10, 255).astype(np.uint8)
    with pytest.raises(AssertionError, match="colour_difference is .* grey levels, and 1.5 at most"):
        ours.agreement(brighter, ours.depth)
    moved = np.where(np.isfinite(ours.depth), ours.depth * 1.05, np.inf)
    with pytest.raises(AssertionError, match="depths agree in .* of the pixels"):
        ours.agreement(ours.colours, moved)
    with pytest.raises(AssertionError, match="labels agree in 0.0 of the pixels"):
        ours.agreement(ours.colours, ours.depth, labels=ours.labels + 1)
    assert ours.agreement(ours.colours, ours.depth, labels=ours.labels)["label_agreement"] == 1.0
    # A peer may draw fewer images than we do.
    assert ours.agreement(ours.colours[:2], ours.depth[:2])["depth_agreement"] == 1.0


def test_images_of_several_cameras_are_in_the_order_of_poses() -> None:
    spec = mujoco.MjSpec.from_string(BALL)
    spec.worldbody.add_camera(pos=[0.0, 0.0, 3.0])
    mj_model = spec.compile()
    batches = [models.random_poses(mj_model, 2, seed) for seed in (1, 2)]
    case = images.Case({"image_size": 8, "images": 4, "cameras": 2}, mj_model, batches)
    drawn = image_comparison.compare(case, repeats=1, rate=1.0).depth
    for camera in range(2):
        scene = Scene.from_mjmodel(mj_model, camera, 8, 8)
        for world in range(2):
            mj_data = mujoco.MjData(mj_model)
            for name in models.POSES:
                getattr(mj_data, name)[:] = batches[0][name][world]
            depth = np.asarray(render(scene, mj_data).depth)
            np.testing.assert_allclose(drawn[2 * world + camera], np.where(depth < float(scene.zfar), depth, np.inf), rtol=1e-5)


def test_textures_have_a_bound_of_their_own(drawn_ball: image_comparison.Comparison) -> None:
    lower_half = np.zeros_like(drawn_ball.textured)
    lower_half[:, 8:] = True
    ours = dataclasses.replace(drawn_ball, textured=lower_half)
    theirs = np.where(lower_half[..., None], ours.colours // 2 + 64, ours.colours)
    with pytest.raises(AssertionError, match="textured_difference"):
        ours.agreement(theirs, ours.depth)
    assert ours.agreement(theirs, ours.depth, 200.0)["textured_difference"] > image_comparison.MAX_DIFFERENCE


def test_textured_geoms_are_those_whose_material_has_a_texture() -> None:
    assert image_comparison.textured_geoms(models.load("primitives")).nonzero()[0].tolist() == [0]
    assert not image_comparison.textured_geoms(models.load("primitives", textures=False)).any()
    assert not image_comparison.textured_geoms(models.load("fetch_reach")).any()


def test_start_poses_barely_move_and_still_differ() -> None:
    mj_model = models.load("primitives")
    mj_data = mujoco.MjData(mj_model)
    models.forward(mj_model, mj_data)
    poses = models.random_poses(mj_model, 4, 1, models.SPREADS["start"])
    assert np.abs(poses["geom_xpos"] - mj_data.geom_xpos).max() < 3e-3
    assert len({row.tobytes() for row in poses["geom_xpos"]}) == 4
    finger = models.load("finger")
    mj_data = mujoco.MjData(finger)
    rng = np.random.default_rng(0)
    models.scatter_joints(finger, mj_data, rng, spread=0.0)
    np.testing.assert_array_equal(mj_data.qpos, finger.qpos0)


WARP_NEEDS = {
    "finger": {"use_textures", "render_skybox", "use_ambient_lighting", "enable_specular"},
    "fetch_reach": {"use_ambient_lighting"},
    "primitives": {"use_textures", "render_skybox", "use_ambient_lighting", "enable_specular"},
}


def warp_options(scene: str, **variant: bool) -> set[str]:
    mj_model = models.load(scene, **variant)
    batches = [models.random_poses(mj_model, 2, 1)]
    options = warp.render_options(Scene.from_mjmodel(mj_model, 0, 8, 8), mj_model, batches)
    # Whatever is not said explicitly would be on.
    assert {name for name in options if name.startswith("enable_")} == {
        "enable_specular",
        "enable_emission",
        "enable_per_light_ambient",
        "enable_vertex_normals",
        "enable_backface_culling",
    }
    return {name for name, on in options.items() if on}


@pytest.mark.parametrize("scene", WARP_NEEDS)
def test_warp_gets_the_options_that_a_scene_needs(scene: str) -> None:
    assert warp_options(scene) == WARP_NEEDS[scene]


def test_warp_options_omit_absent_textures_and_highlights() -> None:
    assert warp_options("primitives", textures=False, highlights=False) == {"use_ambient_lighting"}


GLOW = '<asset><material name="glow" emission=".5"/></asset><worldbody>'
LIGHT = '<worldbody><light ambient=".1 .1 .1" pos="0 0 3"/>'


@pytest.mark.parametrize(
    ("old", "new", "option"),
    [
        ("<worldbody>", LIGHT, "enable_per_light_ambient"),
        ('size=".2"', 'size="3"', "enable_backface_culling"),
        ("<worldbody>", GLOW, None),  # a material that nothing has
    ],
)
def test_warp_gets_scene_specific_options(old: str, new: str, option: str | None, tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(BALL.replace(old, new, 1))
    assert warp_options(str(path)) == {"use_ambient_lighting", "enable_specular"} | ({option} if option else set())


def test_warp_draws_emission_where_something_emits(tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(BALL.replace("<worldbody>", GLOW).replace('type="sphere"', 'type="sphere" material="glow"'))
    assert "enable_emission" in warp_options(str(path))


def test_warp_s_buffers_become_images() -> None:
    packed = np.array([[0xFF030201, 0xFF060504, 0, 0]], np.uint32)
    colours, depth = warp.images(packed, np.array([[0.0, 2.0, 3.0, 4.0]], np.float32), 2)
    assert colours.shape == (1, 2, 2, 3) and colours[0, 0].tolist() == [[3, 2, 1], [6, 5, 4]]
    assert depth.shape == (1, 2, 2) and np.isinf(depth[0, 0, 0]) and depth[0, 1, 1] == 4.0


def test_missing_warp_raises_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [])
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(RequestError, match="pip install mujoco-warp==4.0.0") as caught:
        warp.check()
    assert "\n" not in str(caught.value)


def test_other_warp_versions_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warp.importlib.metadata, "version", lambda name: "5.0.0")
    for name in ("mujoco_warp", "warp"):
        monkeypatch.setitem(sys.modules, name, type(sys)(name))
    with pytest.raises(RequestError, match=r"4\.0\.0, not 5\.0\.0"):
        warp.check()
