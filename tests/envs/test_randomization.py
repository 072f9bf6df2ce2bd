"""Domain randomisation: active ranges change only what they should; if all are off, nothing changes."""

import functools
from typing import Any, get_args

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import point_mass
import pytest
from learners import train_iteration
from point_mass import PointMass, PointMassConfig

import jaxrl_vis_envs
from jaxrl_vis.config import groups, preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis.learner.train_step import make_train_step
from jaxrl_vis_envs import pixels, randomization
from jaxrl_vis_envs.randomization import KINDS, OFF, Randomization, typical
from jaxrl_vis_envs.render import Scene, render_planes
from jaxrl_vis_envs.render.gpu import kernel

SIZE, COUNT, STEPS = 16, 3, 2
TASKS = ["FetchReach", "FingerTurn", "HandReach", "Reacher", "SawyerReach"]


def keys(first: int = 0) -> jax.Array:
    return jax.random.split(jax.random.key(first), COUNT)


def make(ranges: Randomization, task: type[PointMass] = PointMass, **options: Any) -> PointMass:
    return task(PointMassConfig(image_size=SIZE, randomization=ranges, **options))


@functools.cache
def episodes(ranges: Randomization = OFF) -> tuple[Any, Any]:
    """Return the starts of COUNT episodes, and their states after STEPS full actions."""
    env = make(ranges, point_mass.SimulatedPointMass)

    def play(keys: jax.Array) -> tuple[Any, Any]:
        start = jax.vmap(env.reset)(keys)
        action = jnp.ones((COUNT, env.action_size))
        end, _ = jax.lax.scan(lambda state, _: (jax.vmap(env.step)(state, action), None), start, length=STEPS)
        return start, end

    return jaxrl_vis_envs.jit(play)(keys())


ALL = typical(*KINDS)
LOOKS = typical("camera", "lights", "colours")
DYNAMICS = typical("dynamics")


def without_domain(state: Any) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(state.replace(domain=None))]


def test_off_adds_nothing() -> None:
    env = make(OFF)
    start = jax.eval_shape(env.reset, jax.random.key(0))
    assert start.domain is None
    with_all = jax.eval_shape(make(ALL).reset, jax.random.key(0))
    assert len(jax.tree.leaves(with_all)) == len(jax.tree.leaves(start)) + len(ALL.active)
    assert sum(leaf.size for leaf in jax.tree.leaves(with_all.domain)) < 200

    # Nor to the program: it is that of an environment without randomisation.
    class Plain(PointMass):
        def reset(self, key: jax.Array) -> Any:
            data, goal = self.sample_start(key), self.sample_goal(key)
            state = self.state_at(data, self.achieved(goal))
            both = jax.tree.map(lambda *leaves: jnp.stack(leaves), data, goal)
            frame, goal_frame = jax.lax.map(lambda data: self._observer(data, None), both)
            return state.replace(obs={"observation": frame, "achieved_goal": frame, "desired_goal": goal_frame})

    plain = Plain(env.config)
    assert str(jax.make_jaxpr(plain.reset)(jax.random.key(0))) == str(jax.make_jaxpr(env.reset)(jax.random.key(0)))


@pytest.mark.parametrize("ranges", [LOOKS, DYNAMICS], ids=["looks", "dynamics"])
def test_starts_and_goals_are_not_randomized(ranges: Randomization) -> None:
    plain, varied = episodes()[0], episodes(ranges)[0]
    np.testing.assert_array_equal(varied.achieved_state, plain.achieved_state)
    np.testing.assert_array_equal(varied.goal_state, plain.goal_state)
    np.testing.assert_array_equal(varied.data.qpos, plain.data.qpos)


def test_appearance_changes_images_but_not_physics() -> None:
    (plain_start, plain_end), (start, end) = episodes(), episodes(LOOKS)
    for before, after in ((plain_start, start), (plain_end, end)):
        for name in ("observation", "desired_goal"):
            assert (np.asarray(before.obs[name]) != np.asarray(after.obs[name])).any(axis=(1, 2, 3)).all()
        for one, other in zip(without_domain(before.replace(obs=None)), without_domain(after.replace(obs=None)), strict=True):
            np.testing.assert_array_equal(one, other)


def test_dynamics_change_motion_but_not_appearance() -> None:
    (plain_start, plain_end), (start, end) = episodes(), episodes(DYNAMICS)
    for one, other in zip(without_domain(plain_start), without_domain(start), strict=True):
        np.testing.assert_array_equal(one, other)
    moved = np.abs(np.asarray(plain_end.data.qvel - end.data.qvel))
    assert (moved.max(axis=1) > 1e-3 * np.abs(np.asarray(plain_end.data.qvel)).max()).all()


def test_environments_of_a_batch_differ_and_keys_repeat() -> None:
    start = episodes(ALL)[0]
    assert set(start.domain) == set(ALL.active)
    for name, values in start.domain.items():
        values = np.asarray(values).reshape(COUNT, -1)
        assert (np.abs(values) <= ALL.active[name]).all()
        if values.size:
            assert (values[0] != values[1]).all(), name
    # The same key draws the same, whatever else is on.
    alone = episodes(LOOKS)[0]
    for name, values in alone.domain.items():
        np.testing.assert_array_equal(values, start.domain[name])


@functools.cache
def draw_shape() -> Any:
    """Task scene, and draw(domain) -> (planes [4, H, W], geoms [H, W]) of its first start."""
    env = make(OFF)
    data = jax.tree.map(lambda leaf: leaf[0], episodes()[0].data)
    scene = Scene.from_mjmodel(env.mj_model, env.camera, SIZE, SIZE)

    def draw(scene: Scene) -> tuple[jax.Array, jax.Array]:
        planes = render_planes(scene, data, segmentation=True)
        return jnp.concatenate([planes.rgb, planes.depth[None]]), planes.segmentation

    return scene, jaxrl_vis_envs.jit(draw)


@pytest.mark.parametrize(
    ("name", "value", "geometry", "colours"),
    [
        ("camera_position", [0.1, 0.0, 0.0], True, True),
        ("camera_orientation", [0.0, 0.1, 0.0], True, True),
        ("camera_fovy", 0.2, True, True),
        ("light_direction", [[0.5, 0.0, 0.0]], False, True),
        ("light_position", [[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]], False, True),
        ("light_position", [[0.3, 0.3, 0.3], [0.0, 0.0, 0.0]], False, False),  # the first is directional
        ("light_diffuse", [[0.5, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]], False, True),
        ("light_ambient", [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.5, 0.0, 0.0]], False, True),
        ("colour", "first", False, True),
    ],
)
def test_each_appearance_range(name: str, value: Any, geometry: bool, colours: bool) -> None:
    scene, draw = draw_shape()
    if value == "first":
        value = np.zeros((len(scene.rgba), 3))
        value[0, 2] = -0.3  # the ground, blue
    domain = {name: jnp.asarray(value, jnp.float32)}
    (before, labels), (after, new_labels) = draw(scene), draw(randomization.varied_scene(scene, domain))
    before, after = np.asarray(before), np.asarray(after)
    assert ((before[3] != after[3]).any() or (np.asarray(labels) != np.asarray(new_labels)).any()) == geometry
    assert (before[:3] != after[:3]).any() == colours
    if name == "colour":  # nothing but the ground, and nothing of it but its blue
        np.testing.assert_array_equal(before[:2], after[:2])
        np.testing.assert_array_equal((before[2] != after[2]), np.asarray(labels) == 0)
    if name in ("light_diffuse", "light_ambient"):  # redder, no less green or blue
        np.testing.assert_array_equal(before[1:3], after[1:3])
        assert (after[0] >= before[0]).all()


def test_camera_translation_is_in_its_own_frame() -> None:
    scene, draw = draw_shape()
    near = randomization.varied_scene(scene, {"camera_position": jnp.array([0.0, 0.0, 0.1])})
    # 10 cm back: everything in the middle of the image is 10 cm further.
    middle = (3, SIZE // 2, SIZE // 2)
    assert float(draw(near)[0][middle] - draw(scene)[0][middle]) == pytest.approx(0.1, abs=0.02)


@pytest.mark.parametrize("task", TASKS)
def test_each_range_of_the_dynamics_scales_its_leaves(task: str) -> None:
    env = jaxrl_vis_envs.make(task, randomization=typical("dynamics"))
    domain = randomization.sample(jax.random.key(3), env.config.randomization, env._model, env.action_size, None)
    expected = {
        "mass": {"body_mass", "body_inertia"},
        "damping": {"dof_damping"},
        "friction": {"geom_friction", "pair_friction", "dof_frictionloss", "tendon_frictionloss"},
        "actuator_gain": {"actuator_gainprm", "actuator_biasprm"},
    }
    for name, leaves in expected.items():
        varied = randomization.varied_model(env._model, {name: domain[name]})
        for field in env._model.__dataclass_fields__:
            before, after = getattr(env._model, field), getattr(varied, field)
            if field not in leaves:
                assert after is before, field
                continue
            before, after, factor = np.asarray(before), np.asarray(after), 1.0 + np.asarray(domain[name])
            assert before.shape == after.shape
            scaled = before.T * factor.T if factor.ndim else before * factor
            np.testing.assert_allclose(after, scaled.T if factor.ndim else scaled, rtol=1e-6)
    np.testing.assert_allclose(
        randomization.varied_action(jnp.ones(env.action_size), domain), 1.0 + np.asarray(domain["action_scale"])
    )


def test_mjx_steps_a_varied_model_as_mujoco_does() -> None:
    """The changed leaves exist in MuJoCo's own model: with the same values, C MuJoCo moves in the same way."""
    end = jax.tree.map(lambda leaf: np.asarray(leaf[0], np.float64), episodes(ALL)[1])
    start = episodes(ALL)[0]
    model = mujoco.MjModel.from_xml_string(point_mass.XML)
    domain = {name: np.asarray(values) for name, values in end.domain.items()}
    model.body_mass *= 1 + domain["mass"]
    model.body_inertia *= 1 + domain["mass"][:, None]
    model.dof_damping *= 1 + domain["damping"]
    model.actuator_gainprm[:, 0] *= 1 + domain["actuator_gain"]
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    data.qpos[:] = np.asarray(start.data.qpos[0])
    data.ctrl[:] = 1 + domain["action_scale"]
    for _ in range(STEPS):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(end.data.qvel, data.qvel, rtol=1e-4)


def test_the_gpu_kernel_draws_varied_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel, interpreted, renders the same as the plain path if the scene's leaves differ between environments."""
    scene, _ = draw_shape()
    start = episodes(ALL)[0]
    assert kernel.supports(scene)

    def draw(data: Any, domain: Any) -> jax.Array:
        planes = render_planes(randomization.varied_scene(scene, domain), data)
        return jnp.concatenate([planes.rgb, planes.depth[None]])

    plain = np.asarray(jaxrl_vis_envs.jit(jax.vmap(draw))(start.data, start.domain))
    monkeypatch.setattr(kernel, "can_render", lambda scene, outputs: kernel.supports(scene))
    monkeypatch.setattr(kernel, "draw", functools.partial(kernel.draw, interpret=True))
    by_kernel = np.asarray(jax.vmap(draw)(start.data, start.domain))
    assert (np.abs(plain - by_kernel).max(axis=1) < 1e-3).mean() > 0.98  # but for pixels on an edge
    assert len({image.tobytes() for image in by_kernel}) == COUNT


def test_typical_ranges_and_bad_ones() -> None:
    assert typical() == OFF and not OFF.active
    assert typical("dynamics", strength=0.5).mass == 0.5 * KINDS["dynamics"]["mass"]
    assert set(KINDS) == set(get_args(groups.Randomized))
    assert {name for kind in KINDS.values() for name in kind} == set(Randomization.__dataclass_fields__)
    for bad in (lambda: Randomization(mass=-0.1), lambda: Randomization(colour=float("nan")), lambda: Randomization(mass=1.0)):
        with pytest.raises(ValueError, match="of the randomization"):
            bad()
    with pytest.raises(ValueError, match="camera, lights"):
        typical("weather")
    for value in ("wide", None, (0.1, 0.2), True):
        with pytest.raises(ValueError, match="colour of the randomization must be .* got"):
            Randomization(colour=value)
    with pytest.raises(ValueError, match="no randomization of .*camera, lights"):
        typical(["camera"])  # type: ignore[arg-type]
    for strength in ("half", None, -1.0, float("nan")):
        with pytest.raises(ValueError, match="the strength of a randomization must be"):
            typical("camera", strength=strength)
    with pytest.raises(ValueError, match="draws images"):
        jaxrl_vis_envs.make("Reacher", randomization=LOOKS)


def test_every_image_task_takes_every_kind() -> None:
    for task in TASKS:
        env = jaxrl_vis_envs.make(f"Visual{task}", image_size=8, randomization=ALL)
        domain = jax.eval_shape(
            lambda key, env=env: randomization.sample(key, env.config.randomization, env._model, env.action_size, env._scene),
            jax.random.key(0),
        )
        assert set(domain) == set(ALL.active)
        scene = jax.eval_shape(lambda domain, env=env: randomization.varied_scene(env._scene, domain), domain)
        same = jax.tree.map(lambda one, other: (one.shape, one.dtype) == (other.shape, other.dtype), scene, env._scene)
        assert all(jax.tree.leaves(same))
        assert isinstance(env._observer, pixels.ImageObserver)


def test_training_command_randomizes() -> None:
    """The settings of `jaxrl-vis train --randomize camera dynamics --randomize-strength 2` reach the environment."""
    settings = {"randomize": ("camera", "dynamics"), "randomize_strength": 2.0}
    env = make_env(preset("debug", env="VisualReacher", **settings))
    assert env.config.randomization == typical("camera", "dynamics", strength=2.0)
    assert make_env(preset("debug", env="VisualReacher")).config.randomization == OFF
    for wrong, words in (
        ({"randomize": ("camra",)}, "did you mean camera"),
        ({"randomize": ("dynamics",), "randomize_strength": 10.0}, "mass"),
        ({"randomize_strength": 0.0}, "randomize_strength"),
        ({"env": "Reacher", "randomize": ("colours",)}, "draws images"),
        ({"env": "Reacher", "frame_stack": 2}, "frame_stack"),
        ({"frame_stack": 0}, "frame_stack"),
    ):
        with pytest.raises(RequestError, match=words):
            make_env(preset("debug", **({"env": "VisualReacher"} | wrong)))


def test_a_learner_trains_in_environments_that_vary() -> None:
    """Every episode starts at the same place with a different appearance; learning continues, reproducibly bit for bit."""
    settings = {"num_envs": 4, "replay_transitions": 40, "updates_per_iteration": 2, "batch_size": 16, "eval_episodes": 2}
    # Other tests see that colours vary; depth takes half as long to compile, and varies with the camera.
    program = make_train_step(make(ALL, point_mass.SimulatedPointMass, pixels="depth"), preset("debug", **settings))

    def train() -> tuple[Any, list[Any]]:
        loop, rows = program.init(keys()[:1]), []
        for _ in range(2):
            loop, metrics = train_iteration(program, loop)
            rows.append(jax.device_get(metrics))
        return loop, rows

    (loop, rows), (_, again) = train(), train()
    starts = np.asarray(loop.replay.episodes.observations[0, :, 0])
    np.testing.assert_array_equal(loop.replay.episodes.states[0, :, 0], 0.0)
    assert len({start.tobytes() for start in starts}) == len(starts) == 8
    assert all(np.isfinite(value).all() and row["guard/nonfinite"] == 0 for row in rows for value in row.values())
    assert int(loop.train.agent.updates[0]) == 4
    assert jax.tree.all(jax.tree.map(np.array_equal, rows, again))
    outcome, recording = program.evaluate(loop.train, jax.random.key(1))
    assert np.isfinite(outcome["eval/goal_distance"]).all()
    assert len({frames[0].tobytes() for frames in np.asarray(recording["frames"][0])}) == settings["eval_episodes"]
