"""The contract that every registered world keeps, and what is particular to each task."""

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

import jaxrl_vis_envs
from jaxrl_vis_envs import compilation, goals, pixels, registry
from jaxrl_vis_envs.base import GoalEnv, sanitize_action

BATCH, STEPS = 64, 8
SOURCES = pathlib.Path(__file__).resolve().parents[1] / "envs"
SUBPROCESS_ENVIRONMENT = {**os.environ, "PYTHONPATH": str(SOURCES)}
TASKS = ["FetchReach", "FingerTurn", "HandReach", "Reacher", "SawyerReach"]
VISUAL_TASKS = [f"Visual{task}" for task in TASKS]
NAMES = sorted(TASKS + VISUAL_TASKS)
HORIZONS = {"FetchReach": 50, "FingerTurn": 50, "HandReach": 50, "Reacher": 50, "SawyerReach": 25}


class Episode(NamedTuple):
    """Start of BATCH episodes, and their first STEPS steps ([STEPS, BATCH, ...]). Physics data is left out, but for qpos."""

    start: Any
    steps: Any
    start_qpos: jax.Array
    steps_qpos: jax.Array


@functools.cache
def make(name: str) -> GoalEnv:
    return jaxrl_vis_envs.make(name, **({"image_size": 16} if name.startswith("Visual") else {}))


@functools.cache
def player(name: str) -> Any:
    """play(keys [BATCH], actions [STEPS, BATCH, A], gain) -> Episode; one compilation serves all tests of a world.

    A proportional controller with ``gain`` (1/m) is added to the first components of ``actions``.
    """
    env = make(name)

    def play(keys: jax.Array, actions: jax.Array, gain: jax.Array) -> Episode:
        start = jax.vmap(env.reset)(keys)

        def step(state: Any, action: jax.Array) -> tuple[Any, Any]:
            steering = jnp.zeros_like(action).at[:, : env.goal_state_size].set(state.goal_state - state.achieved_state)
            state = jax.vmap(env.step)(state, action + gain * steering)
            return state, (state.replace(data=None), state.data.qpos)

        _, (steps, qpos) = jax.lax.scan(step, start, actions)
        return Episode(start.replace(data=None), steps, start.data.qpos, qpos)

    return compilation.world_jit(play)


@functools.cache
def episode(name: str) -> Episode:
    """Episodes of random actions."""
    actions = jax.random.uniform(jax.random.key(1), (STEPS, BATCH, make(name).action_size), minval=-1.0)
    return player(name)(jax.random.split(jax.random.key(0), BATCH), actions, 0.0)


# Run in a process that has used JAX before it meets this package, as a notebook does. Started first, so that it compiles
# beside the other tests.
_LATE_START = """
    import time
    import jax
    jax.jit(lambda x: x + 1)(1).block_until_ready()
    import jaxrl_vis_envs
    from jaxrl_vis_envs.compilation import world_jit
    env = jaxrl_vis_envs.make("FetchReach")
    state = world_jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 8))
    step = world_jit(jax.vmap(env.step))
    state = step(state, jax.numpy.zeros((8, env.action_size)))
    assert step._cache_size() == 1
    begin = time.time()
    for _ in range(3):
        state = step(state, jax.numpy.zeros((8, env.action_size)))
    state.reward.block_until_ready()
    assert step._cache_size() == 1, "the second step compiled again: something is weakly typed"
    print((time.time() - begin) / 3)
"""


@pytest.fixture(scope="module", autouse=True)
def late_start():
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(_LATE_START)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=SUBPROCESS_ENVIRONMENT,
    )
    yield process
    process.kill()
    process.wait()


def test_every_world_is_tested():
    assert jaxrl_vis_envs.list_envs() == sorted(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_reset_and_step(name):
    env, played = make(name), episode(name)
    spec = env.observation_spec
    for obs, axes in ((played.start.obs, (BATCH,)), (played.steps.obs, (STEPS, BATCH))):
        assert set(obs) == {"observation", "achieved_goal", "desired_goal"}
        for picture in obs.values():
            assert picture.shape == (*axes, *spec.shape) and picture.dtype == spec.dtype
    assert spec.dtype == (jnp.uint8 if name.startswith("Visual") else jnp.float32)
    assert played.steps.goal_state.shape == (STEPS, BATCH, env.goal_state_size)
    for leaf in jax.tree.leaves(played):
        assert np.isfinite(np.asarray(leaf, np.float64)).all()
    assert not np.asarray(played.steps.done).any() and not np.asarray(played.start.done).any()
    # The goal and its picture stay, the world moves.
    np.testing.assert_array_equal(played.steps.obs["desired_goal"][-1], played.start.obs["desired_goal"])
    np.testing.assert_array_equal(played.steps.goal_state[-1], played.start.goal_state)
    assert (np.abs(played.steps_qpos[-1] - played.start_qpos).max(axis=-1) > 1e-3).all()
    assert env.name == name and env.horizon == HORIZONS[name.removeprefix("Visual")] and env.control_period > 0


@pytest.mark.parametrize("name", NAMES)
def test_reward_and_success_follow_from_the_true_states(name):
    env, played = make(name), episode(name)
    for state in (played.start, played.steps):
        reward = goals.oracle_reward(state.achieved_state, state.goal_state, env.threshold)
        np.testing.assert_array_equal(reward, state.reward)
        distance = np.linalg.norm(np.asarray(state.achieved_state) - np.asarray(state.goal_state), axis=-1)
        np.testing.assert_allclose(state.metrics["goal_distance"], distance, atol=1e-6)
        clear = np.abs(distance - env.threshold) > 1e-6
        np.testing.assert_array_equal(np.asarray(state.metrics["success"])[clear], (distance <= env.threshold)[clear])


@pytest.mark.parametrize("name", NAMES)
def test_bad_actions_do_not_poison_the_physics(name):
    env = make(name)
    keys = jax.random.split(jax.random.key(0), BATCH)
    actions = jnp.zeros((STEPS, BATCH, env.action_size))
    actions = actions.at[:, 0].set(jnp.nan).at[:, 1].set(jnp.inf).at[:, 2].set(-1e30).at[:, 3].set(1.0).at[:, 4].set(-1.0)
    # Rows 0 and 5 (NaN, 0), 1 and 3 (inf, 1), 2 and 4 are played from the same key.
    keys = keys[jnp.zeros(BATCH, jnp.int32)]
    states = np.asarray(player(name)(keys, actions, 0.0).steps.achieved_state)
    assert np.isfinite(states).all()
    for bad, good in ((0, 5), (1, 3), (2, 4)):
        np.testing.assert_array_equal(states[:, bad], states[:, good])


def test_sanitize_action():
    action = sanitize_action(jnp.array([jnp.nan, jnp.inf, -jnp.inf, 0.5]))
    np.testing.assert_array_equal(action, [0.0, 1.0, -1.0, 0.5])


@pytest.mark.parametrize("name", VISUAL_TASKS)
def test_the_goal_picture_is_the_picture_of_the_goal(name):
    env, played = make(name), episode(name)
    keys = jax.random.split(jax.random.key(0), BATCH)

    def observe_goal(key: jax.Array) -> jax.Array:
        return env.observe(env.state_at(env.sample_goal(key), jnp.zeros(env.goal_state_size)))

    pictures = compilation.world_jit(jax.vmap(observe_goal))(keys)
    np.testing.assert_array_equal(pictures, played.start.obs["desired_goal"])
    differs = np.asarray(played.start.obs["desired_goal"] != played.start.obs["observation"]).any(axis=(1, 2, 3))
    assert differs.mean() > 0.95
    assert (np.asarray(played.steps.obs["observation"][-1] != played.start.obs["observation"])).any(
        axis=(1, 2, 3)
    ).mean() > 0.95


def test_pictures_stack_newest_first():
    """Against an environment that shows one picture, from the same key, under the same actions."""
    actions = jax.random.uniform(jax.random.key(1), (3, 1, 2), minval=-1.0)
    keys = jax.random.split(jax.random.key(0), 1)

    def pictures(**overrides: Any) -> tuple[GoalEnv, Any, Any]:
        env = jaxrl_vis_envs.make("VisualReacher", image_size=16, **overrides)

        def play(keys: jax.Array, actions: jax.Array) -> tuple[Any, Any]:
            start = jax.vmap(env.reset)(keys)

            def step(state: Any, action: jax.Array) -> tuple[Any, Any]:
                state = jax.vmap(env.step)(state, action)
                return state, state.obs

            return start.obs, jax.lax.scan(step, start, actions)[1]

        return env, *compilation.world_jit(play)(keys, actions)

    env, start, steps = pictures(frames=3)
    _, start_1, steps_1 = pictures()
    one = [start_1["observation"][0], *steps_1["observation"][:, 0]]
    assert env.frames == 3 and env.observation_spec.shape == (12, 16, 16)
    np.testing.assert_array_equal(start["observation"][0], np.concatenate([one[0], one[0], one[0]]))
    np.testing.assert_array_equal(steps["observation"][0, 0], np.concatenate([one[1], one[0], one[0]]))
    np.testing.assert_array_equal(steps["observation"][2, 0], np.concatenate([one[3], one[2], one[1]]))
    # A goal stands still: the desired one, and what was achieved on the way.
    np.testing.assert_array_equal(start["desired_goal"][0], np.tile(start_1["desired_goal"][0], (3, 1, 1)))
    np.testing.assert_array_equal(steps["achieved_goal"][2, 0], np.tile(one[3], (3, 1, 1)))
    np.testing.assert_array_equal(env.as_goal(steps["observation"][2, 0]), steps["achieved_goal"][2, 0])


@pytest.mark.parametrize("name", ["FetchReach", "Reacher"])
def test_a_goal_vector_is_at_rest_at_the_goal(name):
    start = episode(name).start
    position = slice(0, 3) if name == "FetchReach" else slice(4, 6)
    velocity = slice(3, 6) if name == "FetchReach" else slice(6, 8)
    np.testing.assert_array_equal(start.obs["desired_goal"][:, position], start.goal_state)
    np.testing.assert_array_equal(start.obs["desired_goal"][:, velocity], 0.0)


def test_fetch_reach_start_and_goals():
    env, start = make("FetchReach"), episode("FetchReach").start
    np.testing.assert_allclose(start.achieved_state, np.tile([1.3418, 0.7491, 0.5347], (BATCH, 1)), atol=2e-3)
    assert abs(float(start.metrics["goal_distance"].mean()) - 0.14) < 0.02
    offset = np.asarray(start.goal_state - start.achieved_state)
    assert (np.abs(offset) < env.config.goal_range + 0.02).all()
    assert (np.abs(offset.mean(axis=0)) < 0.04).all() and (np.abs(offset).max(axis=0) > 0.12).all()
    # The table keeps the fingers, and so the pictured goal, above its top.
    assert np.asarray(start.goal_state)[:, 2].min() > 0.4


def test_reacher_start_and_goals():
    played = episode("Reacher")
    assert (np.abs(played.start_qpos) <= 0.1).all()
    assert abs(float(played.start.metrics["goal_distance"].mean()) - 0.24) < 0.04
    assert (np.linalg.norm(played.start.goal_state, axis=-1) <= 0.2101).all()


def test_a_unit_of_reacher_action_turns_a_joint_by_nearly_a_radian():
    actions = jnp.zeros((STEPS, BATCH, 2)).at[0, :, 0].set(1.0)
    played = player("Reacher")(jax.random.split(jax.random.key(0), BATCH), actions, 0.0)
    np.testing.assert_allclose(played.steps_qpos[0, :, 0] - played.start_qpos[:, 0], 0.95, atol=0.01)


def test_a_proportional_controller_reaches_fetch_goals():
    actions = jnp.zeros((STEPS, BATCH, 4))
    played = player("FetchReach")(jax.random.split(jax.random.key(7), BATCH), actions, 20.0)
    assert float(played.steps.metrics["success"][-1].mean()) >= 0.95
    assert float(jnp.median(played.steps.metrics["goal_distance"][-1])) < 0.01


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
    for name, bad in (
        ("VisualReacher", {"pixels": "hsv"}),
        ("VisualReacher", {"image_size": 0}),
        ("VisualReacher", {"frames": 0}),
        ("FingerTurn", {"substeps": 0}),
        ("VisualFetchReach", {"depth_range": (2.0, 1.0)}),
        ("Reacher", {"control": "telepathy"}),
        ("FetchReach", {"substeps": 1}),
    ):
        with pytest.raises(ValueError, match=next(iter(bad))):
            jaxrl_vis_envs.make(name, **bad)


def test_register(monkeypatch):
    monkeypatch.setattr(registry, "_ENTRIES", dict(registry._ENTRIES))  # undone after the test
    config_class = registry.config_class("Reacher")
    registry.register("Mine", lambda config: make("Reacher"), config_class)
    assert "Mine" in jaxrl_vis_envs.list_envs()
    with pytest.raises(ValueError, match="exists already"):
        registry.register("Mine", lambda config: make("FetchReach"), config_class)
    with pytest.raises(ValueError, match="dataclass"):
        registry.register("Other", lambda config: make("Reacher"), dict)


def test_goals_need_no_mujoco():
    code = "import sys, jaxrl_vis_envs, jaxrl_vis_envs.goals; sys.exit('mujoco' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, env=SUBPROCESS_ENVIRONMENT).returncode == 0


def test_world_jit_switches_off_fusion_emitters_on_a_cpu_where_jax_can(monkeypatch):
    options = {}
    monkeypatch.setattr(jax, "jit", lambda function, **given: options.update(given))
    compilation.world_jit(lambda: None, donate_argnums=0)
    assert options["donate_argnums"] == 0
    takes_it = jax.default_backend() == "cpu" and jax.__version_info__ < (0, 11)
    expected = {"xla_cpu_use_fusion_emitters": False} if takes_it else {}
    assert options["compiler_options"] == expected
    assert compilation.compiler_options("gpu") == {}


def test_compiling_after_jax_has_started(late_start):
    output, errors = late_start.communicate(timeout=300)
    assert late_start.returncode == 0, errors
    # With fusion emitters this takes seconds; without, milliseconds.
    assert float(output.splitlines()[-1]) < 1.0
