"""DDPG whose actor has weights of its own for the auxiliary losses, against DDPG itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.tasks import actor_weights
from jaxrl_vis.config import preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.algorithm import Algorithm, Batches, Setup
from jaxrl_vis.learner.auxtasks.auxiliary import make_auxiliary
from jaxrl_vis.learner.ddpg import ddpg
from jaxrl_vis.learner.networks import normalizer
from jaxrl_vis.learner.resolved import resolve
from jaxrl_vis.types import Batch, Statistics

SPEC = jax.ShapeDtypeStruct((3, 16, 16), jnp.uint8)
UPDATES, BATCH, ACTIONS = 6, 4, 2


def setup(**changes) -> Setup:
    config = preset(
        "debug",
        updates_per_iteration=UPDATES,
        batch_size=BATCH,
        compute_dtype="float32",
        **{"actor_log": "loss", "aux_tasks": ("inverse_dynamics", "autoencoder"), **changes},
    )
    return Setup(config, resolve(config, 5), SPEC, ACTIONS, make_auxiliary(config, SPEC, ACTIONS, 1, jnp.float32))


def train(algorithm: Algorithm):
    draw = np.random.default_rng(0)
    batches = Batch(
        observations=draw.integers(0, 256, (UPDATES, 3, BATCH, *SPEC.shape), np.uint8),
        action=draw.uniform(-1, 1, (UPDATES, BATCH, ACTIONS)).astype(np.float32),
        state_tp1=np.zeros((UPDATES, BATCH, 1), np.float32),
        goal_state=np.zeros((UPDATES, BATCH, 1), np.float32),
        reward=-draw.integers(0, 2, (UPDATES, BATCH)).astype(np.float32),
    )
    agent, statistics = algorithm.init(jax.random.key(0)), Statistics(normalizer.init(SPEC), None)
    update = jax.jit(lambda agent: algorithm.update(agent, statistics, Batches(batches, lambda row: row), jax.random.key(1)))
    return update(agent)


def test_with_fixed_weights_it_is_ddpg() -> None:
    fixed = setup(weighting="fixed", weighting_fixed=0.5)
    (own, metrics), (base, others) = (train(make(fixed)) for make in (actor_weights.ddpg, ddpg.make))
    for name in ("actor", "critic"):
        jax.tree.map(
            lambda one, other: np.testing.assert_allclose(one, other, atol=2e-5), getattr(own, name), getattr(base, name)
        )
    assert float(metrics["train/critic_loss"]) == pytest.approx(float(others["train/critic_loss"]), rel=1e-4)


def test_learned_weights_differ_between_the_networks() -> None:
    agent, metrics = train(actor_weights.ddpg(setup(weighting="ol_aux", weighting_interval=2)))
    critic, actor = agent.weighting
    assert int(critic.updates) == int(actor.updates) == UPDATES
    for name in ("inverse_dynamics", "autoencoder"):
        assert len({1.0, float(critic.weights[name]), float(actor.weights[name])}) == 3
        assert f"train/actor_weight/{name}" in metrics and f"train/weight/{name}" in metrics


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actor_log": "value"}, "--actor-log loss"),
        ({"encoders": "shared"}, "encoders separate"),
        ({"aux_tasks": ()}, "aux_tasks"),
    ],
)
def test_settings_without_an_actors_own_weights_are_refused(changes, message: str) -> None:
    weighting = "none" if "aux_tasks" in changes else "balance"
    with pytest.raises(RequestError, match=message):
        actor_weights.ddpg(setup(**{"weighting": weighting, **changes}))
