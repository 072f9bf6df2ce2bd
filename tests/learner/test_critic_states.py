"""Critic that observes true states instead of images."""

import jax
import jax.numpy as jnp
import numpy as np
import probe_environments as probes
import pytest
from learners import begin, train_iteration

from jaxrl_vis.config import preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.memory.replay import Indices, make_replay
from jaxrl_vis.learner.train_step import make_train_step
from jaxrl_vis.types import Episodes

DISCOUNT = 0.75  # 1 - 1/horizon of the probes
SETTINGS = {
    "num_envs": 16,
    "updates_per_iteration": 50,
    "batch_size": 32,
    "hidden_sizes": (64, 64),
    "encoder_filters": (8, 8),
    "replay_transitions": 4000,
    "target_decay": 0.95,
    "action_penalty": 0.0,
    "normalizer_floor": 0.1,
    "eval_episodes": 64,
    "critic_states": True,
}


class Dark(probes.ThreeStepsAway):
    """`ThreeStepsAway` in images that are always black; the goals of half of the episodes are out of reach."""

    def start(self, key):
        return jnp.full(1, -3.0), 5.0 * jax.random.bernoulli(key, 0.5, (1,)).astype(jnp.float32)

    def see(self, position):
        return jnp.zeros((1, 8, 8), jnp.uint8)

    def observe_state(self, data):
        return jnp.concatenate([data, jnp.ones(1)])


class Lit(probes.SeenGoWhereTold):
    """`SeenGoWhereTold` with a state."""

    def observe_state(self, data):
        return jnp.concatenate([data, jnp.ones(1)])


def trained(env, iterations, **overrides):
    program = make_train_step(env, preset("debug", **{**SETTINGS, **overrides}))
    loop = begin(program, jax.random.key(7)[None])
    for _ in range(iterations):
        loop, metrics = train_iteration(program, loop)
    return program, loop.train, metrics


def test_values_of_states_and_goals_that_no_image_shows():
    program, train, _ = trained(Dark(), 15, relabel_probability=0.0, algorithm="td3")
    train, networks = jax.tree.map(lambda leaf: leaf[0], jax.device_get(train)), program.networks
    states = jnp.array([[x, 1.0, goal] for goal in (0.0, 5.0) for x in (-3.0, -2.0, -1.0)])
    scaling = networks.scaling(train.state_normalizer)
    states = (states - scaling.mean) * scaling.scale
    values = networks.value(train.agent.critic, states, jnp.zeros((6, 1)))
    expected = [-1.0 - DISCOUNT, -1.0, 0.0, *[-1.0 / (1.0 - DISCOUNT)] * 3]
    np.testing.assert_allclose(values, expected, atol=0.3)


def test_policy_follows_goals_that_it_sees():
    program, train, metrics = trained(Lit(), 25, relabel_probability=0.9, normalizer_floor=1.0)
    outcome, _ = program.evaluate(train, jax.random.key(11))
    assert outcome["eval/success"][0] >= 0.95
    assert "train/value_at_goals" not in metrics  # it has no true state


def test_auxiliary_losses_train_the_policy_s_encoder():
    program, train, metrics = trained(
        Lit(), 25, relabel_probability=0.9, normalizer_floor=1.0, aux_tasks=("inverse_dynamics",), weighting="ol_aux"
    )
    outcome, _ = program.evaluate(train, jax.random.key(11))
    assert outcome["eval/success"][0] >= 0.95
    assert set(train.agent.critic) == {"head"} and set(train.agent.actor) == {"encoder", "head", "heads"}
    assert metrics["train/weight/inverse_dynamics"][0] != 1.0  # learned from dots with the gradient of the policy's loss
    assert metrics["train/loss/inverse_dynamics"][0] < 0.1


def test_batches_hold_the_states_before_and_after_each_transition():
    replay = make_replay(8, 2, 4)
    slots = 10.0 * jnp.arange(2)[:, None] + jnp.arange(6)
    collected = Episodes(slots[..., None], slots[..., None], jnp.zeros((2, 4, 1)), full_states=slots[:, :5, None] + 100.0)
    empty = replay.init(jax.ShapeDtypeStruct((1,), jnp.float32), 1, 1, full_state_size=1)
    state = replay.insert(empty, collected, jnp.int32(0))
    indices, goal_slot = Indices(jnp.array([1, 0, 1]), jnp.array([0, 3, 2])), jnp.array([5, 4, 3])
    one, two = (replay.gather(state, indices, goal_slot, steps=steps).full_states for steps in (1, 2))
    np.testing.assert_array_equal(one[..., 0], [[110, 103, 112], [111, 104, 113]])
    np.testing.assert_array_equal(two[..., 0], [[110, 103, 112], [112, 104, 114]])


@pytest.mark.parametrize(
    ("env", "overrides", "message"),
    [
        (probes.GoWhereTold(), {}, "observes states"),
        (probes.SeenGoWhereTold(), {}, "observe_state"),
        (Lit(), {"algorithm": "contrastive"}, "critic_states is an option of --algorithm ddpg or td3"),
    ],
)
def test_what_cannot_have_true_states_is_refused_in_one_line(env, overrides, message):
    with pytest.raises(RequestError, match=message) as refused:
        make_train_step(env, preset("debug", **{**SETTINGS, **overrides}))
    assert "\n" not in str(refused.value)
