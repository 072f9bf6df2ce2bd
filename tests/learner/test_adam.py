"""Steps of our Adam, taken for several networks together, equal those of optax for each network."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import probe_environments as probes
from learners import update_arguments

from jaxrl_vis.config import preset
from jaxrl_vis.learner.ddpg import adam
from jaxrl_vis.learner.train_step import make_train_step

RATES = (1e-3, 3e-2)


def draw(key):
    """Return random parameters of two networks, or their gradients."""
    keys = jax.random.split(key, 3)
    networks = {"kernel": jax.random.normal(keys[0], (5, 3)), "bias": jax.random.normal(keys[1], (3,))}
    return networks, {"output": {"bias": jax.random.normal(keys[2], (1,))}}


def test_steps_are_those_of_optax():
    """Steps are equal although one of the networks takes only every third one."""
    ours, theirs = draw(jax.random.key(0)), draw(jax.random.key(0))
    states = [adam.init(params) for params in ours]
    optimizers = [optax.adam(rate) for rate in RATES]
    expected = [optimizer.init(params) for optimizer, params in zip(optimizers, theirs)]
    counts = np.zeros(2, np.int32)
    for number in range(30):
        gradients = draw(jax.random.key(number))
        takes_step = (True, number % 3 == 0)
        counts += takes_step
        corrections = adam.corrections(jnp.array(counts))
        for index in np.flatnonzero(takes_step):
            given = gradients[index], states[index], RATES[index], corrections[index]
            stepped, states[index] = adam.step(ours[index], *given)
            ours = (*ours[:index], stepped, *ours[index + 1 :])
            change, expected[index] = optimizers[index].update(gradients[index], expected[index])
            theirs = (*theirs[:index], optax.apply_updates(theirs[index], change), *theirs[index + 1 :])
    states = [adam.with_count(state, steps) for state, steps in zip(states, counts)]
    assert jax.tree.structure(states) == jax.tree.structure(expected)
    for left, right in zip(jax.tree.leaves((ours, states)), jax.tree.leaves((theirs, expected)), strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-6, atol=1e-7)


def test_a_learner_goes_on_where_it_stopped():
    """Two iterations of two updates leave the same counters as one iteration of four."""
    counters = []
    for calls, updates in ((1, 4), (2, 2)):
        config = preset("debug", num_envs=4, batch_size=8, updates_per_iteration=updates, actor_interval=2)
        program = make_train_step(probes.GoWhereTold(), config)
        train, *given = update_arguments(program, jax.random.key(0))
        for _ in range(calls):
            train, _ = program.update_many(train, *given)
        states = train.agent.critic_optimizer, train.agent.actor_optimizer
        counters.append([int(each[0]) for each in (*map(adam.count, states), train.agent.updates)])
    assert counters == [[4, 2, 4], [4, 2, 4]]
