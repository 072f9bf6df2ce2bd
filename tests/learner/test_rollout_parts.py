"""Training and evaluation in parts, as on a CPU, give the results of all environments at once."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import point_mass
import pytest

from jaxrl_vis.config import preset
from jaxrl_vis.learner import train_step
from jaxrl_vis.learner.acting.rollout import Exploration
from jaxrl_vis.learner.acting.rollout_parts import PART_SIZE, RolloutPart, join_parts, part_result_spec, part_size
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis.learner.parallel.shards import ONE
from jaxrl_vis.learner.train_step import TrainStep, make_train_step
from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.run.compiled.threaded_rollout import ThreadedRollout

CONFIG = preset("debug", env="VisualPoint", num_envs=10, seeds=2, eval_episodes=13, image_size=16)


@pytest.fixture(scope="module")
def program() -> TrainStep:
    with point_mass.registered():
        return make_train_step(make_env(CONFIG), CONFIG)


@pytest.fixture(scope="module")
def programs(program: TrainStep) -> Programs:
    made = Programs(CONFIG, program)
    made.compile()
    return made


@pytest.fixture(scope="module")
def whole(program: TrainStep) -> Programs:
    """Programs for a GPU, which plays all environments at once and has a separate program for evaluations."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train_step, "targets_cpu", lambda: False)
        return Programs(CONFIG, make_train_step(program.env, CONFIG))


def assert_near(found, expected) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        if jax.dtypes.issubdtype(ours.dtype, jax.dtypes.prng_key):
            ours, theirs = jax.random.key_data(ours), jax.random.key_data(theirs)
        assert ours.shape == theirs.shape and ours.dtype == theirs.dtype
        # A pixel at an edge may round to the next of 256 values.
        ours, theirs = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
        np.testing.assert_allclose(ours, theirs, rtol=2e-3, atol=1.0 if theirs.max(initial=0) > 100 else 1e-4)


@pytest.mark.parametrize("num_envs", [1, 3, 7, 8, 9, 13, 16, 25, 80, 1000])
def test_parts_are_few_small_and_nearly_full(num_envs: int) -> None:
    size = part_size(num_envs)
    count = math.ceil(num_envs / size)
    assert size <= PART_SIZE and count == math.ceil(num_envs / PART_SIZE)
    assert count * size - num_envs < count


def test_an_evaluation_is_of_the_same_episodes(programs: Programs, whole: Programs) -> None:
    train = programs.init(programs.run_keys).train
    assert set(programs.evaluation_programs()) == {"play"} and set(whole.evaluation_programs()) == {"evaluate"}
    assert_near(programs.evaluate(train), whole.evaluate(train))
    other, _ = programs.evaluate(train, jax.random.key(5))
    assert not np.array_equal(other["eval/goal_distance"], programs.evaluate(train)[0]["eval/goal_distance"])


def test_iterations_are_the_same(programs: Programs, whole: Programs) -> None:
    expected, found = programs.init(programs.run_keys), programs.init(programs.run_keys)
    for _ in range(2):
        expected, expected_metrics = whole.train_iteration(expected)
        found, metrics = programs.train_iteration(found)
        assert_near(metrics, expected_metrics)
    assert_near(found.replay, expected.replay)
    assert_near((found.key, found.iteration), (expected.key, expected.iteration))


def test_rollouts_are_the_same_and_explore(program: TrainStep, programs: Programs, whole: Programs) -> None:
    train = programs.init(programs.run_keys).train
    parts = programs.play(train, programs.run_keys)
    joined = jax.tree.map(lambda *leaves: join_parts(leaves, CONFIG.run.num_envs, axis=1), *parts)
    (expected,) = whole.play(train, programs.run_keys)
    assert len(parts) == 2
    assert_near(joined, expected)
    threaded = ThreadedRollout(program.part_size)
    play = functools.partial(threaded.play, programs.compiled("play"), train, programs.run_keys, 10)
    policy, random, noisy = (
        np.concatenate([episodes.actions for episodes, _ in play(Exploration(*exploration))], axis=1)[:, :, 0]
        for exploration in ((0.0, 0.0), (1.0, 0.0), (0.0, 0.2))  # first actions, which all three take in the same state
    )
    assert policy.shape == (2, 10, 2)
    assert abs(random.std() - 3**-0.5) < 0.15 and 0.1 < (noisy - policy).std() < 0.3


def test_a_gpu_plays_all_at_once(program: TrainStep, programs: Programs, whole: Programs) -> None:
    """Evaluations on a GPU have a program of their own."""
    assert (program.part_size, program.plays_parts) == (5, True)
    assert set(programs.names) == {"play", "learn", "init", "nonfinite_leaves", "keys"}
    assert (whole.program.part_size, whole.program.plays_parts) == (CONFIG.run.num_envs, False)
    assert set(whole.names) == {"play", "learn", "evaluate", "init", "nonfinite_leaves", "keys"}
    assert set(programs.training_programs()) == set(whole.training_programs()) == {"play", "learn", "keys"}


def test_parts_are_of_what_all_draw_but_for_the_noise_of_images() -> None:
    key = jax.random.key(3)
    whole = jax.random.normal(key, (10, 3))
    slices = [RolloutPart(first=jnp.int32(first), total=10) for first in (0, 4, 8, 12)]
    drawn = jnp.concatenate([each.draw(lambda shape: jax.random.normal(key, shape), (4, 3)) for each in slices])
    np.testing.assert_array_equal(drawn[:10], whole)
    assert not drawn[10:].any()
    keys = jax.random.key_data(jnp.concatenate([each.split(key, 4) for each in slices]))
    np.testing.assert_array_equal(keys, jax.random.key_data(jax.random.split(key, 16)))
    noise = np.asarray(jnp.concatenate([each.noise(key, (4, 3)) for each in slices]))
    assert len(np.unique(noise)) == noise.size
    np.testing.assert_array_equal(ONE.noise(key, (10, 3)), whole)


def test_what_is_played_has_the_shapes_that_are_compiled_for(program: TrainStep, programs: Programs) -> None:
    played = program.play(
        programs.init(programs.run_keys).train, programs.run_keys, np.int32(0), Exploration(np.float32(0), np.float32(0))
    )
    spec = part_result_spec(program.env, program.part_size, 2)
    assert jax.tree.structure(spec) == jax.tree.structure(played)
    assert [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(spec)] == [
        (leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(played)
    ]
