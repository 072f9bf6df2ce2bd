"""Contrastive RL: comparison with a transcription, choice of goals, and learning without rewards."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import point_mass
import probe_environments as probes
import pytest
from learners import begin, train_iteration, update_arguments

from benchmarks.tasks import contrastive_forms
from jaxrl_vis.config import preset, validate
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.algorithm import Batches, Setup
from jaxrl_vis.learner.auxtasks.auxiliary import make_auxiliary
from jaxrl_vis.learner.contrastive import LOGSUMEXP_PENALTY, make
from jaxrl_vis.learner.memory.relabel import choose_goal_slots
from jaxrl_vis.learner.memory.replay import Replay
from jaxrl_vis.learner.memory.sampling import Sampler
from jaxrl_vis.learner.networks import normalizer
from jaxrl_vis.learner.parallel.shards import Shards
from jaxrl_vis.learner.resolved import resolve
from jaxrl_vis.learner.train_step import make_train_step
from jaxrl_vis.types import Batch, Episodes, Statistics

SPEC = jax.ShapeDtypeStruct((2,), jnp.float32)
BATCH, ACTIONS, RATE, PENALTY = 5, 2, 1e-2, 0.3


def config(**changes):
    settings = {
        "env": "Probe",
        "algorithm": "contrastive",
        "batch_size": BATCH,
        "hidden_sizes": (4,),
        "representation_size": 3,
        "critic_learning_rate": RATE,
        "actor_learning_rate": RATE,
        "action_penalty": PENALTY,
        "normalizer_floor": 1.0,
    }
    return preset("debug", **{**settings, **changes})


def setup(chosen, **changes):
    auxiliary = make_auxiliary(chosen, SPEC, ACTIONS, 1, jnp.float32)
    return dataclasses.replace(Setup(chosen, resolve(chosen, 5), SPEC, ACTIONS, auxiliary), **changes)


def numpy_head(head, inputs):
    """Apply a head in float64: one hidden layer, normalised if it has the parameters for that."""
    values = inputs @ head["hidden_0"]["kernel"] + head["hidden_0"]["bias"]
    if "normalization_0" in head:
        centred = values - values.mean(axis=1, keepdims=True)
        scaled = centred / np.sqrt(np.square(centred).mean(axis=1, keepdims=True) + 1e-6)
        values = scaled * head["normalization_0"]["scale"] + head["normalization_0"]["bias"]
    return np.maximum(values, 0.0) @ head["output"]["kernel"] + head["output"]["bias"]


def numpy_critic_loss(critic, before, goal, action, form):
    logits = numpy_head(critic["sa"], np.concatenate([before, action], axis=1)) @ numpy_head(critic["g"], goal).T
    probability, losses = 1.0 / (1.0 + np.exp(-logits)), []
    for row in range(BATCH):
        if form == "nce":
            told = np.where(np.arange(BATCH) == row, probability[row], 1.0 - probability[row])
            losses.append(np.mean(-np.log(told)))
            continue
        forward, backward = np.log(np.exp(logits[row]).sum()), np.log(np.exp(logits[:, row]).sum())
        losses.append(forward + backward - 2.0 * logits[row, row] + LOGSUMEXP_PENALTY * forward**2)
    return np.mean(losses)


def numpy_actor_loss(actor, critic, before, goal):
    loss = 0.0
    for goals in (goal, np.roll(goal, 1, axis=0)):
        action = np.tanh(numpy_head(actor["head"], np.concatenate([before, goals], axis=1)))
        of_pairs, of_goals = numpy_head(critic["sa"], np.concatenate([before, action], axis=1)), numpy_head(critic["g"], goals)
        logit = (of_pairs * of_goals).sum(axis=1)
        loss += (PENALTY * np.mean(action**2) - np.mean(logit)) / 2.0
    return loss


def numpy_step(params, loss):
    """Return parameters after the first step of Adam, with the gradient by central differences."""
    leaves, structure = jax.tree.flatten(params)
    moved = []
    for number, leaf in enumerate(leaves):
        slopes = np.zeros_like(leaf)
        for place in np.ndindex(leaf.shape):
            ends = []
            for sign in (1.0, -1.0):
                changed = leaf.copy()
                changed[place] += sign * 1e-5
                ends.append(loss(jax.tree.unflatten(structure, [*leaves[:number], changed, *leaves[number + 1 :]])))
            slopes[place] = (ends[0] - ends[1]) / 2e-5
        moved.append(leaf - RATE * slopes / (np.abs(slopes) + 1e-8))
    return jax.tree.unflatten(structure, moved)


@pytest.mark.parametrize("form", ["nce", "stable"])
def test_a_gradient_step_is_its_transcription(form):
    algorithm, draw = make(setup(config(contrastive_form=form))), np.random.default_rng(1)
    fresh = algorithm.init(jax.random.key(3))
    assert (float(np.abs(fresh.critic["sa"]["output"]["kernel"]).max()) < 2e-12) == (form == "stable")
    random = jax.tree.map(lambda leaf: draw.normal(0.0, 0.7, leaf.shape).astype(np.float32), (fresh.actor, fresh.critic))
    agent = fresh.replace(actor=random[0], critic=random[1])
    observations = draw.uniform(-1, 1, (3, BATCH, 2)).astype(np.float32)
    action = draw.uniform(-1, 1, (BATCH, ACTIONS)).astype(np.float32)
    nothing = np.full((BATCH, 1), np.nan, np.float32)  # neither states nor rewards are read
    batch = Batch(observations, action, nothing, nothing, nothing[:, 0], success=nothing[:, 0])
    rows = jax.tree.map(lambda leaf: leaf[None], batch)
    statistics = Statistics(normalizer.init(SPEC), None)
    update = jax.jit(lambda agent, rows: algorithm.update(agent, statistics, Batches(rows, lambda row: row), jax.random.key(0)))
    after, metrics = update(agent, rows)
    actor, critic = jax.tree.map(lambda leaf: leaf.astype(np.float64), random)
    before, goal, _ = observations.astype(np.float64)
    assert float(metrics["train/critic_loss"]) == pytest.approx(numpy_critic_loss(critic, before, goal, action, form), rel=1e-5)
    assert float(metrics["train/actor_loss"]) == pytest.approx(numpy_actor_loss(actor, critic, before, goal), rel=1e-5)
    expected = (
        numpy_step(actor, lambda params: numpy_actor_loss(params, critic, before, goal)),
        numpy_step(critic, lambda params: numpy_critic_loss(params, before, goal, action, form)),
    )
    # Slopes of 0 but for rounding have either sign: a bias of psi that all logits of a row share.
    found = after.actor, after.critic
    jax.tree.map(lambda ours, theirs: np.testing.assert_allclose(ours, theirs, atol=2e-4), found, expected)


def test_forms_between_change_the_loss_or_the_networks_alone():
    for make_form, is_cold in ((contrastive_forms.nce_stabilised, True), (contrastive_forms.infonce_plain, False)):
        heads = make_form(setup(config())).init(jax.random.key(3)).critic
        assert ("normalization_0" in heads["sa"]) == is_cold
        assert (float(np.abs(heads["g"]["output"]["kernel"]).max()) < 2e-12) == is_cold
    # Three positives at 1, six negatives at -2, a mean each.
    logits = jnp.full((3, 3), -2.0) + 3.0 * jnp.eye(3)
    expected = np.log1p(np.exp(-1.0)) + np.log1p(np.exp(-2.0))
    assert float(contrastive_forms.balanced_loss(logits)) == pytest.approx(expected, rel=1e-5)


def test_goals_follow_geometrically():
    """Goals are sampled from a replay whose observations encode their episode and time."""
    horizon, episodes, discount = 6, 3, 0.7
    names = np.arange(episodes)[:, None] * 100.0 + np.arange(horizon + 2)
    observations = np.broadcast_to(names[..., None], (episodes, horizon + 2, 2)).astype(np.float32)
    rollout = Episodes(observations, observations[..., :1], np.zeros((episodes, horizon, ACTIONS), np.float32))
    chosen = config(batch_size=20_000, discount=discount, num_envs=episodes)
    replay = Replay(1, episodes, horizon)
    sampler = Sampler(chosen, resolve(chosen, horizon), replay, threshold=0.5)

    @jax.jit
    def sample(rollout, key):
        state = replay.of_rollout(rollout)
        return sampler.batch(state, sampler.choose(state, key, jnp.int32(0)))

    batch = sample(rollout, jax.random.key(2))
    before, goal = np.asarray(batch.observation_t[:, 0]), np.asarray(batch.goal[:, 0])
    assert (before // 100 == goal // 100).all()
    for time in range(horizon):
        ahead = (goal - before)[before % 100 == time]
        steps = np.arange(1, horizon - time + 1)
        expected = discount**steps / np.sum(discount**steps)
        shares = np.array([np.mean(ahead == step) for step in steps])
        assert np.isin(ahead, steps).all()
        np.testing.assert_allclose(shares, expected, atol=4 * 0.5 / np.sqrt(len(ahead)))


def test_the_last_step_is_its_only_goal_and_no_goal_lies_outside():
    time = jnp.array([9, 0, 0, 5], jnp.int32).repeat(1000)
    for discount in (0.01, 0.5, 0.999999):
        slots = np.asarray(choose_goal_slots(jax.random.key(0), time, 10, 1.0, 0.0, discount))
        assert (slots > time).all() and (slots <= 10).all() and (slots[:1000] == 10).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "indicator"}, "contrastive reads no rewards: leave out --method indicator"),
        ({"aux_tasks": ("egomotion",), "weighting": "sum"}, "contrastive has no auxiliary losses: leave out --aux-tasks"),
        ({"relabel_probability": 0.9}, "relabel_probability must be 1.0, not 0.9"),
        ({"future_goals": "even"}, "future_goals must be geometric, not even"),
        ({"balance_probability": 0.5}, "no balance_probability 0.5"),
        ({"random_shift": 1}, "recognise a goal by its shift, which its observation has, too: leave out --random-shift"),
    ],
)
def test_what_it_does_not_read_is_refused(changes, message):
    chosen = config(**changes)
    with pytest.raises(RequestError, match=message):
        make(setup(chosen.replace(aux_tasks=(), weighting="none"), config=chosen))


@pytest.mark.parametrize("name", ["fast", "cpu"])
def test_presets_of_image_tasks_shift_no_images_for_it(name):
    for env in ("VisualFetchReach", "VisualHandReach", "VisualPointMass"):
        assert preset(name, env=env, algorithm="contrastive").network.random_shift == 0


def test_devices_do_not_share_a_batch():
    with pytest.raises(RequestError, match="devices do not share"):
        make(setup(config(), shards=Shards(2)))


def test_its_options_are_of_no_other_algorithm():
    with pytest.raises(RequestError, match="contrastive_form is an option of --algorithm contrastive, and this is td3"):
        validate(preset("debug", algorithm="td3", contrastive_form="nce"))


LEARNING = {
    "algorithm": "contrastive",
    "num_envs": 16,
    "updates_per_iteration": 50,
    "batch_size": 64,
    "hidden_sizes": (64, 64),
    "replay_transitions": 4000,
    "normalizer_floor": 0.1,
    "eval_episodes": 64,
}


def test_it_learns_the_point_mass_with_several_seeds():
    env = point_mass.SimulatedStatePointMass(point_mass.PointMassConfig(horizon=10))
    program = make_train_step(env, preset("debug", **LEARNING, seeds=2))
    loop = begin(program, jax.random.split(jax.random.key(7), 2))
    for _ in range(8):
        loop, metrics = train_iteration(program, loop)
    assert (metrics["train/logit_following"] > metrics["train/logit_other"] + 5.0).all()
    outcome, _ = program.evaluate(loop.train, jax.random.key(11))
    assert (outcome["eval/success"] >= 0.9).all()


def test_it_learns_from_images():
    changes = {"encoder_filters": (8, 8), "normalizer_floor": 1.0, "encoders": "shared"}
    program = make_train_step(probes.SeenGoWhereTold(), preset("debug", **{**LEARNING, **changes}))
    loop = begin(program, jax.random.split(jax.random.key(7), 1))
    successes = []
    for _ in range(12):  # rounding, which depends on the processor, makes the success of any two iterations vary by a tenth
        for _ in range(2):
            loop, _ = train_iteration(program, loop)
        outcome, _ = program.evaluate(loop.train, jax.random.key(11))
        successes.append(float(outcome["eval/success"].min()))
        if successes[-1] >= 0.9:
            break
    assert successes[-1] >= 0.9, successes


def test_rewards_change_nothing():
    """Gradient steps are bit-identical for different rewards, whether or not a goal was reached."""
    agents = []
    for positive in (0.0, 5.0):
        program = make_train_step(probes.GoWhereTold(), preset("debug", algorithm="contrastive", reward_positive=positive))
        agents.append(jax.device_get(program.update_many(*update_arguments(program, jax.random.key(0)))[0]).agent)
    jax.tree.map(np.testing.assert_array_equal, *agents)
