"""Several devices: distribution of seeds, division of one learner, refusals, and what the parts exchange."""

import functools
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrl_vis import cli
from jaxrl_vis.config import Config, preset, validate
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.auxtasks.auxiliary import make_auxiliary
from jaxrl_vis.learner.ddpg.ddpg import GradientSteps, make_ddpg
from jaxrl_vis.learner.memory import reward_errors
from jaxrl_vis.learner.memory.replay import Replay
from jaxrl_vis.learner.memory.sampling import Sampler
from jaxrl_vis.learner.networks import normalizer
from jaxrl_vis.learner.networks.networks import Networks
from jaxrl_vis.learner.parallel.sharding import make_layout
from jaxrl_vis.learner.parallel.shards import DATA, Shards
from jaxrl_vis.learner.resolved import resolve
from jaxrl_vis.run.compiled import memory
from jaxrl_vis.types import Batch, Episodes, ReplayState, TrainState


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Results of `several_devices` on four devices of this CPU."""
    tests = Path(__file__).parents[1]
    paths = (tests, tests.parent, tests.parent / "envs")
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths)), "XLA_FLAGS": flags}
    done = subprocess.run([sys.executable, tests / "several_devices.py"], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_seeds_learn_on_two_devices_what_they_learn_on_one(found: dict[str, Any]) -> None:
    assert found["seeds: metrics"] < 1e-5
    assert found["seeds: state"] < 1e-5


def test_seeds_on_different_devices_never_communicate(found: dict[str, Any]) -> None:
    assert found["seeds: communication"] == []


def test_a_learner_in_two_parts_learns_on_two_devices_what_it_learns_on_one(found: dict[str, Any]) -> None:
    assert found["data: metrics"] < 1e-5
    assert found["data: state"] < 1e-4  # sums of squares of many grey levels


def test_a_run_learns_what_its_programs_do_by_themselves(found: dict[str, Any]) -> None:
    assert found["run: metrics"] < 1e-5
    assert found["run: state"] < 1e-4


def test_environments_start_and_explore_alike_on_however_many_devices(found: dict[str, Any]) -> None:
    assert found["data: first rollout"] < 1e-6


def test_a_run_goes_on_with_another_number_of_devices(found: dict[str, Any]) -> None:
    """Parameters, optimisers and replay are restored bit for bit, each on the intended devices."""
    assert found["restored"] == {
        "1 devices, None along data": [[], [1]],
        "2 devices, 1 along data": [[], [2]],
        "2 devices, 2 along data": [[], [2]],
        "4 devices, 2 along data": [[], [4]],
        "4 devices, 4 along data": [[], [4]],
    }
    assert found["resumed on one"] == [4, True]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"devices": 2, "seeds": 3}, "seeds 3 cannot be divided among 2 devices: write --seeds 4, or --data-devices 2"),
        ({"devices": 8, "seeds": 3, "data_devices": 2}, "seeds 3 cannot be divided among 4 groups of 2 devices"),
        ({"devices": 4, "data_devices": 3}, r"data_devices \(3\) must divide devices \(4\)"),
        ({"devices": 2, "data_devices": 0}, "data_devices must be at least 1, not 0"),
        ({"devices": 2, "batch_size": 5}, "batch_size 5 cannot be divided among 2 devices: write --batch-size 6"),
        ({"devices": 2, "num_envs": 3}, "num_envs 3 cannot be divided among 2 devices: write --num-envs 4"),
        ({"devices": 2, "eval_episodes": 7}, "eval_episodes 7 cannot be divided among 2 devices: write --eval-episodes 8"),
        ({"devices": 0}, "devices must be at least 1, not 0"),
    ],
)
def test_what_devices_do_not_divide_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(RequestError, match=message):
        validate(preset("debug", **changes))


def test_seeds_of_which_each_device_gets_some_may_be_of_any_batch_size() -> None:
    validate(preset("debug", devices=2, seeds=2, batch_size=5, num_envs=3, eval_episodes=7))


@pytest.mark.parametrize("words", [["--devices", "2"], ["--devices", "two"]])
def test_devices_that_are_not_there_are_reported_in_one_line(
    words: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    assert cli.main(["train", "Reacher", "--preset", "debug", "--run-dir", str(run_dir), *words]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "there is 1" in line or "--devices must be a whole number, not 'two'" in line
    assert not run_dir.exists()


def test_memory_is_asked_of_each_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """A replay that one device cannot hold fits on four, whichever way it is divided."""
    config = preset("debug", seeds=4, replay_transitions=1_000_000)
    layout = _Elsewhere(devices=4, parts=1)
    shapes, replay_bytes = {"weights": jax.ShapeDtypeStruct((4, 10), jnp.float32)}, 2**30
    monkeypatch.setattr(memory, "available_bytes", lambda device=None: int(2.5 * 2**30))
    with pytest.raises(RequestError, match="needs 4.0 GiB"):
        memory.check_memory(config, shapes, replay_bytes, 100)
    assert memory.check_memory(config, shapes, replay_bytes, 100, layout) == "replay 1.0 GiB of 2.5 GiB a device"
    assert "replay 1.0 GiB" in memory.check_memory(config, shapes, replay_bytes, 100, _Elsewhere(devices=4, parts=2))
    monkeypatch.setattr(memory, "available_bytes", lambda device=None: 2**29)
    with pytest.raises(RequestError, match="needs 1.0 GiB a device"):
        memory.check_memory(config, shapes, replay_bytes, 100, layout)


class _Elsewhere:
    """Layout on accelerators that are not present."""

    def __init__(self, devices: int, parts: int):
        self.num_devices, self.shards, self.mesh = devices, Shards(parts), object()
        self.devices = [type("Device", (), {"platform": "gpu"})()] * devices


def in_parts(function, count: int, *arrays):
    """Call a function with parts of arrays in parallel, as devices would; results of parts are along a new first axis."""
    parts = [array.reshape(count, -1, *array.shape[1:]) for array in arrays]
    return jax.jit(jax.vmap(lambda *part: function(Shards(count), *part), axis_name=DATA))(*parts)


def test_statistics_of_parts_are_those_of_the_whole() -> None:
    seen = 100.0 + 20.0 * jax.random.normal(jax.random.key(0), (8, 3, 5))
    update = jax.jit(normalizer.update)
    before = update(normalizer.init(jax.ShapeDtypeStruct((5,), jnp.float32)), seen[:4])
    whole = update(before, seen)
    parts = in_parts(lambda shards, part: normalizer.update(before, part, shards=shards), 2, seen)
    for name in ("count", "mean", "sum_of_squares"):
        for part in getattr(parts, name):
            np.testing.assert_allclose(part, getattr(whole, name), rtol=1e-5)


def test_each_part_takes_its_own_transitions_of_a_batch() -> None:
    """Numbers are drawn for the whole learner, so that the two parts of a batch have those of an undivided one."""
    config = validate(preset("debug", batch_size=12))
    replay = Replay(num_rollouts=2, num_envs=3, horizon=5)
    state = ReplayState(Episodes(*(jnp.zeros((6, 7, 2)) for _ in range(3))), jnp.int32(6))
    resolved, key, iteration = resolve(config, 5), jax.random.key(3), jnp.int32(1)
    whole = jax.jit(Sampler(config, resolved, replay, 0.1).choose)(state, key, iteration)

    def choose(shards, _):
        return Sampler(config, resolved, replay, 0.1, shards=shards).choose(state, key, iteration)

    parts = in_parts(choose, 2, jnp.zeros(2))
    np.testing.assert_array_equal(parts.indices.time.reshape(-1), whole.indices.time)
    np.testing.assert_array_equal(parts.indices.episode.reshape(-1), whole.indices.episode)
    np.testing.assert_array_equal(parts.goal_slot.reshape(-1), whole.goal_slot)


def test_the_cluttered_part_of_the_workspace_is_that_of_all_parts() -> None:
    config = validate(preset("debug", reward_clutter=0.5, reward_false_positives=0.1))
    replay = Replay(num_rollouts=2, num_envs=4, horizon=5)
    states = jax.random.uniform(jax.random.key(5), (2, 8, 7, 2))
    sizes = jnp.int32(4)  # the first rollout of each part
    expected = reward_errors.find_clutter_end(states[:, :4, -1].reshape(8, 2), jnp.ones(8, bool), 0.5)

    def end(shards, part):
        sampler = Sampler(config, resolve(config, 5), replay, 0.1, shards=shards)
        return sampler._clutter_end(ReplayState(Episodes(part[0], part[0], part[0]), sizes), jnp.int32(0))

    np.testing.assert_allclose(in_parts(end, 2, states), [expected, expected])


SPEC = jax.ShapeDtypeStruct((2, 16, 16), jnp.uint8)
SIZE = 16


def make_steps(config: Config, shards: Shards) -> GradientSteps:
    networks = Networks(config, SPEC, 2, 0.0)
    auxiliary = make_auxiliary(config, SPEC, 2, 1, networks.dtype)
    return make_ddpg(networks, config, resolve(config, 6), auxiliary, shards)


def make_learner(config: Config) -> TrainState:
    """Return a fresh learner that has seen a few images."""
    agent = make_steps(config, Shards()).init(jax.random.key(1))
    statistics = normalizer.update(normalizer.init(SPEC), jnp.arange(1024.0).reshape(2, 1, 2, 16, 16) % 200)
    # As high as the filter's threshold, so that it drops some transitions and keeps others.
    threshold = resolve(config, 6).filter_threshold
    is_output = {True: 0.0 if math.isinf(threshold) else threshold, False: 0.0}
    critic = jax.tree.map_with_path(lambda path, leaf: leaf + is_output["output" in str(path) and leaf.ndim == 1], agent.critic)
    return TrainState(agent.replace(critic=critic), statistics)


def gradients(config: Config, shards: Shards, train: TrainState, batch: Batch) -> Any:
    """Return the gradients and metrics of a batch."""
    steps = make_steps(config, shards)
    working = steps.begin(train.agent, train.statistics)
    return steps.gradients(working, steps.prepare(working, batch), True)


def make_batch(config: Config) -> Batch:
    keys = iter(jax.random.split(jax.random.key(2), 6))
    images = jax.random.randint(next(keys), (3, SIZE, 2, 16, 16), 0, 255).astype(jnp.uint8)
    success = jax.random.bernoulli(next(keys), 0.3, (SIZE,)).astype(jnp.float32)
    reward = (
        jnp.where(jax.random.bernoulli(next(keys), 0.4, (SIZE,)), 1.0, -1.0)
        if config.reward.method not in ("autoencoder", "classifier")
        else None
    )
    actions, states = (jax.random.uniform(next(keys), (SIZE, 2), minval=-1.0) for _ in range(2))
    batch = Batch(images, actions, states, states, reward=reward, success=success)
    if not config.auxiliary.aux_tasks:
        return batch
    auxiliary = make_auxiliary(config, SPEC, 2, 1, jnp.float32)
    return auxiliary.with_targets(jax.random.key(0), batch, {})


@pytest.mark.parametrize(
    "changes",
    [
        {"method": "indicator_balance_filter"},
        {"method": "autoencoder"},
        {"method": "classifier"},
        {"method": "indicator", "weighting": "ol_aux", "aux_tasks": ("inverse_dynamics", "forward_dynamics")},
        {"method": "indicator", "weighting": "sum", "aux_tasks": ("forward_dynamics",)},
    ],
    ids=lambda changes: changes.get("weighting", changes["method"]),
)
def test_gradients_and_metrics_of_parts_are_those_of_the_whole_batch(changes: dict[str, Any]) -> None:
    """Weightings and filters see the losses and gradients of the whole batch."""
    config = validate(preset("debug", batch_size=SIZE, updates_per_iteration=10, compute_dtype="float32", **changes))
    batch = jax.jit(functools.partial(make_batch, config))()
    train = jax.jit(functools.partial(make_learner, config))()
    whole = jax.jit(functools.partial(gradients, config, Shards()))(train, batch)
    filters = config.reward.method == "indicator_balance_filter"
    assert 0.0 < whole[1]["train/filtered_share"] < 1.0 if filters else whole[1]["train/filtered_share"] == 0.0

    def part_of(leaf: jax.Array) -> jax.Array:
        axis = 1 if leaf.ndim == 5 and leaf.shape[0] == 3 else 0
        return jnp.moveaxis(leaf.reshape(*leaf.shape[:axis], 2, -1, *leaf.shape[axis + 1 :]), axis, 0)

    of_part = jax.vmap(functools.partial(gradients, config, Shards(2)), in_axes=(None, 0), axis_name=DATA)
    parts = jax.jit(lambda train, batch: of_part(train, jax.tree.map(part_of, batch)))(train, batch)
    for (path, expected), leaf in zip(jax.tree.leaves_with_path(whole), jax.tree.leaves(parts), strict=True):
        for part in leaf:
            np.testing.assert_allclose(part, expected, rtol=2e-4, atol=2e-6, err_msg=jax.tree_util.keystr(path))


def test_one_device_is_as_it_was() -> None:
    layout = make_layout(preset("debug"))
    assert layout.mesh is None and layout.num_devices == 1
    state = ReplayState(Episodes(jnp.zeros((1, 4, 3)), jnp.zeros((1, 4, 3)), jnp.zeros((1, 4, 3))), jnp.int32(4))
    assert layout.fold_replay(state, 2) is state and layout.unfold_replay(state) is state
