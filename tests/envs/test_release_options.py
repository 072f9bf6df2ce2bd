"""Options that revert a deviation from the authors' release: each changes only its own property."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from point_mass import PointMass, PointMassConfig

import jaxrl_vis_envs
from jaxrl_vis_envs import pixels
from jaxrl_vis_envs.render import Scene, render

COUNT, SIZE = 8, 48
KEYS = jax.random.split(jax.random.key(5), COUNT)


@functools.cache
def make(name: str, **options: Any) -> Any:
    return jaxrl_vis_envs.make(name, **options)


@functools.cache
def poses(name: str, **options: Any) -> tuple[Any, Any, np.ndarray]:
    """Return COUNT starts, the configurations that their goals show, and the goal states."""
    env = make(name, **options)

    def sample(key: jax.Array) -> tuple[Any, Any, jax.Array]:
        goal = env.sample_goal(key)
        return env.sample_start(key), goal, env.goal_state(key, goal)

    return jax.device_get(jaxrl_vis_envs.jit(jax.vmap(sample))(KEYS))


@functools.cache
def images(**options: Any) -> np.ndarray:
    """Return images of the starts, then of the goals: [2 COUNT, 4, SIZE, SIZE] uint8."""
    env = make("VisualFetchReach", image_size=SIZE, **options)
    cross_hair = {name: value for name, value in options.items() if name == "cross_hair"}
    start, goal, _ = poses("VisualFetchReach", image_size=SIZE, **cross_hair)
    data = jax.tree.map(lambda *leaves: np.concatenate(leaves), start, goal)
    return np.asarray(jaxrl_vis_envs.jit(jax.vmap(lambda data: env.observe(env.state_at(data, jnp.zeros(3)))))(data))


def assert_same_configuration(one: Any, other: Any) -> None:
    """Compare up to the rounding of two programs."""
    for name in ("qpos", "qvel", "qacc_warmstart", "mocap_quat", "site_xpos"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=2e-6)


def test_the_release_shows_the_grip_two_centimetres_off_its_goal():
    (start, goals, goal_state), (their_start, their_goals, their_goal_state) = (
        poses("FetchReach"),
        poses("FetchReach", goal_at="link"),
    )
    grip, link = make("FetchReach")._grip, make("FetchReach")._hand
    # Ours: the goal state is where the grip is in the image. Theirs: where the gripper's link was sent, above it.
    np.testing.assert_array_equal(goal_state, goals.site_xpos[:, grip])
    off = np.linalg.norm(their_goal_state - their_goals.site_xpos[:, grip], axis=-1)
    high = their_goal_state[:, 2] > 0.44  # the table keeps the others up
    assert high.sum() > COUNT / 2
    assert (0.015 < off[high]).all() and np.median(off) == pytest.approx(0.02, abs=0.001)
    np.testing.assert_allclose(their_goal_state[high], their_goals.xpos[high, link], atol=0.01)
    # The same points are asked for, and episodes start in the same way.
    np.testing.assert_allclose(their_goal_state, goal_state, atol=0.015)
    assert_same_configuration(start, their_start)


def test_goal_image_shows_the_biased_goal_configuration():
    env = make("FetchReach", goal_at="link")
    state = jaxrl_vis_envs.jit(jax.vmap(env.reset))(KEYS)
    _, goals, goal_state = poses("FetchReach", goal_at="link")
    np.testing.assert_allclose(state.obs["desired_goal"][:, :3], goals.site_xpos[:, env._grip], atol=2e-6)
    np.testing.assert_allclose(state.goal_state, goal_state, atol=2e-6)


def test_the_cross_hair_stands_at_the_goal_in_the_first_image():
    plain, crossed = (make("VisualFetchReach", image_size=SIZE, **option) for option in ({}, {"cross_hair": True}))
    start, goals, goal_state = poses("VisualFetchReach", image_size=SIZE)
    crossed_start, crossed_goals, crossed_goal_state = poses("VisualFetchReach", image_size=SIZE, cross_hair=True)
    mocap = crossed.mj_model.body("mocap").id
    np.testing.assert_array_equal(crossed_start.mocap_pos, crossed_goals.mocap_pos)
    np.testing.assert_array_equal(crossed_start.xpos[:, mocap], crossed_start.mocap_pos[:, 0])
    np.testing.assert_allclose(crossed_start.xpos[:, mocap], goals.xpos[:, plain._hand], atol=0.015)
    # Nothing else is elsewhere.
    np.testing.assert_allclose(crossed_goal_state, goal_state, atol=2e-6)
    assert_same_configuration(crossed_start, start)
    assert_same_configuration(crossed_goals, goals)
    # Thin green lines, on a background that keeps more of its green than of the rest.
    changed = (images(cross_hair=True)[:, :3] != images()[:, :3]).any(axis=1)
    assert (changed.sum(axis=(1, 2)) > 20).all() and changed.mean() < 0.1
    red, green, blue = np.moveaxis(images(cross_hair=True)[:, :3].astype(int) - images()[:, :3], 1, 0)
    assert (green > np.maximum(red, blue))[changed].mean() > 0.9


def test_cross_hair_does_not_affect_physics():
    plain, crossed = (make("VisualFetchReach", image_size=SIZE, **option).mj_model for option in ({}, {"cross_hair": True}))
    assert crossed.ngeom == plain.ngeom + 4 and (crossed.nv, crossed.npair, crossed.neq) == (plain.nv, plain.npair, plain.neq)
    for prefix in (
        "body_mass",
        "body_inertia",
        "body_invweight0",
        "body_ipos",
        "dof_",
        "jnt_",
        "eq_",
        "pair_friction",
        "pair_sol",
    ):
        for name in (name for name in dir(plain) if name.startswith(prefix) and isinstance(getattr(plain, name), np.ndarray)):
            np.testing.assert_array_equal(getattr(crossed, name), getattr(plain, name), err_msg=name)
    added = [geom for geom in range(crossed.ngeom) if crossed.geom_bodyid[geom] == crossed.body("mocap").id]
    assert len(added) == 4 and not crossed.geom_contype[added].any() and not crossed.geom_conaffinity[added].any()


def test_grey_fingers():
    """Only the colours of visible finger pixels differ; depth is the same."""
    model = make("VisualFetchReach", image_size=SIZE).mj_model
    fingers = [model.geom(name).id for name in ("left_finger", "right_finger")]
    scene = Scene.from_mjmodel(model, camera="front", height=SIZE, width=SIZE)
    start = jax.tree.map(lambda leaf: leaf[0], poses("VisualFetchReach", image_size=SIZE)[0])
    labels = np.asarray(jaxrl_vis_envs.jit(lambda data: render(scene, data).segmentation)(start))
    grey, orange = images(finger_colour="grey")[0], images()[0]
    assert np.isin(labels, fingers).sum() > 5
    np.testing.assert_array_equal((grey != orange)[:3].any(axis=0), np.isin(labels, fingers))
    np.testing.assert_array_equal(grey[3], orange[3])


def test_release_view_of_the_hand():
    env = make("VisualHandReach", image_size=SIZE, view="fingertips")
    data = mujoco.MjData(env.mj_model)
    mujoco.mj_forward(env.mj_model, data)
    camera = data.camera(env.camera)
    right, up, back = camera.xmat.reshape(3, 3).T
    np.testing.assert_allclose(camera.xpos, (1.0, 0.05, 0.15))
    np.testing.assert_allclose((right, up, back), ((1, 0, 0), (0, 0, 1), (0, -1, 0)), atol=1e-9)
    assert env.mj_model.camera(env.camera).fovy == 12 and env.observation_spec.shape == (4, SIZE, SIZE)
    assert make("VisualHandReach", image_size=SIZE).camera == make("HandReach").camera == "front"
    # What is drawn is what that camera sees: fingertips in a row, from the thumb's to the little finger's.
    scene = Scene.from_mjmodel(env.mj_model, camera=env.camera, height=SIZE, width=SIZE)
    labels = np.asarray(jaxrl_vis_envs.jit(lambda data: render(scene, data).segmentation)(env._start))
    columns = [np.nonzero(labels == env.mj_model.geom(f"{name}tip").id)[1].mean() for name in ("th", "ff", "mf", "rf", "lf")]
    assert columns == sorted(columns)


def test_faint_marks_of_fingertips():
    """Only the colours of visible tips and their links differ, and nothing else in the model."""
    faint, bright = (make("VisualHandReach", image_size=SIZE, tip_marks=marks).mj_model for marks in ("faint", "bright"))
    marks = [faint.geom(f"{finger}tip").id for finger in ("ff", "mf", "rf", "lf", "th")]
    links = [faint.geom(f"{finger}distal").id for finger in ("ff", "mf", "rf", "lf", "th")]
    np.testing.assert_allclose(faint.geom_rgba[marks, 3], 0.2)
    assert (np.ptp(faint.geom_rgba[links], axis=0) == 0).all() and (np.ptp(bright.geom_rgba[links], axis=0) > 0)[:3].all()
    others = np.setdiff1d(np.arange(faint.ngeom), marks + links)
    for name in ("geom_rgba", "geom_size"):
        np.testing.assert_array_equal(getattr(faint, name)[others], getattr(bright, name)[others])
    for name in ("body_mass", "body_inertia", "pair_geom1", "jnt_range", "qpos0"):
        np.testing.assert_array_equal(getattr(faint, name), getattr(bright, name))
    env = make("VisualHandReach", image_size=SIZE)
    scene = Scene.from_mjmodel(env.mj_model, camera="front", height=SIZE, width=SIZE)
    labels = np.asarray(jaxrl_vis_envs.jit(lambda data: render(scene, data).segmentation)(env._start))
    of = {name: make("VisualHandReach", image_size=SIZE, tip_marks=name) for name in ("faint", "bright")}
    one, other = (
        np.asarray(jaxrl_vis_envs.jit(env.observe)(env.state_at(env._start, jnp.zeros(15)))).astype(int) for env in of.values()
    )
    changed = (np.abs(one - other)[:3] > 1).any(axis=0)  # two programs round differently
    assert changed.sum() > 20 and np.isin(labels[changed], marks + links).all()


def test_zbuffer_depth_matches_opengl():
    near, far = 0.026, 130.0
    depth = jnp.array([0.0, near, 0.05, 0.4, 1.8, far, 1000.0, jnp.inf])
    # z of a depth by the projection matrix: (1 + its third row over its fourth) / 2.
    finite = np.clip(np.asarray(depth[1:-1], np.float64), None, far)
    clip = (far + near) / (far - near) * finite - 2 * far * near / (far - near)
    z = 0.5 * (1 + clip / finite)
    encoded = np.asarray(pixels.encode_zbuffer(depth, (near, far)))
    np.testing.assert_array_equal(encoded[1:-1], np.round(255 * z))
    assert encoded[0] == 0 and encoded[-2] == encoded[-1] == 255


def test_zbuffer_changes_only_the_depth_encoding():
    ranges = {"clip_range": (0.5, 1.5)}
    metric, zbuffer = (
        PointMass(PointMassConfig(image_size=16, depth_encoding=encoding, **ranges)) for encoding in ("metric", "zbuffer")
    )
    key = jax.random.key(0)
    one, other = (jaxrl_vis_envs.jit(env.reset)(key).obs["observation"] for env in (metric, zbuffer))
    np.testing.assert_array_equal(one[:3], other[:3])
    depth = pixels.decode_depth(one[3], (0.5, 1.5))
    expected = np.asarray(pixels.encode_zbuffer(depth, (0.5, 1.5)), int)
    assert np.abs(np.asarray(other[3], int) - expected).max() <= 2 and (one[3] != other[3]).any()


def test_finger_turn_can_observe_a_single_image():
    env = jaxrl_vis_envs.make("VisualFingerTurn", image_size=8, frame_stack=1)
    assert env.observation_spec.shape == (4, 8, 8)
