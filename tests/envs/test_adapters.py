"""Adapters to other libraries' interfaces: each library's own checker, and common mistakes of adapters."""

import dataclasses
import functools
import importlib
import pickle
import re
import sys
import warnings
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import point_mass
import probe_environments as probes
import pytest
from brax.envs.wrappers import training
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as ppo
from brax.training.agents.sac import networks as sac_networks
from brax.training.agents.sac import train as sac
from gymnasium.utils.env_checker import check_env

from jaxrl_vis_envs import goals, registry
from jaxrl_vis_envs.adapters.brax import BraxEnv, share_jax_with_brax
from jaxrl_vis_envs.adapters.gymnasium import GymnasiumEnv, GymnasiumVectorEnv, register_all
from jaxrl_vis_envs.pixels import image_observer
from jaxrl_vis_envs.randomization import Randomization
from jaxrl_vis_envs.tasks import reacher

HORIZON = probes.Probe.horizon


class Wide(probes.PointImage):
    """Probe whose images differ in height, width and number of channels."""

    def see(self, position):
        return super().see(position)[:, :2].repeat(3, axis=0)


@functools.cache
def told() -> probes.Probe:
    return probes.GoWhereTold()


@functools.cache
def wide() -> probes.Probe:
    return Wide()


def actions_of(env: Any, steps: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, *env.action_space.shape)).astype(np.float32)


class ReacherWithoutPhysics(reacher.Reacher):
    """Reacher whose arm is rotated directly by the action: only the physics, which takes longest to compile, is replaced."""

    def act(self, data, action):
        return self.configuration(data.qpos + action)


def build_turned(config: Any) -> ReacherWithoutPhysics:
    return ReacherWithoutPhysics(config, lambda model: image_observer(model, "above", config))


@pytest.fixture
def registered(monkeypatch):
    """Undo registrations with `registry.register` and Gymnasium after a test."""
    monkeypatch.setattr(registry, "_ENTRIES", dict(registry._ENTRIES))
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    monkeypatch.setattr(gymnasium, "registry", gymnasium.envs.registration.registry)


def test_gymnasium_checks_an_environment_that_it_made_by_name(registered):
    registry.register("TurnedReacher", build_turned, registry.config_class("VisualReacher"))
    register_all()
    name, settings = "jaxrl_vis/TurnedReacher-v0", {"image_size": 16, "pixels": "depth", "render_size": 24}
    env = gymnasium.make(name, render_mode="rgb_array", **settings)
    with warnings.catch_warnings():
        # All that it may say: a position has no bounds.
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*observation space (minimum|maximum) value is -?infinity.*")
        check_env(env.unwrapped)
    observation, _ = env.reset(seed=3)
    assert {name: (value.shape, value.dtype.name) for name, value in observation.items()} == {
        "observation": ((8,), "float32"),
        "achieved_goal": ((2,), "float32"),
        "desired_goal": ((2,), "float32"),
        "pixels": ((16, 16, 1), "uint8"),
        "goal_pixels": ((16, 16, 1), "uint8"),
    }
    np.testing.assert_array_equal(observation["observation"][4:6], observation["achieved_goal"])
    image = env.render()
    assert image.shape == (24, 24, 3) and image.dtype == np.uint8 and np.ptp(image) > 50


def test_gymnasium_checks_state_and_image_probes():
    for env in (told(), wide()):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            check_env(GymnasiumEnv(env))


def test_reward_equals_compute_reward_of_the_observation():
    for reward in ("oracle", "dense"):
        env = GymnasiumEnv(told(), reward=reward)
        rewards, achieved, desired = [], [], []
        for seed in range(20):
            observation, _ = env.reset(seed=seed)
            step = env.step(observation["desired_goal"] + (0.05 if seed % 2 else 0.3))
            rewards.append(step[1])
            achieved.append(step[0]["achieved_goal"])
            desired.append(step[0]["desired_goal"])
            assert step[4]["is_success"] == bool(seed % 2)
        achieved, desired = np.array(achieved), np.array(desired)
        np.testing.assert_array_equal(env.compute_reward(achieved, desired, {}), np.float32(rewards))
        assert len(set(rewards)) > 1
        # Goals that a learner puts in later: any batch axes, and the same numbers as the function that computes rewards.
        others = np.roll(desired, 1, axis=0)
        relabelled = env.compute_reward(achieved.reshape(4, 5, 1), others.reshape(4, 5, 1), {})
        assert relabelled.shape == (4, 5) and relabelled.dtype == np.float32
        expected = -np.abs(achieved - others)[:, 0]
        if reward == "oracle":
            expected = goals.oracle_reward(jnp.asarray(achieved), jnp.asarray(others), told().threshold)
        np.testing.assert_allclose(relabelled.ravel(), expected, atol=1e-6)
        np.testing.assert_array_equal(env.compute_reward(achieved, achieved, {}), 0.0)
        assert not env.compute_terminated(achieved, desired, {}).any()


def test_episodes_end_in_truncation_at_the_horizon():
    env = GymnasiumEnv(told())
    env.reset(seed=0)
    for _ in range(2):
        ends = [env.step(env.action_space.sample())[2:4] for _ in range(HORIZON)]
        assert ends == [(False, False)] * (HORIZON - 1) + [(False, True)]
        env.reset()


def test_a_seed_determines_this_and_later_episodes():
    def goals_of(env: GymnasiumEnv, seed: int) -> list[float]:
        return [env.reset(seed=seed)[0]["desired_goal"][0], env.reset()[0]["desired_goal"][0]]

    env = GymnasiumEnv(told())
    first = goals_of(env, 5)
    assert first == goals_of(GymnasiumEnv(told()), 5) == goals_of(env, 5)
    assert len({*first, *goals_of(env, 6)}) == 4


def test_environments_can_be_pickled_during_an_episode(registered):
    registry.register("TurnedReacher", build_turned, registry.config_class("VisualReacher"))
    register_all()
    settings = {"image_size": 16, "pixels": "depth", "render_size": 24, "render_mode": "rgb_array"}
    single = gymnasium.make("jaxrl_vis/TurnedReacher-v0", **settings)
    several = GymnasiumVectorEnv(told(), num_envs=3, reward="dense")
    for env in (single, several):
        assert pickle.loads(pickle.dumps(env)).reset(seed=3)[0].keys() == env.reset(seed=3)[0].keys()
        actions = actions_of(env, 2)
        env.step(actions[0])
        copy = pickle.loads(pickle.dumps(env))
        jax.tree.map(np.testing.assert_array_equal, copy.step(actions[1]), env.step(actions[1]))
        jax.tree.map(np.testing.assert_array_equal, copy.reset(), env.reset())
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(single)).render(), single.render())


@pytest.mark.parametrize("reward", ["oracle", "dense"])
def test_brax_environments_can_be_pickled(reward):
    env = BraxEnv(told(), reward=reward)
    copy = pickle.loads(pickle.dumps(env))
    states = [each.step(each.reset(jax.random.key(2)), jnp.ones(1)) for each in (env, copy)]
    jax.tree.map(np.testing.assert_array_equal, *states)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_vector_environment_equals_separate_environments(mode):
    ours = GymnasiumVectorEnv(told(), 3, autoreset_mode=mode)
    theirs = gymnasium.vector.SyncVectorEnv([lambda: GymnasiumEnv(told())] * 3, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)

    def assert_same(a: Any, b: Any) -> None:
        if isinstance(a, dict):
            assert set(a) == set(b)
            for name in a:
                assert_same(a[name], b[name])
        elif isinstance(a, np.ndarray) and a.dtype == object:
            for x, y in zip(a, b, strict=True):
                assert_same(x, y)
        else:
            np.testing.assert_allclose(a, b, atol=1e-6)

    for x, y in zip(ours.reset(seed=11), theirs.reset(seed=11), strict=True):
        assert_same(x, y)
    truncated = []
    for actions in actions_of(ours, 2 * HORIZON + 3):
        step, expected = ours.step(actions), theirs.step(actions)
        for x, y in zip(step, expected, strict=True):
            assert_same(x, y)
        truncated.append(bool(step[3].all()))
    assert sum(truncated) == 2
    for x, y in zip(ours.reset(), theirs.reset(), strict=True):
        assert_same(x, y)
    for x, y in zip(ours.reset(seed=[4, None, 4]), theirs.reset(seed=[4, None, 4]), strict=True):
        assert_same(x, y)


def test_images_are_height_width_channels_and_goals_stay():
    env = GymnasiumVectorEnv(wide(), 2)
    first, _ = env.reset(seed=0)
    assert first["pixels"].shape == (2, 2, 4, 3)
    expected = np.broadcast_to(np.float32(first["achieved_goal"]).view(np.uint8)[:, None, :, None], (2, 2, 4, 3))
    np.testing.assert_array_equal(first["pixels"], expected)
    goal = first["goal_pixels"].copy()
    for values in first.values():
        values[:] = 0  # what was handed out belongs to the caller
    then, *_ = env.step(actions_of(env, 1)[0])
    np.testing.assert_array_equal(then["goal_pixels"], goal)
    assert then["pixels"].any() and (then["achieved_goal"] > 0.5).all()


def test_environments_with_the_same_settings_are_compiled_once(registered):
    traces = []

    class Counted(probes.GoWhereTold):
        def advance(self, state, action):
            traces.append(1)
            return super().advance(state, action)

    @dataclasses.dataclass(frozen=True)
    class Settings:
        size: tuple[int, ...] = (1,)

    registry.register("Counted", lambda config: Counted(), Settings)
    for size in ([1], (1,)):  # as JSON has it, and as we do
        env = GymnasiumEnv("Counted", size=size)
        env.reset(seed=0)
        env.step(np.zeros(1))
    assert len(traces) == 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GymnasiumEnv("Reachr"), "did you mean Reacher"),
        (lambda: GymnasiumEnv("Reacher", horizn=3), "did you mean horizon"),
        (lambda: GymnasiumEnv(told(), horizon=3), "horizon: options can be changed for a named environment"),
        (lambda: GymnasiumEnv(told(), reward="sparse"), "reward must be one of oracle, dense, got 'sparse'"),
        (lambda: GymnasiumEnv(told(), render_mode="human"), "rgb_array"),
        (lambda: GymnasiumEnv(told(), render_mode="rgb_array"), "no MuJoCo model"),
        (lambda: GymnasiumVectorEnv(told(), 0), "num_envs"),
        (lambda: GymnasiumVectorEnv(told(), "3"), "num_envs must be a whole number of at least 1, got '3'"),
        (lambda: GymnasiumVectorEnv(told(), 2.0), "num_envs must be a whole number of at least 1, got 2.0"),
        (lambda: GymnasiumVectorEnv(told(), 2).reset(seed=1.5), "one for each of 2 environments, got 1.5"),
        (lambda: GymnasiumEnv(None), "the name of an environment, or an existing GoalEnv, got a NoneType"),
        (lambda: GymnasiumEnv(probes.GoWhereTold), "got the class GoWhereTold"),
        (lambda: GymnasiumEnv("Reacher", horizon={}), "horizon must be a whole number of at least 1, got {}"),
        (lambda: GymnasiumEnv("VisualReacher", depth_range=np.ones(2)), "depth_range must be 2 finite numbers, got array"),
        (lambda: BraxEnv(None), "the name of an environment, or an existing GoalEnv, got a NoneType"),
        (lambda: GymnasiumVectorEnv(told(), 2, autoreset_mode="Disabled"), "NextStep or SameStep"),
        (lambda: GymnasiumVectorEnv(told(), 2).reset(seed=[1]), "each of 2"),
        (lambda: BraxEnv(told(), reward="sparse"), "oracle, dense"),
        (lambda: BraxEnv(told(), horizon=3), "horizon: options can be changed for a named environment"),
    ],
)
def test_bad_settings_are_refused_in_one_line(make, message):
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_rewards_check_state_sizes_and_are_float32():
    env = GymnasiumEnv(told(), reward="dense")
    rewards = env.compute_reward(np.zeros((3, 1)), np.array([[0], [1], [2]], np.uint8))
    assert rewards.dtype == np.float32
    np.testing.assert_array_equal(rewards, [0.0, -1.0, -2.0])
    assert env.compute_reward([0.0], [1]) == -1.0
    for states, desired in ((np.zeros((3, 2)), np.zeros((3, 1))), (np.zeros(1), 0.0)):
        with pytest.raises(ValueError, match=r"one state and one goal have the shape \(1,\), got") as refused:
            env.compute_reward(states, desired)
        assert "\n" not in str(refused.value)


def test_rendered_images_have_the_appearance_of_their_episode():
    varied = point_mass.PointMass(point_mass.PointMassConfig(randomization=Randomization(colour=0.5)))
    env = GymnasiumVectorEnv(varied, 2, render_mode="rgb_array", render_size=8)
    observations, _ = env.reset(seed=0)
    np.testing.assert_allclose(np.stack(env.render()), observations["pixels"][..., :3], atol=1)
    assert np.abs(np.subtract(*env.render(), dtype=int)).mean() > 10


def test_misuse_is_refused_in_one_line():
    env = GymnasiumEnv(told())
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(1))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=re.escape("must have the shape (1, 1), got (1, 2)")):
        env.step(np.zeros(2))


@pytest.mark.parametrize(
    ("adapter", "library", "hint"),
    [
        ("brax", "brax", "pip install brax"),
        ("brax_viewer", "brax", "pip install brax"),
        ("gymnasium", "gymnasium", "pip install 'jaxrl-vis[gymnasium]'"),
    ],
)
def test_missing_library_error_says_how_to_install_it(monkeypatch, adapter, library, hint):
    for name in [name for name in sys.modules if name.split(".")[0] == library]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"jaxrl_vis_envs.adapters.{adapter}", raising=False)
    with pytest.raises(ImportError, match=re.escape(hint)):
        importlib.import_module(f"jaxrl_vis_envs.adapters.{adapter}")


def test_brax_wrappers_truncate_at_the_horizon_and_reset():
    env = BraxEnv(told(), reward="dense")
    wrapped = training.EvalWrapper(training.wrap(env, episode_length=env.episode_length))
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 3))
    first = np.asarray(state.obs)
    assert first.shape == (3, env.observation_size) and len(np.unique(first[:, 1])) == 3
    step = jax.jit(wrapped.step)
    ends, episode_reward = [], 0.0
    for t in range(1, 2 * HORIZON + 1):
        goal = np.asarray(state.obs)[:, 1:]
        state = step(state, goal + 0.25)
        np.testing.assert_allclose(state.reward, -0.25, atol=1e-6)
        np.testing.assert_allclose(state.metrics["goal_distance"], 0.25, atol=1e-6)
        ends.append((float(state.done[0]), float(state.info["truncation"][0])))
        episode_reward += float(state.reward[0]) * (t <= HORIZON)
        expected = first if t % HORIZON == 0 else np.concatenate([goal + 0.25, goal], axis=1)
        np.testing.assert_allclose(state.obs, expected, atol=1e-6)
    assert ends == ([(0.0, 0.0)] * (HORIZON - 1) + [(1.0, 1.0)]) * 2
    summed = state.info["eval_metrics"].episode_metrics
    np.testing.assert_allclose(summed["reward"], episode_reward, atol=1e-5)
    np.testing.assert_allclose(summed["goal_distance"], 0.25 * HORIZON, atol=1e-5)


def test_brax_images_suit_its_vision_agents():
    env = BraxEnv(wide())
    state = env.step(env.reset(jax.random.PRNGKey(0)), jnp.zeros(1))
    assert env.observation_size == {"pixels/observation": (2, 4, 3), "pixels/goal": (2, 4, 3)}
    assert {name: image.shape for name, image in state.obs.items()} == env.observation_size
    bytes_shown = np.asarray(state.pipeline_state.achieved_state).view(np.uint8)
    np.testing.assert_allclose(255 * state.obs["pixels/observation"][0, :, 0], bytes_shown, atol=1e-3)
    assert float(state.reward) == -1.0


def test_typed_and_untyped_brax_keys_start_the_same_episode():
    env = BraxEnv(told())
    np.testing.assert_array_equal(env.reset(jax.random.PRNGKey(7)).obs, env.reset(jax.random.key(7)).obs)


def test_replicated_trees_have_the_sharding_of_brax_pmap():
    with share_jax_with_brax():
        lent = jax.device_put_replicated({"weight": np.ones(3, np.float32)}, jax.local_devices())
    returned = jax.pmap(lambda tree: tree, axis_name="i")(lent)  # as brax trains: another sharding compiles it anew
    assert returned["weight"].sharding == lent["weight"].sharding
    np.testing.assert_array_equal(lent["weight"], np.ones((len(jax.local_devices()), 3)))


BRAX_LEARNING = {"batch_size": 64, "discounting": 0.5}


def test_brax_ppo_learns():
    env = BraxEnv(told(), reward="dense")
    sizes = {"policy_hidden_layer_sizes": (16,), "value_hidden_layer_sizes": (16,)}
    with share_jax_with_brax():
        make_policy, params, _ = ppo.train(
            env,
            num_timesteps=40_000,
            episode_length=env.episode_length,
            num_envs=64,
            unroll_length=4,
            num_minibatches=2,
            num_updates_per_batch=4,
            run_evals=False,
            learning_rate=1e-3,
            **BRAX_LEARNING,
            network_factory=functools.partial(ppo_networks.make_ppo_networks, **sizes),
        )
    assert not hasattr(jax, "device_put_replicated")
    goal = jnp.linspace(-0.7, 0.7, 29)[:, None]
    action, _ = make_policy(params, deterministic=True)(jnp.concatenate([jnp.zeros_like(goal), goal], axis=1), None)
    assert float(jnp.abs(action - goal).mean()) < 0.12  # .36 for staying where it is


def test_brax_sac_trains():
    env, rewards = BraxEnv(told(), reward="dense"), []
    with share_jax_with_brax():
        sac.train(
            env,
            num_timesteps=2_000,
            episode_length=env.episode_length,
            num_envs=16,
            num_eval_envs=64,
            grad_updates_per_step=4,
            min_replay_size=256,
            max_replay_size=2048,
            learning_rate=5e-3,
            **BRAX_LEARNING,
            reward_scaling=30.0,
            deterministic_eval=True,
            network_factory=functools.partial(sac_networks.make_sac_networks, hidden_layer_sizes=(16,)),
            progress_fn=lambda _, metrics: rewards.append(metrics["eval/episode_reward"]),
        )
    assert rewards[-1] > -0.6, rewards  # staying in the middle, or anywhere at random, costs 1.6 or more
