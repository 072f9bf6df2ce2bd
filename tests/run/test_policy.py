"""`jaxrl_vis.load_policy`: policies of runs, used elsewhere."""

import dataclasses
import re
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import probe_environments as probes
import pytest

import jaxrl_vis
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.acting.rollout import play
from jaxrl_vis.run.storage.checkpoint import LIGHT
from jaxrl_vis.run.trained.restored_run import load, open_run
from jaxrl_vis_envs import registry
from jaxrl_vis_envs.adapters.gymnasium import GymnasiumEnv, GymnasiumVectorEnv
from jaxrl_vis_envs.pixels import PixelsConfig

SETTINGS = {"num_envs": 2, "hidden_sizes": (8,), "replay_transitions": 40, "batch_size": 4, "eval_episodes": 2, "env_steps": 24}
SETTINGS |= {"encoder_filters": (4,), "latent_size": 8, "checkpoint_interval": 1, "updates_per_iteration": 2}


class Seen(probes.GoWhereTold):
    """Probe observed as an image [2, 4, 6]: a random pattern that brightens with the position."""

    def __init__(self, _: Any = None) -> None:
        self.pattern = jnp.asarray(np.random.default_rng(0).uniform(0, 100, (2, 4, 6)), jnp.float32)

    def see(self, position):
        return (self.pattern * (1.0 + position[0])).astype(jnp.uint8)


@dataclasses.dataclass(frozen=True)
class NoOptions:
    """Options of an environment without any."""


def register(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = {"Told": (lambda _: probes.GoWhereTold(), NoOptions), "VisualTold": (Seen, PixelsConfig)}
    for name, (build, options) in entries.items():
        monkeypatch.setitem(registry._ENTRIES, name, registry._Entry(build, options))


@pytest.fixture(autouse=True)
def told(monkeypatch: pytest.MonkeyPatch) -> None:
    """A state task and an image task that compile quickly."""
    register(monkeypatch)


@pytest.fixture(scope="module")
def policies(runs: dict[str, Path]) -> dict[str, jaxrl_vis.Policy]:
    """Policies of the first seed of each run."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        register(monkeypatch)
        return {name: jaxrl_vis.load_policy(run) for name, run in runs.items()}


def played(run: Path) -> Any:
    """Return episodes [S, 5, ...] that the learner itself plays with the newest checkpoint."""
    trainer = open_run(run)
    train = load(trainer, run).train
    keys = jnp.stack([jax.random.key(0)] * len(trainer.seeds))
    return jax.jit(lambda train: play(trainer.program.acting, train, keys, 5).episodes)(train)


@pytest.mark.parametrize(("name", "seeds"), [("VisualTold", (3, 4)), ("Told", (0,))])
def test_it_acts_as_the_learner_does(name: str, seeds: tuple[int, ...], runs: dict[str, Path], policies: dict) -> None:
    episodes = played(runs[name])
    actions = []
    for index, seed in enumerate(seeds):
        policy = jaxrl_vis.load_policy(runs[name], seed=seed)
        assert (policy.env_name, policy.seed, policy.iteration) == (name, seed, 3)
        goals, current = episodes.observations[index, :, -1], episodes.observations[index, :, 1]
        actions.append(jax.vmap(policy)(current, goals))
        assert actions[-1].shape == (5, 1) and actions[-1].dtype == jnp.float32
        np.testing.assert_allclose(actions[-1], episodes.actions[index, :, 1], atol=1e-5)
        np.testing.assert_allclose(policy(np.asarray(current[2]), np.asarray(goals[2])), actions[-1][2], atol=1e-5)
        assert np.ptp(actions[-1]) > 1e-4
    if len(seeds) > 1:
        assert not np.allclose(*actions)
        assert policies[name].seed == 3 and policies[name].config.run.seeds == 2


def test_it_works_inside_a_scan(policies: dict[str, jaxrl_vis.Policy]) -> None:
    policy = policies["VisualTold"]
    env = policy.env

    @jax.jit
    def episode(key):
        state = env.reset(key)
        goal = state.obs["desired_goal"]

        def step(state, _):
            action = policy(env.observe(state), goal)
            return env.advance(state, action), action

        return jax.lax.scan(step, state, length=env.horizon)[1]

    actions = np.asarray(episode(jax.random.key(1)))
    assert actions.shape == (4, 1) and np.all(np.abs(actions) <= 1.0)


def test_a_checkpoint_can_be_chosen(runs: dict[str, Path], tmp_path: Path) -> None:
    newest, before = (jaxrl_vis.load_policy(runs["Told"], checkpoint=iteration) for iteration in (3, 2))
    assert (newest.iteration, before.iteration) == (3, 2)
    goal, current = np.float32([0.5]), np.float32([0.1])
    assert newest(current, goal) != before(current, goal)
    run = tmp_path / "run"
    shutil.copytree(runs["Told"], run)
    for file in (run / "checkpoints" / LIGHT / "2").rglob("d/*"):
        file.unlink()
    with pytest.raises(RequestError, match="checkpoint 2 of the run in .* is damaged"):
        jaxrl_vis.load_policy(run, checkpoint=2)
    with pytest.raises(RequestError, match="has no checkpoint of iteration 9, only of 2, 3"):
        jaxrl_vis.load_policy(run, checkpoint=9)


@pytest.mark.parametrize(
    ("name", "observation", "words"),
    [
        ("VisualTold", np.zeros((5, 2, 4, 6), np.uint8), r"shape \(2, 4, 6\), not \(5, 2, 4, 6\): jax.vmap\(policy\)"),
        ("VisualTold", np.zeros((4, 6, 2), np.uint8), r"not \(4, 6, 2\): images are planar here, .*np.moveaxis"),
        ("VisualTold", np.zeros((2, 4, 6), np.float32), "must be uint8 from 0 to 255, not float32"),
        ("Told", np.zeros((3, 1), np.float32), r"not \(3, 1\): jax.vmap\(policy\)"),
        ("Told", np.zeros((2,), np.float32), r"must have the shape \(1,\), not \(2,\)"),
        ("Told", np.zeros((1,), np.uint8), "must be float32, not uint8"),
    ],
)
def test_a_wrong_input_is_reported_in_one_line(
    name: str, observation: np.ndarray, words: str, policies: dict[str, jaxrl_vis.Policy]
) -> None:
    policy = policies[name]
    right = np.zeros(policy.observation_spec.shape, policy.observation_spec.dtype)
    for arguments, which in (((observation, right), "observation"), ((right, observation), "goal")):
        for call in (policy, jax.jit(policy.__call__)):
            with pytest.raises(RequestError, match=words) as caught:
                call(*arguments)
            assert f"{name}: {which} must" in str(caught.value) and "\n" not in str(caught.value)


def test_a_run_that_cannot_be_used_is_reported_in_one_line(runs: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="no run in"):
        jaxrl_vis.load_policy(tmp_path)
    with pytest.raises(RequestError, match="has trained no seed 0, only seeds 3 to 4"):
        jaxrl_vis.load_policy(runs["VisualTold"], seed=0)
    shutil.copy(runs["Told"] / "config.json", tmp_path)
    with pytest.raises(RequestError, match="no usable checkpoint: train it first"):
        jaxrl_vis.load_policy(tmp_path)


@pytest.mark.parametrize("name", ["VisualTold", "Told"])
def test_it_plays_in_gymnasium(name: str, policies: dict[str, jaxrl_vis.Policy]) -> None:
    """The observations of the adapter, single and vector, are what the environment itself shows."""
    policy = policies[name]
    env = GymnasiumEnv(policy.env)
    with pytest.raises(Exception, match="reset"):
        env.learner_view()
    observation, _ = env.reset(seed=1)
    truncated, actions = False, []
    while not truncated:
        view = env.learner_view()
        if name == "VisualTold":
            planar = [np.moveaxis(observation[key], -1, 0) for key in ("pixels", "goal_pixels")]
            np.testing.assert_array_equal(view[0], planar[0])
            np.testing.assert_array_equal(view[1], planar[1])
        else:
            np.testing.assert_array_equal(view[0], observation["observation"])
            np.testing.assert_array_equal(view[1], observation["desired_goal"])  # of a point that sees all of itself
        actions.append(policy(*view))
        observation, _, _, truncated, _ = env.step(np.asarray(actions[-1]))
    assert len(actions) == policy.env.horizon
    envs = GymnasiumVectorEnv(policy.env, num_envs=3)
    envs.reset(seed=1)
    first = jax.vmap(policy)(*envs.learner_view())
    assert first.shape == (3, 1)
    np.testing.assert_allclose(first[0], actions[0], atol=1e-6)
    envs.step(np.asarray(first))
    assert not np.array_equal(envs.learner_view()[0][0], envs.learner_view()[0][1])


@pytest.mark.parametrize("page", ["docs/start.md", "docs/adapters.md"])
def test_examples_of_the_pages_run(page: str, runs: dict[str, Path], checkout: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (checkout / page).read_text(), re.DOTALL)
    (block,) = [text for text in blocks if "load_policy" in text]
    names: dict[str, Any] = {"jax": jax, "jaxrl_vis": jaxrl_vis}
    exec(compile(block.replace("runs/mine", str(runs["VisualTold"])), page, "exec"), names)
    assert names["action"].shape == (1,)
    assert page == "docs/start.md" or names["actions"].shape == (16, 1) and names["truncated"]


def test_a_call_does_not_trace_the_environment_again(
    policies: dict[str, jaxrl_vis.Policy], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tracing the environment would take a hundred times as long as the policy."""
    policy, zero = policies["Told"], np.zeros(1, np.float32)
    policy(zero, zero)
    monkeypatch.setattr(type(policy.env), "observation_spec", property(lambda _: pytest.fail("traced again")))
    policy(zero, zero)
