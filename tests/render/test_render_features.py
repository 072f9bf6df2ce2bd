"""Features of the renderer, against geometry and against itself; test_render_parity.py compares with MuJoCo."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxrl_vis_envs
from jaxrl_vis_envs.render import Scene, images, render, render_planes
from jaxrl_vis_envs.render.pixel import blocks, raycast

POSES = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "xpos", "xmat")
HEAD = '<visual><headlight ambient="{} {} {}" diffuse="0 0 0" specular="0 0 0"/></visual><statistic extent="1"/>'
FLAT_LIGHT = HEAD.format(1, 1, 1)
ABOVE = '<camera name="above" pos="0 0 2" fovy="45"/>'


def load(body: str, header: str = FLAT_LIGHT, assets: str = ""):
    """Return model and data after forward kinematics."""
    xml = f"<mujoco>{header}<asset>{assets}</asset><worldbody>{body}</worldbody></mujoco>"
    mj_model = mujoco.MjModel.from_xml_string(xml)
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    return mj_model, mj_data


def drawn(body: str, camera: str = "above", size: int = 17, header: str = FLAT_LIGHT, assets: str = "", **options):
    """Render a scene of ``body`` as NumPy arrays, with normals and distance."""
    mj_model, mj_data = load(body, header, assets)
    scene = Scene.from_mjmodel(mj_model, camera, size, size, **options)
    return shown(scene, mj_data)


@jaxrl_vis_envs.jit
def draw(scene: Scene, poses: dict):
    """Render with normals and distance; compiled once for all scenes that differ only in numerical values."""
    return render(scene, SimpleNamespace(**poses), normals=True, distance=True)


def shown(scene: Scene, mj_data):
    """Render an image as NumPy arrays, with normals and distance."""
    poses = {name: np.array(getattr(mj_data, name), np.float32) for name in POSES}
    return jax.tree.map(np.asarray, draw(scene, poses))


def test_normals_and_distance_of_a_ball():
    frame = drawn('<geom type="sphere" size=".5"/>' + ABOVE)
    np.testing.assert_allclose(frame.normals[8, 8], [0, 0, 1], atol=1e-6)
    rows, columns = np.nonzero(frame.segmentation == 0)
    pitch = 2 * np.tan(np.pi / 8) / 17
    ray = np.stack([(columns - 8) * pitch, (8 - rows) * pitch, -np.ones(len(rows))], 1)
    point = ray * frame.depth[rows, columns, None]
    np.testing.assert_allclose(frame.normals[rows, columns], (point - [0, 0, -2]) / 0.5, atol=1e-5)
    np.testing.assert_allclose(frame.distance[rows, columns], np.linalg.norm(point, axis=1), rtol=1e-6)
    assert not frame.normals[0, 0].any() and frame.distance[0, 0] == frame.depth[0, 0] == 50.0


def test_only_requested_outputs_are_computed():
    mj_model, mj_data = load('<geom type="box" size=".3 .3 .3"/>' + ABOVE)
    scene = Scene.from_mjmodel(mj_model, "above", 8, 12)
    everything = dict(rgb=True, depth=True, segmentation=True, normals=True, distance=True)
    poses = {name: np.array(getattr(mj_data, name), np.float32) for name in POSES}

    def planes(**wanted):
        return jaxrl_vis_envs.jit(lambda scene, poses: render_planes(scene, SimpleNamespace(**poses), **wanted))(scene, poses)

    whole = planes(**everything)
    shapes = dict(rgb=(3, 8, 12), depth=(8, 12), segmentation=(8, 12), normals=(3, 8, 12), distance=(8, 12))
    for name, shape in shapes.items():
        alone = planes(**{other: other == name for other in everything})
        assert [field for field in shapes if getattr(alone, field) is not None] == [name]
        assert getattr(alone, name).shape == shape
        np.testing.assert_allclose(getattr(alone, name), getattr(whole, name), atol=1e-5)


def test_an_orthographic_camera():
    body = '<geom type="box" size=".25 .5 .1"/><camera name="above" pos="0 0 2" projection="orthographic" fovy="2"/>'
    frame = drawn(body, size=20)
    assert (frame.segmentation[10] == 0).sum() == 5 and (frame.segmentation[:, 10] == 0).sum() == 10
    np.testing.assert_allclose(frame.depth[frame.segmentation == 0], 1.9, rtol=1e-6)
    np.testing.assert_array_equal(frame.depth, frame.distance)


def test_orthographic_camera_culls_planes_like_mujoco():
    """Regression test (render_parity.py, camera_ortho, pose 12 of seed 0): position and direction must agree on the side."""
    planes = "".join(
        f'<geom type="plane" size=".5 .5 .1" pos="{x} 0 0" zaxis="{normal}"/>'
        for x, normal in ((-2, ".9 0 -.3"), (0, ".9 0 .3"), (2, ".9 0 .3"))
    )
    camera = '<camera name="above" pos="0 0 2" projection="orthographic" fovy="6"/>'
    frame = drawn(planes + camera, size=41, plane_backs=False)
    assert set(np.unique(frame.segmentation)) == {-1, 1}


def test_a_camera_with_a_sensor():
    lens = 'focal=".02 .04" sensorsize=".04 .04" resolution="20 20" principal=".005 .01"'
    frame = drawn(f'<geom type="sphere" size=".06"/><camera name="above" pos="0 0 2" {lens}/>', size=20)
    rows, columns = np.nonzero(frame.segmentation == 0)
    # u = (principal + x sensor / 2) / focal: the axis is a quarter of the sensor left of its middle, and half of it up.
    np.testing.assert_allclose([columns.mean(), rows.mean()], [9.5 - 2.5, 9.5 - 5.0], atol=0.6)


def test_the_camera_of_the_scene_can_be_moved():
    mj_model, mj_data = load('<geom type="box" size=".3 .4 .1" pos=".1 0 0"/>' + ABOVE)
    scene = Scene.from_mjmodel(mj_model, "above", 17, 17)
    moved = scene.replace(camera_shift=jnp.array([0.2, -0.1, 0.3]), camera_turn=jnp.array([0.1, -0.2, 0.5]))
    turn = np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, np.array([0.1, -0.2, 0.5]) / np.sqrt(0.3), np.sqrt(0.3))
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, turn)
    position = scene.camera_position + jnp.array([0.2, -0.1, 0.3])
    expected = shown(scene.replace(camera_position=position, camera_axes=rotation.reshape(3, 3)), mj_data)
    np.testing.assert_allclose(shown(moved, mj_data).depth, expected.depth, atol=1e-5)


def test_a_box_of_triangles_is_a_box():
    corners = " ".join(f"{x} {y} {z}" for x in (-0.3, 0.3) for y in (-0.2, 0.2) for z in (-0.1, 0.1))
    pose = 'pos=".1 0 0" quat=".8 .3 .4 -.2"'
    light = '<light pos="1 -1 2" dir="-.3 .3 -1" diffuse=".6 .6 .6" specular="0 0 0" cutoff="80"/>'
    camera = light + '<geom type="plane" size="1 1 .1" pos="0 0 -.4"/>' + ABOVE
    box = drawn(f'<geom type="box" size=".3 .2 .1" {pose}/>' + camera, size=40)
    mesh = drawn(f'<geom type="mesh" mesh="m" {pose}/>' + camera, size=40, assets=f'<mesh name="m" vertex="{corners}"/>')
    same = box.segmentation == mesh.segmentation
    assert same.mean() > 0.995 and (box.segmentation == 0).sum() > 100
    np.testing.assert_allclose(box.depth[same], mesh.depth[same], atol=1e-5)
    seen = same & (box.segmentation == 0)
    # Near an edge a ray that meets one face a hair away from it may meet the other.
    assert np.mean(np.abs(box.normals[seen] - mesh.normals[seen]).max(-1) < 1e-4) > 0.98


def test_a_height_field_has_the_heights_of_its_grid():
    heights = np.array([[0.0, 0.2, 0.4], [0.2, 0.6, 0.8], [0.4, 0.8, 1.0]])
    grid = " ".join(str(value) for value in heights.reshape(-1))
    assets = f'<hfield name="h" nrow="3" ncol="3" size=".5 .5 .4 .1" elevation="{grid}"/>'
    camera = '<camera name="above" pos="0 0 2" projection="orthographic" fovy="1"/>'
    frame = drawn('<geom type="hfield" hfield="h"/>' + camera, size=21, assets=assets)
    assert np.all(frame.segmentation == 0)
    # The pixel in the middle looks at the middle vertex; the first and the last row are 1/42 m inside of the border.
    np.testing.assert_allclose(frame.depth[10, 10], 2.0 - 0.4 * 0.6, atol=1e-4)
    half = 0.5 * 20 / 21
    share = half / 0.5
    along_edge = 0.2 + (0.6 - 0.2) * (1 - share)  # a line of the grid: along y = 0
    np.testing.assert_allclose(frame.depth[10, 0], 2.0 - 0.4 * along_edge, atol=1e-4)


def test_transparent_objects_show_the_background():
    body = '<geom type="box" size=".5 .5 .1" rgba="0 0 1 1"/><geom type="box" size=".2 .2 .1" pos="0 0 .5" rgba="1 0 0 .25"/>'
    frame = drawn(body + ABOVE, header=FLAT_LIGHT)
    covered = 1 - 0.75**2  # MuJoCo draws it twice
    np.testing.assert_allclose(frame.rgb[8, 8] / 255, [covered, 0, 1 - covered], atol=0.01)
    assert frame.segmentation[8, 8] == 1 and frame.depth[8, 8] == pytest.approx(1.4, abs=1e-5)
    mesh = '<mesh name="m" vertex="-.2 -.2 0 .2 -.2 0 .2 .2 0 -.2 .2 0 0 0 .1"/>'
    body = '<geom type="box" size=".5 .5 .1" rgba="0 0 1 1"/><geom type="mesh" mesh="m" pos="0 0 .5" rgba="1 0 0 .25"/>'
    assert np.abs(drawn(body + ABOVE, assets=mesh).rgb[8, 8] - frame.rgb[8, 8].astype(int)).max() <= 2


@pytest.mark.parametrize("turn", ["0 0 0", "180 0 0", "90 0 0", "-90 0 0", "0 90 0", "0 -90 0"])
def test_shared_edges_and_corners_of_transparent_triangles_are_blended_once(turn):
    """An octahedron seen along each axis: pixel centres lie on its nearest corner and on all edges that end there."""
    corners = ".3 0 0 -.3 0 0 0 .35 0 0 -.35 0 0 0 .4 0 0 -.4"
    body = '<geom type="plane" size="2 2 .1" pos="0 0 -.6" rgba="0 0 1 1"/>'
    body += f'<geom type="mesh" mesh="m" rgba="1 0 0 .25" euler="{turn}"/>'
    body += '<camera name="above" pos="0 0 2" projection="orthographic" fovy="1"/>'
    frame = drawn(body, assets=f'<mesh name="m" vertex="{corners}"/>')
    seen = frame.segmentation == 1
    assert seen[8, 4:13].all() and seen[4:13, 8].all()
    assert np.ptp(frame.rgb[seen].astype(int), axis=0).max() <= 1


def test_planes_are_transparent_from_behind():
    body = '<geom type="plane" size="1 1 .1" rgba="1 0 0 1"/><geom type="sphere" size=".2" pos="0 0 .5" rgba="0 0 1 1"/>'
    body += '<camera name="below" pos="0 0 -2" xyaxes="1 0 0 0 -1 0"/><camera name="above" pos="0 0 2"/>'
    below, above = (drawn(body, camera, plane_backs=True) for camera in ("below", "above"))
    assert below.rgb[8, 8, 2] > 50 and below.rgb[8, 8, 0] > 50
    mj_model, _ = load(body)
    # Unasked, those are that the camera is behind of at the start.
    assert [Scene.from_mjmodel(mj_model, camera).transparent for camera in ("below", "above")] == [(0, 2), (0, 0)]
    np.testing.assert_array_equal(above.rgb, drawn(body, "above").rgb)
    assert not drawn(body, "below", plane_backs=False).rgb[8, 8, 2]


def test_shapes_without_thickness_are_sheets_and_without_area_are_hidden():
    """test_render_parity.py compares with MuJoCo; here, both CPU implementations must agree."""
    things = {"box": (0.2, 0.15, 0.0), "cylinder": (0.2, 0.0, 0.0), "capsule": (0.2, 0.0, 0.0), "sphere": (0.0, 0.0, 0.0)}
    body = "".join(f'<geom type="{kind}" size=".2 .2 .2" pos="{x} 0 0"/>' for x, kind in zip((-0.6, -0.2, 0.2, 0.6), things))
    mj_model, mj_data = load(body + ABOVE)
    mj_model.geom_size[:] = list(things.values())
    scene = Scene.from_mjmodel(mj_model, "above", 41, 41)
    poses = {name: np.array(getattr(mj_data, name), np.float32) for name in POSES}

    def depth_and_labels(scene, poses, **more):
        planes = render_planes(scene, SimpleNamespace(**poses), rgb=False, segmentation=True, **more)
        return planes.depth, planes.segmentation

    both = jaxrl_vis_envs.jit(lambda *given: (depth_and_labels(*given), depth_and_labels(*given, distance=True)))
    (depth, labels), (plain_depth, plain_labels) = both(scene, poses)
    np.testing.assert_array_equal(labels, plain_labels)
    np.testing.assert_allclose(depth, plain_depth, rtol=1e-5)
    assert set(np.unique(labels)) == {-1, 0, 1}
    np.testing.assert_allclose(np.asarray(depth)[np.asarray(labels) >= 0], 2.0, atol=1e-4)
    assert np.mean(np.asarray(labels) == 0) < 0.1


def test_shadows_fall_where_the_light_is_hidden():
    light = '<light directional="true" dir="0 0 -1" diffuse=".5 .5 .5" ambient="0 0 0" castshadow="{}"/>'
    body = '<geom type="plane" size="2 2 .1"/><geom type="{}" pos="0 0 .5"/>'
    body += '<camera name="above" pos="1.5 0 1.5" xyaxes="0 1 0 -1 0 1"/>'
    dark = HEAD.format(0.1, 0.1, 0.1)
    octahedron = '<mesh name="m" vertex=".2 0 0 -.2 0 0 0 .2 0 0 -.2 0 0 0 .2 0 0 -.2"/>'
    for kind in ('sphere" size=".2', 'cylinder" size=".2 .2', 'capsule" size=".2 .2', 'mesh" mesh="m'):
        given = {"size": 33, "header": dark, "assets": octahedron}
        lit, shadowed = (drawn(light.format("true") + body.format(kind), shadows=shadows, **given) for shadows in (False, True))
        floor = lit.segmentation == 0
        changed = floor & (shadowed.rgb[..., 0] < lit.rgb[..., 0] - 20)
        assert 0.005 < changed.sum() / floor.sum() < 0.2, kind
        rest = floor & ~changed
        np.testing.assert_array_equal(lit.rgb[rest], shadowed.rgb[rest])
        top = (lit.segmentation == 1) & (lit.normals @ np.array([0, np.sqrt(0.5), np.sqrt(0.5)]) > 0.5)
        np.testing.assert_array_equal(lit.rgb[top], shadowed.rgb[top])  # nothing shadows its own lit side
        without = drawn(light.format("false") + body.format(kind), shadows=True, **given)
        np.testing.assert_array_equal(without.rgb, lit.rgb)


def test_haze_lies_on_the_horizon():
    sky = '<texture type="skybox" builtin="flat" rgb1="0 0 1" rgb2="0 0 1" width="8" height="8"/>'
    body = '<geom type="plane" size="0 0 .1" rgba="1 0 0 1"/><camera name="above" pos="0 0 1" xyaxes="1 0 0 0 0 1"/>'
    header = FLAT_LIGHT.replace("<visual>", '<visual><rgba haze="0 1 0 1"/><map haze=".3"/>')
    clear, hazy = (drawn(body, size=65, header=header, assets=sky, haze=haze).rgb[:, 32] for haze in (False, True))
    assert not clear[:, 1].any()
    assert hazy[33:37, 1].max() > 100 and not hazy[0, 1] and not hazy[-1, 1]


def test_a_texture_repeats_per_object_or_per_metre():
    assets = '<texture name="t" type="2d" builtin="checker" rgb1="0 0 0" rgb2="1 1 1" width="64" height="64"/>'
    assets += (
        '<material name="o" texture="t" texrepeat="2 1"/><material name="m" texture="t" texrepeat="1 1" texuniform="true"/>'
    )
    camera = '<camera name="above" pos="0 0 2" projection="orthographic" fovy="2"/>'
    per_object = drawn('<geom type="plane" size="1 1 .1" material="o"/>' + camera, size=64, assets=assets).rgb[8, :, 0] > 127
    assert np.flatnonzero(np.diff(per_object)).tolist() == [15, 31, 47]
    per_metre = drawn('<geom type="box" size="1 1 .1" material="m"/>' + camera, size=64, assets=assets).rgb[8, :, 0] > 127
    assert np.flatnonzero(np.diff(per_metre)).tolist() == [31]
    mean = drawn('<geom type="plane" size="1 1 .1" material="o"/>' + camera, size=8, assets=assets, textured=False)
    np.testing.assert_allclose(mean.rgb, 128, atol=1)


def test_the_sky_can_be_an_image():
    sky = '<texture type="skybox" builtin="checker" rgb1="0 0 0" rgb2="1 1 1" width="64" height="64"/>'
    frame = drawn('<geom type="sphere" size=".1"/>' + ABOVE, size=32, assets=sky)
    values = frame.rgb[frame.segmentation < 0][:, 0]
    assert (values < 5).sum() > 100 and (values > 250).sum() > 100


def test_looped_and_unrolled_intersections_agree(monkeypatch):
    rng = np.random.default_rng(0)
    kinds = ("sphere", "capsule", "ellipsoid", "cylinder", "box")
    body = '<geom type="plane" size="0 0 .1"/>'
    for number in range(30):
        position, size = rng.uniform([-0.8, -0.8, 0.1], [0.8, 0.8, 0.8]), rng.uniform(0.05, 0.15, 3)
        turn = rng.normal(size=4)
        numbers = [" ".join(f"{value:.3f}" for value in values) for values in (position, size, turn)]
        body += '<geom type="{}" pos="{}" size="{}" quat="{}"/>'.format(kinds[number % 5], *numbers)
    for height, width in ((32, 32), (19, 26)):
        mj_model, mj_data = load(body + ABOVE)
        scene = Scene.from_mjmodel(mj_model, "above", height, width)
        unrolled = shown(scene, mj_data)
        monkeypatch.setattr(raycast, "MAX_UNROLLED", 0)
        assert blocks.is_tiled(scene)
        images._draw_along.clear_cache()
        looped = shown(scene, mj_data)
        monkeypatch.undo()
        images._draw_along.clear_cache()
        np.testing.assert_array_equal(unrolled.segmentation, looped.segmentation)
        np.testing.assert_allclose(unrolled.depth, looped.depth, rtol=1e-5)
        assert np.mean(unrolled.rgb == looped.rgb) > 0.999


def test_all_appearance_leaves_can_be_batched_without_retracing():
    light = '<light pos="0 0 3" dir="0 0 -1" specular=".1 .1 .1"/><geom type="plane" size="1 1 .1"/>'
    mj_model, mj_data = load(light + '<geom type="box" size=".2 .2 .2"/>' + ABOVE)
    scene = Scene.from_mjmodel(mj_model, "above", 8, 8)
    names = [
        "size", "rgba", "emission", "specular", "shininess", "fovy", "camera_shift", "camera_turn", "light_position",
        "light_direction", "light_ambient", "light_diffuse", "light_specular", "light_attenuation", "light_cutoff",
        "light_exponent", "headlight_ambient", "headlight_diffuse", "sky_top", "sky_bottom", "znear", "zfar", "texture_repeat",
    ]  # fmt: skip
    traces = []

    @jaxrl_vis_envs.jit
    def draw(leaves):
        traces.append(1)
        poses = {name: jnp.asarray(getattr(mj_data, name), jnp.float32)
                 for name in POSES}  # fmt: skip
        return jax.vmap(lambda leaf: render(scene.replace(**leaf), SimpleNamespace(**poses)))(leaves)

    batch = {name: jnp.stack([getattr(scene, name), 0.8 * getattr(scene, name) + 0.01]) for name in names}
    first = draw(batch)
    second = draw(jax.tree.map(lambda leaf: 0.95 * leaf, batch))
    assert len(traces) == 1
    assert not np.array_equal(first.rgb[0], first.rgb[1]) and not np.array_equal(first.rgb, second.rgb)


REFUSALS = {
    "skin": (
        '<body name="b"><geom size=".1"/></body>' + ABOVE,
        '<skin name="coat" vertex="0 0 0 1 0 0 0 1 0" face="0 1 2"><bone body="b" bindpos="0 0 0" bindquat="1 0 0 0"'
        ' vertid="0 1 2" vertweight="1 1 1"/></skin>',
        "coat.*leave_out",
        {},
        ("skin",),
    ),
    "a flex in a group beyond the last, which counts as the last": (
        '<body name="b"><freejoint/><geom size=".1"/></body>' + ABOVE,
        '<flex name="cloth" dim="2" group="9" body="b b b" vertex="0 0 0 1 0 0 0 1 0" element="0 1 2"/>',
        "cloth.*leave_out",
        {"groups": (5,)},
        ("flex",),
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_errors_name_the_object_and_the_remedy(case):
    body, deformables, message, options, culprits = REFUSALS[case]
    xml = f"<mujoco><deformable>{deformables}</deformable><worldbody>{body}</worldbody></mujoco>"
    mj_model = mujoco.MjModel.from_xml_string(xml)
    with pytest.raises(ValueError, match=message) as refusal:
        Scene.from_mjmodel(mj_model, "above", **options)
    assert "\n" not in str(refusal.value)
    Scene.from_mjmodel(mj_model, "above", leave_out=culprits, **options)


def free_view(**changes: float) -> mujoco.MjvCamera:
    view = mujoco.MjvCamera()
    view.lookat, view.distance, view.azimuth, view.elevation = (0.0, 0.0, 0.5), 2.0, 90.0, 0.0
    for name, value in changes.items():
        setattr(view, name, value)
    return view


def test_free_camera_pose_matches_mujoco() -> None:
    """The camera looks along +y from 2 m in front of the centre: the box, half a metre to the right, appears on the right."""
    box = "<geom type='box' pos='.5 0 .5' size='.1 .1 .1'/>"
    mj_model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{box}</worldbody></mujoco>")
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    frame = shown(Scene.from_mjmodel(mj_model, free_view(), 32, 32), mj_data)
    rows, columns = np.nonzero(frame.segmentation == 0)
    assert abs(rows.mean() - 15.5) < 0.5 and columns.min() > 16
    np.testing.assert_allclose(frame.depth[rows, columns].min(), 1.9, atol=1e-5)
    behind = Scene.from_mjmodel(mj_model, free_view(azimuth=-90.0), 32, 32)
    assert np.nonzero(shown(behind, mj_data).segmentation == 0)[1].max() < 15
    default = Scene.from_mjmodel(mj_model, height=32, width=32)
    assert shown(default, mj_data).segmentation[16, 16] == 0  # the middle of the model is in the middle


def test_missing_camera_error_says_so() -> None:
    mj_model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(ValueError, match="its cameras are: none; or None for a free one"):
        Scene.from_mjmodel(mj_model, "front")
    with pytest.raises(ValueError, match="must be free or fixed"):
        Scene.from_mjmodel(mj_model, free_view(type=mujoco.mjtCamera.mjCAMERA_TRACKING))
