"""Contract of every registered environment, and properties of each task."""

import functools
import os
import pathlib
import subprocess
import sys
import textwrap
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_mass import PointMass, PointMassConfig

import jaxrl_vis_envs
from benchmarks.tasks import environments
from jaxrl_vis_envs import goals, names, pixels, registry
from jaxrl_vis_envs.base import GoalEnv, State, sanitize_action
from jaxrl_vis_envs.compiling import compilation
from jaxrl_vis_envs.tasks.config import TaskConfig

BATCH, STEPS = 32, 8
SOURCES = pathlib.Path(__file__).resolve().parents[2] / "envs"
SUBPROCESS_ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join((str(SOURCES), str(SOURCES.parent)))}
TASKS = list(names.TASKS)
HORIZONS = {task: 25 if task == "SawyerReach" else 50 for task in TASKS}


EACH_TASK = pytest.mark.parametrize("name", TASKS)


@functools.cache
def make_visual(task: str) -> GoalEnv:
    return jaxrl_vis_envs.make(f"Visual{task}", image_size=32)


class Episode(NamedTuple):
    """BATCH episodes of random actions: their STEPS + 1 states, and the configurations of their goals."""

    states: list[State]
    goals: Any


@functools.cache
def episode(name: str) -> Episode:
    state, goals = environments.reset(environments.make(name), jax.random.split(jax.random.key(0), BATCH))
    actions = jax.random.uniform(jax.random.key(1), (STEPS, BATCH, environments.make(name).action_size), minval=-1.0)
    return Episode(play(name, state, actions), goals)


def play(name: str, state: State, actions: Any) -> list[State]:
    states = [state]
    for action in actions:
        states.append(environments.advance(environments.make(name), states[-1], action))
    return states


@functools.cache
def images(task: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return images [BATCH, C, H, W] of the goals, of the starts and of the last states."""
    env, played = make_visual(task), episode(task)
    nowhere = jnp.zeros(played.states[0].goal_state.shape[1])
    observe = jaxrl_vis_envs.jit(jax.vmap(lambda data: env.observe(env.state_at(data, nowhere))))
    goal, start, end = (np.asarray(observe(data)) for data in (played.goals, played.states[0].data, played.states[-1].data))
    return goal, start, end


# Run in a process that has used JAX before it meets this package, as a notebook does.
_LATE_START = """
    import time
    import jax
    jax.jit(lambda x: x + 1)(1).block_until_ready()
    from benchmarks.tasks import environments
    env = environments.make("FetchReach")
    state, _ = environments.reset(env, jax.random.split(jax.random.key(0), 16))
    idle = jax.numpy.zeros((16, env.action_size))
    advance = environments._advance_program(env)
    state = advance(jax.device_put(state.replace(obs=None)), idle)
    begin = time.time()
    for _ in range(3):
        state = advance(state, idle)
    state.reward.block_until_ready()
    assert advance._cache_size() == 1, "the second step compiled again: something is weakly typed"
    print((time.time() - begin) / 3)
"""


def test_every_environment_is_tested():
    assert jaxrl_vis_envs.list_envs() == sorted([*TASKS, *(f"Visual{task}" for task in TASKS)])


@EACH_TASK
def test_reset_and_advance(name: str) -> None:
    env, (states, goal_data) = environments.make(name), episode(name)
    assert env.name == name and env.horizon == HORIZONS[name] and env.control_period > 0
    start = states[0]
    assert start.obs is not None and set(start.obs) == {"observation", "achieved_goal", "desired_goal"}
    for vector in start.obs.values():
        assert (
            vector.shape == (BATCH, *env.observation_spec.shape) and vector.dtype == env.observation_spec.dtype == jnp.float32
        )
    np.testing.assert_array_equal(start.obs["achieved_goal"], jax.vmap(env.as_goal)(start.obs["observation"]))
    np.testing.assert_array_equal(start.obs["desired_goal"], jax.vmap(env.observe_state)(goal_data))
    for state in states:
        assert state.goal_state.shape == state.achieved_state.shape == (BATCH, env.goal_state_size)
        assert not np.asarray(state.done).any()
        for leaf in jax.tree.leaves(state):
            assert np.isfinite(np.asarray(leaf, np.float64)).all()
    # The goal stays, the robot moves.
    np.testing.assert_array_equal(states[-1].goal_state, start.goal_state)
    assert (np.abs(states[-1].data.qpos - start.data.qpos).max(axis=-1) > 1e-3).all()


@EACH_TASK
def test_reward_and_success_follow_from_the_true_states(name: str) -> None:
    env = environments.make(name)
    for state in episode(name).states:
        reward = goals.oracle_reward(state.achieved_state, state.goal_state, env.threshold)
        np.testing.assert_array_equal(reward, state.reward)
        distance = np.linalg.norm(np.asarray(state.achieved_state) - np.asarray(state.goal_state), axis=-1)
        np.testing.assert_allclose(state.metrics["goal_distance"], distance, atol=1e-6)
        clear = np.abs(distance - env.threshold) > 1e-6
        np.testing.assert_array_equal(np.asarray(state.metrics["success"])[clear], (distance <= env.threshold)[clear])


@EACH_TASK
def test_bad_actions_do_not_poison_the_physics(name: str) -> None:
    first = jax.tree.map(lambda leaf: np.repeat(leaf[:1], BATCH, axis=0), jax.device_get(episode(name).states[0]))
    actions = np.zeros((STEPS, BATCH, environments.make(name).action_size), np.float32)
    actions[:, :5] = np.array([np.nan, np.inf, -1e30, 1.0, -1.0])[:, None]
    states = np.stack([state.achieved_state for state in play(name, first, actions)])
    assert np.isfinite(states).all()
    # Rows 0 and 5 (NaN, 0), 1 and 3 (inf, 1), 2 and 4 start from the same state.
    for bad, good in ((0, 5), (1, 3), (2, 4)):
        np.testing.assert_array_equal(states[:, bad], states[:, good])


@EACH_TASK
def test_images_show_goals_and_movement(name: str) -> None:
    spec = make_visual(name).observation_spec
    goal, start, end = images(name)
    for image in (goal, start, end):
        assert image.shape == (BATCH, *spec.shape) and image.dtype == spec.dtype == jnp.uint8
    assert (goal != start).any(axis=(1, 2, 3)).mean() > 0.95
    assert (end != start).any(axis=(1, 2, 3)).mean() > 0.95


@functools.cache
def seen_episodes(frame_stack: int = 1) -> tuple[GoalEnv, State, State]:
    """Return a visual task and four episodes, run as one program: their starts, and their states [STEPS, 4] after actions."""
    env = PointMass(PointMassConfig(image_size=16, frame_stack=frame_stack))
    actions = jax.random.uniform(jax.random.key(1), (STEPS, 4, 2), minval=-1.0)
    actions = actions.at[:3, 0].set(jnp.array([[1.0], [-0.5], [0.8]]))  # so that no two of the first images are alike

    def play(keys: jax.Array, actions: jax.Array) -> tuple[State, State]:
        def step(state: State, action: jax.Array) -> tuple[State, State]:
            state = jax.vmap(env.step)(state, action)
            return state, state

        start = jax.vmap(env.reset)(keys)
        return start, jax.lax.scan(step, start, actions)[1]

    return env, *jax.device_get(jaxrl_vis_envs.jit(play)(jax.random.split(jax.random.key(0), 4), actions))


def test_a_visual_task_resets_and_steps_as_its_parts_say() -> None:
    """`reset` and `step` equal the combination of their parts."""
    env, start, steps = seen_episodes()
    keys = jax.random.split(jax.random.key(0), 4)
    assert start.obs is not None and steps.obs is not None
    nowhere = jnp.zeros(2)
    observe = jaxrl_vis_envs.jit(jax.vmap(lambda data: env.observe(env.state_at(data, nowhere))))
    np.testing.assert_array_equal(start.obs["desired_goal"], observe(jaxrl_vis_envs.jit(jax.vmap(env.sample_goal))(keys)))
    np.testing.assert_array_equal(start.obs["observation"], observe(start.data))
    for index in range(STEPS):
        seen = observe(jax.tree.map(lambda leaf, index=index: leaf[index], steps.data))
        np.testing.assert_array_equal(steps.obs["observation"][index], seen)
        np.testing.assert_array_equal(steps.obs["achieved_goal"][index], seen)
        np.testing.assert_array_equal(steps.obs["desired_goal"][index], start.obs["desired_goal"])
    assert (np.abs(np.diff(steps.data.qpos, axis=0)).max(axis=-1) > 1e-4).all()


@EACH_TASK
@pytest.mark.parametrize("wrong", [(1,), (2, 3), ()])
def test_an_action_of_another_shape_is_refused(name: str, wrong: tuple[int, ...]) -> None:
    env = environments.make(name)
    state = jax.tree.map(lambda leaf: leaf[0], episode(name).states[0])
    for move in (env.advance, env.step):
        with pytest.raises(ValueError, match=rf"{name} takes an action of shape \({env.action_size},\), got"):
            move(state, jnp.zeros(wrong))


@EACH_TASK
def test_tasks_refuse_64_bit_jax(name: str) -> None:
    with jax.enable_x64(True), pytest.raises(ValueError, match=f"{name} simulates in 32 bits.*unset JAX_ENABLE_X64"):
        jaxrl_vis_envs.make(name)


@pytest.mark.parametrize("shape", [(), (3,), (5, 2)])
def test_batched_or_non_typed_keys_are_refused(shape: tuple[int, ...]) -> None:
    env = jaxrl_vis_envs.make("Reacher")
    with pytest.raises(ValueError, match="reset takes one JAX key, not an array of shape") as refused:
        env.reset(np.zeros(shape, np.uint32))
    assert "\n" not in str(refused.value)
    env.check_key(np.zeros(2, np.uint32))


def test_an_environment_without_a_registered_name_refuses_such_actions_too():
    env = PointMass(PointMassConfig())
    with pytest.raises(ValueError, match=r"PointMass takes an action of shape \(2,\), got \(1,\)"):
        jax.eval_shape(lambda key: env.step(env.reset(key), jnp.zeros(1)), jax.random.key(0))


def test_sanitize_action():
    action = sanitize_action(jnp.array([jnp.nan, jnp.inf, -jnp.inf, 0.5]))
    np.testing.assert_array_equal(action, [0.0, 1.0, -1.0, 0.5])


def test_images_stack_newest_first():
    """Stacked images consist of those of an environment with single images, from the same key and under the same actions."""
    (env, *states), (_, *states_1) = seen_episodes(3), seen_episodes()
    (start, steps), (start_1, steps_1) = ([state.obs for state in each] for each in (states, states_1))
    assert start is not None and steps is not None and start_1 is not None and steps_1 is not None
    one = [start_1["observation"][0], *steps_1["observation"][:3, 0]]
    assert len({np.asarray(image).tobytes() for image in one}) == 4
    assert env.frame_stack == 3 and env.observation_spec.shape == (12, 16, 16)
    np.testing.assert_array_equal(start["observation"][0], np.concatenate([one[0], one[0], one[0]]))
    np.testing.assert_array_equal(steps["observation"][0, 0], np.concatenate([one[1], one[0], one[0]]))
    np.testing.assert_array_equal(steps["observation"][2, 0], np.concatenate([one[3], one[2], one[1]]))
    # A goal stands still: the desired one, and what was achieved on the way.
    np.testing.assert_array_equal(start["desired_goal"][0], np.tile(start_1["desired_goal"][0], (3, 1, 1)))
    np.testing.assert_array_equal(steps["achieved_goal"][2, 0], np.tile(one[3], (3, 1, 1)))
    np.testing.assert_array_equal(env.as_goal(steps["observation"][2, 0]), steps["achieved_goal"][2, 0])


@pytest.mark.parametrize("name", ["FetchReach", "Reacher"])
def test_a_goal_vector_is_at_rest_at_the_goal(name: str) -> None:
    start = episode(name).states[0]
    position = slice(0, 3) if name == "FetchReach" else slice(4, 6)
    velocity = slice(3, 6) if name == "FetchReach" else slice(6, 8)
    np.testing.assert_array_equal(start.obs["desired_goal"][:, position], start.goal_state)
    np.testing.assert_array_equal(start.obs["desired_goal"][:, velocity], 0.0)


def test_fetch_reach_start_and_goals():
    env, start = environments.make("FetchReach"), episode("FetchReach").states[0]
    np.testing.assert_allclose(start.achieved_state, np.tile([1.3418, 0.7491, 0.5347], (BATCH, 1)), atol=2e-3)
    assert abs(float(start.metrics["goal_distance"].mean()) - 0.14) < 0.02
    offset = np.asarray(start.goal_state - start.achieved_state)
    assert (np.abs(offset) < env.config.goal_range + 0.02).all()
    assert (np.abs(offset.mean(axis=0)) < 0.04).all() and (np.abs(offset).max(axis=0) > 0.12).all()
    # The table keeps the fingers, and so the imaged goal, above its top.
    assert np.asarray(start.goal_state)[:, 2].min() > 0.4


def test_reacher_start_and_goals():
    start = episode("Reacher").states[0]
    assert (np.abs(start.data.qpos) <= 0.1).all()
    assert abs(float(start.metrics["goal_distance"].mean()) - 0.24) < 0.04
    assert (np.linalg.norm(start.goal_state, axis=-1) <= 0.2101).all()


def test_a_unit_of_reacher_action_turns_a_joint_by_nearly_a_radian():
    start = episode("Reacher").states[0]
    moved = environments.advance(environments.make("Reacher"), start, np.tile([1.0, 0.0], (BATCH, 1)))
    np.testing.assert_allclose(moved.data.qpos[:, 0] - start.data.qpos[:, 0], 0.95, atol=0.01)


def test_depth_bytes_are_metric():
    depth = jnp.array([0.0, 0.4, 1.1, 1.8, 5.0])
    encoded = pixels.encode_depth(depth, (0.4, 1.8))
    np.testing.assert_array_equal(encoded, [0, 0, 128, 255, 255])
    np.testing.assert_allclose(pixels.decode_depth(encoded, (0.4, 1.8))[1:4], depth[1:4], atol=0.7 / 255)


@pytest.mark.parametrize(("channels", "count"), [("rgbd", 4), ("rgb", 3), ("depth", 1)])
def test_channels(channels, count):
    env = jaxrl_vis_envs.make("VisualReacher", image_size=24, pixels=channels)
    assert env.observation_spec == jax.ShapeDtypeStruct((count, 24, 24), jnp.uint8)


def test_names_that_do_not_exist():
    with pytest.raises(jaxrl_vis_envs.UnknownEnvironmentError, match="VisualFetchReach"):
        jaxrl_vis_envs.make("VisualFetchReech")
    with pytest.raises(jaxrl_vis_envs.UnknownOverrideError, match="image_size"):
        jaxrl_vis_envs.make("VisualFetchReach", image_sise=32)
    with pytest.raises(jaxrl_vis_envs.UnknownOverrideError, match="no option 'image_size'"):
        jaxrl_vis_envs.make("FetchReach", image_size=32)


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        *((name, {field: value}) for name in TASKS for field in ("horizon", "threshold") for value in (0, -1, "2", np.nan)),
        *((name, {"randomization": "camera"}) for name in TASKS),
        *((name, {"substeps": value}) for name in TASKS for value in (0, 4.5, True)),
        *(("VisualReacher", {"pixels": value}) for value in ("hsv", 3)),
        *(("VisualReacher", {field: value}) for field in ("image_size", "frame_stack") for value in (0, 4.5, "64", True)),
        *(
            ("VisualFetchReach", {field: value})
            for field in ("depth_range", "clip_range")
            for value in ((2.0, 1.0), (1.0,), (0.5, np.inf), 3.0, ("a", "b"))
        ),
        ("VisualFetchReach", {"clip_range": (0.0, 1.0)}),
        ("VisualFetchReach", {"depth_encoding": "log"}),
        ("VisualFetchReach", {"cross_hair": "yes"}),
        ("VisualFetchReach", {"finger_colour": "pink"}),
        ("VisualHandReach", {"view": "side"}),
        ("VisualHandReach", {"tip_marks": "blinking"}),
        ("FetchReach", {"goal_at": "nose"}),
        ("FetchReach", {"substeps": 1}),
        ("FetchReach", {"goal_range": -0.1}),
        ("FetchReach", {"action_scale": 0.0}),
        ("FetchReach", {"solver_iterations": 0}),
        ("FingerTurn", {"line_search_iterations": 0}),
        ("HandReach", {"goal_rule": "wave"}),
        ("HandReach", {"goal_actions": 0}),
        ("HandReach", {"goal_noise": np.nan}),
        ("HandReach", {"contacts": "no"}),
        ("Reacher", {"control": "telepathy"}),
        ("Reacher", {"start_range": -0.1}),
        ("Reacher", {"velocity_scale": np.inf}),
        ("SawyerReach", {"goal_size": (1.0, 0.0, 1.0)}),
        ("SawyerReach", {"goal_centre": (1.0, 0.0)}),
        ("SawyerReach", {"workspace_margin": -0.01}),
    ],
)
def test_settings_out_of_range(name: str, bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"^{next(iter(bad))} must be .*got"):
        jaxrl_vis_envs.make(name, **bad)


def test_register(monkeypatch):
    monkeypatch.setattr(registry, "_ENTRIES", dict(registry._ENTRIES))  # undone after the test
    config_class = registry.config_class("Reacher")
    registry.register("Mine", lambda config: environments.make("Reacher"), config_class)
    assert "Mine" in jaxrl_vis_envs.list_envs()
    with pytest.raises(ValueError, match="exists already"):
        registry.register("Mine", lambda config: environments.make("FetchReach"), config_class)
    with pytest.raises(ValueError, match="dataclass"):
        registry.register("Other", lambda config: environments.make("Reacher"), dict)
    with pytest.raises(ValueError, match="dataclass"):
        registry.register("Other", lambda config: environments.make("Reacher"), config_class())
    for word in (3, "", "my_task:Other"):
        with pytest.raises(ValueError, match="a word without a colon"):
            registry.register(word, lambda config: environments.make("Reacher"), config_class)
    with pytest.raises(ValueError, match="factory of 'Other'"):
        registry.register("Other", None, config_class)
    with pytest.raises(ValueError, match="TaskConfig.horizon of 'Other' needs a default"):
        registry.register("Other", lambda config: environments.make("Reacher"), TaskConfig)
    registry.register("Nothing", lambda config: None, config_class)
    with pytest.raises(ValueError, match="Nothing is not an environment but None: its factory"):
        jaxrl_vis_envs.make("Nothing")


def test_observation_kind_is_known_before_building(monkeypatch):
    for task in TASKS:
        assert registry.has_images(f"Visual{task}") and not registry.has_images(task)
        assert registry.state_variant(f"Visual{task}") == registry.state_variant(task) == task
    monkeypatch.setattr(registry, "_ENTRIES", dict(registry._ENTRIES))
    registry.register("Ball", PointMass, PointMassConfig)  # images, whatever its name
    assert registry.has_images("Ball") and registry.state_variant("Ball") is None
    with pytest.raises(jaxrl_vis_envs.UnknownEnvironmentError):
        registry.has_images("Bowl")


def test_numpy_is_rewarded_by_numpy():
    """Rewards of NumPy arrays are NumPy arrays, so that learners on the host need neither transfer nor compilation."""
    images = np.zeros((2, 3, 4, 4), np.uint8)
    other = images.copy()
    other[1, 0, 0, 0] = 1
    states = np.zeros((2, 3), np.float32)
    for reward in (
        goals.indicator_reward(images, other),
        goals.oracle_reward(states, states, 0.1),
        goals.success(states, states, 0.1),
    ):
        assert isinstance(reward, np.ndarray) and reward.dtype == np.float32
    np.testing.assert_array_equal(goals.indicator_reward(images, other), [1.0, -1.0])
    on_device = goals.indicator_reward(jnp.asarray(images), jnp.asarray(other))
    assert isinstance(on_device, jax.Array)
    np.testing.assert_array_equal(on_device, [1.0, -1.0])


def test_the_distance_to_the_goal_has_a_gradient_everywhere():
    slope = jax.vmap(jax.grad(goals.goal_distance), (0, None))
    places = jnp.array([[0.0, 0.0], [3.0, 4.0], [jnp.nan, 0.0]])
    np.testing.assert_allclose(slope(places, jnp.zeros(2))[:2], [[0.0, 0.0], [0.6, 0.8]], rtol=1e-6)
    distances = goals.goal_distance(places, jnp.zeros(2))
    assert distances.dtype == jnp.float32
    np.testing.assert_array_equal(distances, [0.0, 5.0, np.nan])


def test_goals_need_no_mujoco():
    code = "import sys, jaxrl_vis_envs, jaxrl_vis_envs.goals; sys.exit('mujoco' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, env=SUBPROCESS_ENVIRONMENT).returncode == 0


def test_jit_switches_off_what_slows_physics_on_a_cpu_where_jax_can(monkeypatch):
    options = {}
    monkeypatch.setattr(jax, "jit", lambda function, **given: options.update(given))
    compilation.jit(lambda: None, donate_argnums=0)
    assert options["donate_argnums"] == 0
    expected = {"xla_cpu_experimental_ynn_fusion_type": ""}
    if jax.__version_info__ < (0, 11):
        expected["xla_cpu_use_fusion_emitters"] = False
    assert options["compiler_options"] == (expected if jax.default_backend() == "cpu" else {})
    on_gpu = compilation.compiler_options("gpu")
    assert on_gpu["xla_gpu_command_buffer_scheduling_mode"] == "CONCURRENT"
    assert compilation.compiler_options("gpu", runs_once=True) == on_gpu
    assert compilation.compiler_options("cpu", runs_once=True) == {**expected, "xla_backend_optimization_level": 0}


def test_compiling_fetch_reach_after_jax_has_started():
    program = [sys.executable, "-c", textwrap.dedent(_LATE_START)]
    finished = subprocess.run(program, capture_output=True, text=True, check=False, env=SUBPROCESS_ENVIRONMENT)
    assert finished.returncode == 0, finished.stderr
    # With fusion emitters this takes seconds; without, milliseconds.
    assert float(finished.stdout.splitlines()[-1]) < 1.0
