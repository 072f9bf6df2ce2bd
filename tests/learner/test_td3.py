"""TD3: comparison with a transcription, probes with known answers, and combinations with the other options of DDPG."""

import jax
import jax.numpy as jnp
import numpy as np
import probe_environments as probes
import pytest
from learners import begin, train_iteration
from numpy_networks import Adam, backward, forward, layers, polyak_average

from jaxrl_vis.config import preset
from jaxrl_vis.learner.algorithm import Batches, Setup
from jaxrl_vis.learner.auxtasks.auxiliary import make_auxiliary
from jaxrl_vis.learner.ddpg import ddpg
from jaxrl_vis.learner.networks import normalizer
from jaxrl_vis.learner.resolved import resolve
from jaxrl_vis.learner.td3 import CLIP, NOISE, make
from jaxrl_vis.learner.train_step import make_train_step
from jaxrl_vis.types import Batch, Statistics

SPEC = jax.ShapeDtypeStruct((3,), jnp.float32)
BATCH, ACTIONS, RATE, DECAY, PENALTY = 8, 2, 1e-2, 0.9, 0.3
CONFIG = preset(
    "debug",
    env="Probe",
    algorithm="td3",
    updates_per_iteration=4,
    batch_size=BATCH,
    hidden_sizes=(7,),
    critic_learning_rate=RATE,
    actor_learning_rate=RATE,
    target_decay=DECAY,
    action_penalty=PENALTY,
    normalizer_floor=1.0,
)


def draw_batches():
    draw = np.random.default_rng(0)
    return Batch(
        observations=draw.uniform(-1, 1, (4, 3, BATCH, 3)).astype(np.float32),
        action=draw.uniform(-1, 1, (4, BATCH, ACTIONS)).astype(np.float32),
        state_tp1=np.zeros((4, BATCH, 1), np.float32),
        goal_state=np.zeros((4, BATCH, 1), np.float32),
        reward=-draw.integers(0, 2, (4, BATCH)).astype(np.float32),
    )


def numpy_td3(agent, batches, noise, resolved):
    """Return actor, critics and their targets after four steps, of which the second and the fourth move actor and targets."""
    actor, critics = layers(agent.actor["head"]), [layers(agent.critic["head"], number) for number in (0, 1)]
    target_actor, targets = actor, list(critics)
    of_actor, of_critics = Adam(RATE), [Adam(RATE), Adam(RATE)]
    for step in range(4):
        before, goal, after = np.asarray(batches.observations[step], np.float64)
        action = np.asarray(batches.action[step], np.float64)
        following = np.tanh(forward(target_actor, np.concatenate([after, goal], axis=1))[0])
        following = np.clip(following + np.clip(NOISE * noise[step], -CLIP, CLIP), -1.0, 1.0)
        inputs = np.concatenate([after, goal, following], axis=1)
        least = np.minimum(*(forward(network, inputs)[0][:, 0] for network in targets))
        target = np.clip(batches.reward[step] + resolved.discount * least, resolved.target_minimum, resolved.target_maximum)
        pair, gradient = np.concatenate([before, goal], axis=1), None
        if step % 2:  # with the critic as it is before its own step
            outputs, seen = forward(actor, pair)
            own = np.tanh(outputs)
            _, of_value = forward(critics[0], np.concatenate([pair, own], axis=1))
            slope = backward(critics[0], of_value, np.full((BATCH, 1), -1.0 / BATCH))[1][:, -ACTIONS:]
            slope = (slope + PENALTY * 2.0 * own / own.size) * (1.0 - own**2)
            gradient = backward(actor, seen, slope)[0]
        for number, network in enumerate(critics):
            value, seen = forward(network, np.concatenate([pair, action], axis=1))
            slope = 2.0 * (value - target[:, None]) / BATCH
            critics[number] = of_critics[number].step(network, backward(network, seen, slope)[0])
        if gradient is not None:
            actor = of_actor.step(actor, gradient)
            target_actor = polyak_average(actor, target_actor, DECAY)
            targets = [polyak_average(online, network, DECAY) for online, network in zip(critics, targets, strict=True)]
    return actor, critics, target_actor, targets


def test_gradient_steps_are_their_transcription():
    resolved = resolve(CONFIG, horizon=5)
    algorithm = make(Setup(CONFIG, resolved, SPEC, ACTIONS, make_auxiliary(CONFIG, SPEC, ACTIONS, 1, jnp.float32)))
    agent, key = algorithm.init(jax.random.key(3)), jax.random.key(5)
    batches, statistics = draw_batches(), Statistics(normalizer.init(SPEC), None)
    update = jax.jit(lambda agent, rows: algorithm.update(agent, statistics, Batches(rows, lambda row: row), key))
    after, metrics = update(agent, batches)
    noise = np.asarray(jax.random.normal(key, (BATCH, 4, ACTIONS)), np.float64).swapaxes(0, 1)
    assert (np.abs(NOISE * noise) > CLIP).any()
    expected = numpy_td3(agent, batches, noise, resolved)
    found = (
        layers(after.actor["head"]),
        [layers(after.critic["head"], number) for number in (0, 1)],
        layers(after.target_actor["head"]),
        [layers(after.target_critic["head"], number) for number in (0, 1)],
    )
    jax.tree.map(lambda ours, theirs: np.testing.assert_allclose(ours, theirs, atol=2e-5), found, expected)
    assert int(after.updates) == 4 and np.isfinite(list(metrics.values())).all()


def test_presets_delay_the_actor():
    assert CONFIG.ddpg.actor_interval == CONFIG.ddpg.target_update_interval == 2
    assert preset("debug").ddpg.actor_interval == 1
    assert preset("paper", algorithm="td3").ddpg.target_update_interval == 40


def test_heads_differ_from_the_start_and_the_first_is_that_of_ddpg():
    configs = [CONFIG.replace(algorithm=name) for name in ("td3", "ddpg")]
    auxiliary = make_auxiliary(CONFIG, SPEC, ACTIONS, 1, jnp.float32)
    setups = [Setup(each, resolve(each, 5), SPEC, ACTIONS, auxiliary) for each in configs]
    twin, single = make(setups[0]).init(jax.random.key(0)), ddpg.make(setups[1]).init(jax.random.key(0))
    first, second = (jax.tree.map(lambda leaf, number=number: leaf[number], twin.critic["head"]) for number in (0, 1))
    jax.tree.map(np.testing.assert_array_equal, first, single.critic["head"])
    assert np.abs(first["output"]["kernel"] - second["output"]["kernel"]).max() > 0.1


SETTINGS = {
    "algorithm": "td3",
    "num_envs": 16,
    "updates_per_iteration": 50,
    "batch_size": 64,
    "hidden_sizes": (64, 64),
    "replay_transitions": 4000,
    "target_decay": 0.95,
    "action_penalty": 0.0,
    "normalizer_floor": 0.1,
    "eval_episodes": 64,
    "relabel_probability": 0.9,
}


@pytest.mark.parametrize(
    ("env", "changes"),
    [
        (probes.GoWhereTold(), {"seeds": 2}),
        (
            probes.SeenGoWhereTold(),
            {"batch_size": 32, "encoder_filters": (8, 8), "normalizer_floor": 1.0, "encoders": "shared"},
        ),
    ],
    ids=["states, two seeds", "images, one encoder"],
)
def test_policy_goes_where_the_goal_is(env, changes):
    program = make_train_step(env, preset("debug", **{**SETTINGS, **changes}))
    loop = begin(program, jax.random.split(jax.random.key(7), changes.get("seeds", 1)))
    for _ in range(12):
        loop, metrics = train_iteration(program, loop)
    assert metrics["guard/nonfinite"].sum() == 0
    outcome, _ = program.evaluate(loop.train, jax.random.key(11))
    assert (outcome["eval/success"] >= 0.9).all()
