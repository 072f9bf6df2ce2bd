"""Renderer against MuJoCo's own (stored images, so no GL is needed), against geometry, and against itself under vmap."""

import pathlib
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

import jaxrl_vis_envs
from benchmarks.rendering.reference import ReferenceRenderer
from jaxrl_vis_envs.render import Scene, render, render_planes
from jaxrl_vis_envs.render.mounts import Mount

REFERENCES = pathlib.Path(__file__).parents[1] / "data" / "render_references.npz"
POSES = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "xpos", "xmat", "site_xpos", "site_xmat")

BALL_XML = """
<mujoco>
  <statistic extent="1"/>
  <worldbody>
    <geom name="ball" type="sphere" size=".2"/>
    <geom name="ghost" type="box" size="1 1 1" group="4"/>
    <body><freejoint/><geom name="wall" type="box" size=".5 .1 .5" pos="0 1 0" rgba=".9 .1 .1 1"/></body>
    <camera name="front" pos="0 -2 0" xyaxes="1 0 0 0 0 1" fovy="45"/>
  </worldbody>
</mujoco>
"""


def poses_of(data, batch: int | None = None) -> dict:
    """Return the poses in MjData that the renderer reads, for vmap: a dictionary, repeated ``batch`` times if that is given."""
    poses = {name: np.array(getattr(data, name), np.float32) for name in POSES}
    return poses if batch is None else {name: np.repeat(value[None], batch, 0) for name, value in poses.items()}


def draw(scene: Scene, poses: dict):
    return render(scene, SimpleNamespace(**poses))


@pytest.fixture(scope="module")
def ball():
    """Model, data, and a scene of 33 x 33 pixels whose central pixel looks along the camera's axis."""
    mj_model = mujoco.MjModel.from_xml_string(BALL_XML)
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    return mj_model, mj_data, Scene.from_mjmodel(mj_model, "front", 33, 33)


@pytest.fixture(scope="module")
def references():
    """Stored arrays, their scene, and our images of the same poses, rendered as one batch."""
    with np.load(REFERENCES) as stored:
        arrays = dict(stored)
    mj_model = mujoco.MjModel.from_xml_string(str(arrays["xml"]))
    height, width = arrays["depth"].shape[1:]
    scene = Scene.from_mjmodel(mj_model, "eye", height, width, site_groups=(0,))
    drawn = jaxrl_vis_envs.jit(jax.vmap(lambda poses: draw(scene, poses)))({name: arrays[name] for name in POSES})
    return arrays, scene, jax.tree.map(np.asarray, drawn)


def away_from_silhouettes(labels: np.ndarray) -> np.ndarray:
    """Return a mask of pixels whose eight neighbours show the same object."""
    padded = np.pad(labels, ((0, 0), (1, 1), (1, 1)), mode="edge")
    height, width = labels.shape[1:]
    same = np.ones(labels.shape, bool)
    for row in range(3):
        for column in range(3):
            same &= padded[:, row : row + height, column : column + width] == labels
    return same


def test_segmentation_agrees_with_mujoco(references):
    arrays, _, drawn = references
    labels = arrays["segmentation"].astype(np.int32)
    inside = away_from_silhouettes(labels)
    assert inside.mean() > 0.8
    assert (drawn.segmentation == labels)[inside].mean() >= 0.997
    assert set(np.unique(labels)) == {-1, 0, 1, 2, 3, 4, 5, 6, 9}  # every type, the site and the sky, nothing hidden
    assert drawn.segmentation.dtype == np.int32


def test_depth_agrees_with_mujoco(references):
    arrays, scene, drawn = references
    labels = arrays["segmentation"]
    compared = away_from_silhouettes(labels) & (drawn.segmentation == labels)
    error = np.abs(drawn.depth - arrays["depth"])
    assert (error <= np.maximum(1e-3, 1e-3 * arrays["depth"]))[compared].mean() >= 0.999
    np.testing.assert_array_equal(drawn.depth[drawn.segmentation < 0], float(scene.zfar))


def test_colour_agrees_with_mujoco(references):
    arrays, _, drawn = references
    labels = arrays["segmentation"]
    compared = away_from_silhouettes(labels) & (drawn.segmentation == labels)
    error = np.abs(drawn.rgb.astype(float) - arrays["rgb"]).mean(-1)
    assert error[compared & (labels >= 0)].mean() <= 4
    assert error[compared & (labels < 0)].mean() <= 1
    for geom in (0, 2, 3, 4, 5, 6):  # 1 is a plane that is also seen from behind, where MuJoCo makes it half transparent
        assert error[compared & (labels == geom)].mean() <= 1, geom


def test_depth_of_a_ball_in_the_middle(ball):
    _, mj_data, scene = ball
    frame = render(scene, mj_data)
    assert frame.segmentation[16, 16] == 0
    assert float(frame.depth[16, 16]) == pytest.approx(1.8, abs=1e-6)
    assert float(frame.depth[0, 0]) == float(scene.zfar) == 50.0
    assert frame.rgb.shape == (33, 33, 3) and frame.rgb.dtype == jnp.uint8


def test_depth_is_planar(ball):
    mj_model, mj_data, _ = ball
    frame = render(Scene.from_mjmodel(mj_model, "front", 32, 32), mj_data)
    wall = np.asarray(frame.depth)[np.asarray(frame.segmentation) == 2]
    np.testing.assert_allclose(wall, 2.9, atol=1e-5)


def test_accepts_mjx_data_and_vmap_equals_a_loop(ball):
    mj_model, mj_data, scene = ball
    model, data = mjx.put_model(mj_model), mjx.put_data(mj_model, mj_data)
    shifts = jnp.linspace(-0.3, 0.3, 3)

    def drawn(shift):
        return render(scene, mjx.kinematics(model, data.replace(qpos=data.qpos.at[0].set(shift))))

    batch = jaxrl_vis_envs.jit(jax.vmap(drawn))(shifts)
    one = jaxrl_vis_envs.jit(drawn)
    for index, shift in enumerate(shifts):
        single = one(shift)
        np.testing.assert_allclose(batch.depth[index], single.depth, atol=1e-5)
        assert np.mean(np.asarray(batch.segmentation[index]) == np.asarray(single.segmentation)) > 0.998
        assert np.mean(np.abs(np.asarray(batch.rgb[index], int) - np.asarray(single.rgb, int)) <= 1) > 0.998
    assert not np.array_equal(batch.rgb[0], batch.rgb[1])
    assert not np.array_equal(batch.depth[0], batch.depth[2])


def test_runs_inside_scan(ball):
    _, mj_data, scene = ball
    poses = poses_of(mj_data)

    def body(height, _):
        moved = scene.replace(camera_position=scene.camera_position + jnp.array([0.0, 0.0, 1.0]) * height)
        return height + 0.1, render_planes(moved, SimpleNamespace(**poses), rgb=False).depth

    depths = jaxrl_vis_envs.jit(lambda: jax.lax.scan(body, 0.0, None, length=3)[1])()
    assert depths.shape == (3, 33, 33)
    assert not np.array_equal(depths[0], depths[2])


def test_a_subset_equals_the_whole(references):
    arrays, scene, drawn = references
    poses = {name: arrays[name][0] for name in POSES}
    depth_only = render_planes(scene, SimpleNamespace(**poses), rgb=False)
    assert depth_only.rgb is None and depth_only.segmentation is None
    np.testing.assert_allclose(depth_only.depth, drawn.depth[0], rtol=1e-5)
    whole = render_planes(scene, SimpleNamespace(**poses), segmentation=True)
    assert whole.rgb.shape == (3, scene.height, scene.width)
    rounded = np.moveaxis(np.floor(np.asarray(whole.rgb) * 255 + 0.5), 0, -1)
    assert np.mean(np.abs(rounded - drawn.rgb[0]) <= 1) > 0.999
    assert np.mean(np.asarray(whole.segmentation) == drawn.segmentation[0]) > 0.999


@pytest.mark.parametrize("broken", ["geom_xpos", "geom_xmat"])
def test_a_geom_with_a_nan_pose_is_not_drawn(ball, broken):
    _, mj_data, scene = ball
    poses = poses_of(mj_data)
    poses[broken][0].flat[1] = np.nan
    frame = draw(scene, poses)
    assert frame.segmentation[16, 16] == 2  # the wall behind the ball
    assert np.all(np.isfinite(frame.depth))
    assert 0 not in np.asarray(frame.segmentation)


def test_a_nan_camera_sees_only_sky(ball):
    _, mj_data, scene = ball
    frame = draw(scene.replace(camera_position=np.full(3, np.nan)), poses_of(mj_data))
    assert np.all(np.asarray(frame.segmentation) == -1)
    np.testing.assert_array_equal(frame.depth, float(scene.zfar))


def test_geoms_are_see_through_from_inside(ball):
    _, mj_data, scene = ball
    poses = poses_of(mj_data)
    assert int(draw(scene.replace(camera_position=poses["geom_xpos"][0]), poses).segmentation[16, 16]) == 2


def test_gradient_of_depth_with_respect_to_a_pose(ball):
    _, mj_data, scene = ball
    poses = poses_of(mj_data)

    def depth(shift, row, column):
        moved = poses | {"geom_xpos": jnp.asarray(poses["geom_xpos"]) + shift}
        return render_planes(scene, SimpleNamespace(**moved), rgb=False).depth[row, column]

    toward = jaxrl_vis_envs.jit(jax.grad(depth), static_argnums=(1, 2))
    np.testing.assert_allclose(toward(jnp.zeros(3), 16, 16), [0.0, 1.0, 0.0], atol=1e-5)
    # Also finite where other objects' rays miss, and through the colours.
    assert np.all(np.isfinite(toward(jnp.zeros(3), 3, 3)))

    def brightness(shift):
        moved = poses | {"geom_xpos": jnp.asarray(poses["geom_xpos"]) + shift}
        return render_planes(scene, SimpleNamespace(**moved)).rgb.sum()

    assert np.all(np.isfinite(jaxrl_vis_envs.jit(jax.grad(brightness))(jnp.zeros(3))))


def test_appearance_can_differ_within_a_batch(ball):
    _, mj_data, scene = ball
    poses = poses_of(mj_data)
    rgba = jnp.stack([scene.rgba, scene.rgba.at[0, :3].set(jnp.array([1.0, 0.0, 0.0]))])
    size = jnp.stack([scene.size, scene.size.at[0].mul(0.5)])
    frames = jaxrl_vis_envs.jit(jax.vmap(lambda rgba, size: draw(scene.replace(rgba=rgba, size=size), poses)))(rgba, size)
    assert frames.rgb[0, 16, 16, 1] > 0 and frames.rgb[1, 16, 16, 1] < frames.rgb[1, 16, 16, 0]
    np.testing.assert_allclose(frames.depth[:, 16, 16], [1.8, 1.9], atol=1e-6)


def test_an_empty_scene_is_sky(ball):
    mj_model, mj_data, _ = ball
    frame = render(Scene.from_mjmodel(mj_model, "front", 4, 6, groups=(5,)), mj_data)
    assert frame.rgb.shape == (4, 6, 3) and not frame.rgb.any()
    assert np.all(np.asarray(frame.segmentation) == -1)


def test_a_signed_distance_field_is_drawn_through_its_mesh():
    xml = """<mujoco><asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset><worldbody>
      <geom name="statue" type="{kind}" mesh="m"/><camera name="front" pos=".2 .2 3"/></worldbody></mujoco>"""
    shown = []
    for kind in ("sdf", "mesh"):
        mj_model = mujoco.MjModel.from_xml_string(xml.format(kind=kind))
        mj_data = mujoco.MjData(mj_model)
        mujoco.mj_forward(mj_model, mj_data)
        shown.append(render(Scene.from_mjmodel(mj_model, "front", 16, 16), mj_data))
    assert np.any(np.asarray(shown[0].segmentation) == 0)
    jax.tree.map(np.testing.assert_array_equal, *shown)


def test_unknown_camera_error_lists_the_cameras(ball):
    with pytest.raises(ValueError, match="'side'.*'front'"):
        Scene.from_mjmodel(ball[0], "side")


@pytest.mark.parametrize(("height", "width", "named"), [(0, 4, "height=0"), (4, 4.5, "width=4.5"), ("4", 4, "height='4'")])
def test_image_sizes_must_be_positive_integers(ball, height, width, named):
    with pytest.raises(ValueError, match=named):
        Scene.from_mjmodel(ball[0], "front", height, width)
    assert Scene.from_mjmodel(ball[0], "front", np.int64(3), 4).height == 3


def test_leave_out_names_must_exist(ball):
    with pytest.raises(ValueError, match="'nosuch'.*'ball', 'ghost', 'wall'") as refusal:
        Scene.from_mjmodel(ball[0], "front", leave_out=("ball", "nosuch"))
    assert "\n" not in str(refusal.value) and "'ball'" not in str(refusal.value).partition(":")[0]
    assert len(Scene.from_mjmodel(ball[0], "front", leave_out=("ball", "skin", "flex")).object_ids) == 1


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (lambda _: ("model.xml",), "not from a str; mujoco.MjModel.from_xml_path"),
        (lambda _: (mujoco.MjSpec(),), "not from a MjSpec; its compile"),
        (lambda model: (mjx.put_model(model),), "not from a Model; mjx.put_model was given one"),
        (lambda model: (model, ("front", "side")), "a scene has one camera: .* got a tuple"),
        (lambda model: (model, 0.5), "a scene has one camera: .* got a float"),
        (lambda model: (model, None, 4, 4, "all"), "groups must be group numbers.*'all'"),
        (lambda model: (model, None, 4, 4, (0,), None), "site_groups must be group numbers.*None"),
        (lambda model: (model, None, 4, 4, (0,), (), True, False, False, None, "ball"), "leave_out must be .*'ball'"),
    ],
)
def test_invalid_scene_arguments_raise_one_line(ball, given, said):
    with pytest.raises(ValueError, match=said) as refusal:
        Scene.from_mjmodel(*given(ball[0]))
    assert "\n" not in str(refusal.value)


def test_groups_may_be_any_collection(ball):
    for groups in ({4}, [4], np.array([4]), range(4, 5), 4):
        assert Scene.from_mjmodel(ball[0], "front", groups=groups).object_ids == (1,)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (lambda scene, data: (data, scene), "the scene, .* comes first, .* got MjData"),
        (lambda scene, _: (scene, None), "mjx.Data or mujoco.MjData; NoneType has no geom_xpos"),
        (lambda scene, data: (scene, SimpleNamespace(data=data)), "such as state.data; SimpleNamespace has no geom_xpos"),
        (lambda scene, data: (scene, SimpleNamespace(**poses_of(data, 2))), r"\(3, 3\), got \(2, 3, 3\); jax.vmap"),
        (lambda scene, data: (scene, SimpleNamespace(**poses_of(data) | {"geom_xpos": np.zeros((2, 3))})), "models differ"),
        (
            lambda scene, data: (
                scene.replace(camera_mount=Mount(0, 1, -1)),
                SimpleNamespace(**poses_of(data) | {"xpos": np.zeros((1, 3))}),
            ),
            "at least 2",
        ),
    ],
)
def test_poses_of_another_scene_raise_one_line(ball, given, said):
    with pytest.raises(ValueError, match=said) as refusal:
        render_planes(*given(ball[2], ball[1]))
    assert "\n" not in str(refusal.value)


def test_leaves_may_be_plain_numbers(ball):
    _, mj_data, scene = ball
    given = render_planes(scene.replace(fovy=30, zfar=8, rgba=np.array(scene.rgba, np.float64)), mj_data, rgb=False)
    stated = render_planes(scene.replace(fovy=jnp.float32(30.0), zfar=jnp.float32(8.0)), mj_data, rgb=False)
    assert given.depth.dtype == jnp.float32
    np.testing.assert_array_equal(given.depth, stated.depth)


def test_only_requested_planes_are_returned(ball):
    assert render_planes(ball[2], ball[1], rgb=False, depth=False) == (None, None, None, None, None)


@pytest.mark.parametrize(
    ("height", "width", "said"), [(-1, 4, "height=-1"), (4, 5.5, "width=5.5"), (4, 9999, "offwidth of the")]
)
def test_sizes_mujoco_cannot_render_raise_one_line(ball, height, width, said):
    """The size is checked before GL is initialised."""
    with pytest.raises(ValueError, match=said) as refusal:
        ReferenceRenderer(ball[0], height, width)
    assert "\n" not in str(refusal.value)
