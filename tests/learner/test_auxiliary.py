"""Auxiliary losses inside the learner: which parameters they reach, how they are weighted, and what is refused."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrl_vis.config import preset, validate
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner import auxtasks
from jaxrl_vis.learner.auxtasks import optical_flow
from jaxrl_vis.learner.auxtasks.auxiliary import Auxiliary, make_auxiliary
from jaxrl_vis.learner.ddpg.ddpg import make_ddpg
from jaxrl_vis.learner.memory.replay import Indices, Replay
from jaxrl_vis.learner.memory.sampling import Choice, Sampler
from jaxrl_vis.learner.networks import normalizer
from jaxrl_vis.learner.networks.networks import Networks
from jaxrl_vis.learner.resolved import resolve
from jaxrl_vis.types import Episodes, Statistics
from jaxrl_vis.weighting import make_weighting

SPEC = jax.ShapeDtypeStruct((2, 16, 16), jnp.uint8)
ACTIONS, HORIZON, EPISODES, BATCH = 2, 6, 4, 16
ALL = auxtasks.NAMES


@functools.cache
def rollout() -> Episodes:
    return _rollout(jax.random.key(0))


@jax.jit
def _rollout(key: jax.Array) -> Episodes:
    """Return episodes of a bright spot that actions move over a fixed pattern."""
    keys = jax.random.split(key, 3)
    actions = jax.random.uniform(keys[0], (EPISODES, HORIZON, ACTIONS), minval=-1.0, maxval=1.0)
    places = jnp.cumsum(jnp.pad(2.0 * actions, ((0, 0), (1, 1), (0, 0))), axis=1) + 8.0
    grid = jnp.stack(jnp.meshgrid(jnp.arange(16.0), jnp.arange(16.0), indexing="ij"))
    distance = jnp.sum(jnp.square(grid - places[..., None, None]), axis=2)
    spot = 200.0 * jnp.exp(-distance / 6.0)
    images = jnp.stack([spot, jnp.broadcast_to(10.0 * grid[0], spot.shape)], axis=2)
    return Episodes(images.astype(jnp.uint8), places.astype(jnp.float32), actions)


def config(**overrides):
    return validate(preset("debug", batch_size=BATCH, updates_per_iteration=10, compute_dtype="float32", **overrides))


@functools.cache
def drawn_places():
    """Return random episodes and slots of a batch, [2, B]."""
    return jax.device_get(jax.random.randint(jax.random.key(1), (2, BATCH), 0, EPISODES))


@functools.cache
def stored(with_flow):
    """Return the rollout as stored by a learner that learns optical flow, or by one that does not."""
    if not with_flow:
        return rollout()
    auxiliary = make_auxiliary(config(aux_tasks=("optical_flow",), weighting="sum"), SPEC, ACTIONS, 1, jnp.float32)
    return jax.jit(auxiliary.with_stored)(rollout())


@functools.cache
def fresh(tasks, encoders, target_encoder, filters):
    """Return a fresh learner with any weighting, because weightings change nothing else at initialisation."""
    networks = {"encoders": encoders, "target_encoder": target_encoder, "encoder_filters": filters}
    chosen = config(aux_tasks=tasks, weighting="sum" if tasks else "none", **networks)
    algorithm = make_ddpg(Networks(chosen, SPEC, ACTIONS, 0.0), chosen, resolve(chosen, HORIZON))
    # Not as a program: operation by operation, what is drawn in one size is compiled once for all of these learners.
    return algorithm.init(jax.random.key(3))


@functools.cache
def learner(mode=None, **overrides):
    """Return a learner, its update as a compiled function, and its initial state and batch."""
    chosen = config(**overrides)
    networks = Networks(chosen, SPEC, ACTIONS, 0.0)
    auxiliary = make_auxiliary(chosen, SPEC, ACTIONS, 1, networks.dtype)
    auxiliary = auxiliary if mode is None else dataclasses.replace(auxiliary, gradient_mode=mode)
    resolved = resolve(chosen, HORIZON)
    algorithm = make_ddpg(networks, chosen, resolved, auxiliary)
    replay = Replay(1, EPISODES, HORIZON)
    sampler = Sampler(chosen, resolved, replay, 0.5, auxiliary=auxiliary)

    @jax.jit
    def chosen_batch(episodes, places, key):
        choice = Choice(Indices(places[0], places[1]), jnp.full(BATCH, HORIZON + 1), target_key=key)
        if not auxiliary.tasks:
            choice = choice._replace(target_key=None)
        return sampler.batch(replay.of_rollout(episodes), choice)

    @functools.partial(jax.jit, static_argnums=2)
    def update(working, batch, with_actor=True):
        gradients, metrics = algorithm.gradients(working, algorithm.prepare(working, batch), with_actor)
        return algorithm.apply(working, gradients), gradients, metrics

    batch = chosen_batch(stored("optical_flow" in auxiliary.tasks), drawn_places(), jax.random.key(2))
    start = fresh(
        chosen.auxiliary.aux_tasks, chosen.network.encoders, chosen.network.target_encoder, chosen.network.encoder_filters
    )
    start = start.replace(weighting=auxiliary.init_state(start.critic, jax.random.key(3)))
    return algorithm, update, algorithm.begin(start, Statistics(normalizer.init(SPEC), None)), batch


def magnitudes(tree):
    """Return the root mean square of each part, averaged over its leaves."""
    return {
        name: float(np.sqrt(np.mean([np.mean(np.square(x)) for x in jax.tree.leaves(part)]))) for name, part in tree.items()
    }


def test_every_auxiliary_loss_is_learned_and_reaches_both_encoders():
    _, update, working, batch = learner(aux_tasks=ALL, weighting="balance")
    _, gradients, first = update(working, batch)
    for network in (gradients.critic, gradients.actor):
        assert set(network) == {"encoder", "head", "heads"} and set(network["heads"]) == set(ALL)
        assert all(size > 0 for part in (network, network["heads"]) for size in magnitudes(part).values())
    for _ in range(60):
        working, _, last = update(working, batch)
    for name in ALL:
        assert last[f"train/loss/{name}"] < 0.9 * first[f"train/loss/{name}"], name
    assert set(working.agent.target_critic) == {"encoder", "head"}


def test_a_weighted_gradient_is_the_sum_of_the_losses_own():
    """With fixed weights, the gradient with two tasks is the sum of those with one task each, less that without tasks."""
    found = {}
    for tasks in ((), ("inverse_dynamics",), ("egomotion",), ("inverse_dynamics", "egomotion")):
        weighting = {"weighting": "fixed", "weighting_fixed": 3.0} if tasks else {"weighting": "none_log"}
        _, update, working, batch = learner(aux_tasks=tasks, **weighting)
        _, gradients, _ = update(working, batch, False)
        found[tasks] = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(gradients.critic["encoder"])])
    one, other, both = found[("inverse_dynamics",)], found[("egomotion",)], found[("inverse_dynamics", "egomotion")]
    np.testing.assert_allclose(both, one + other - found[()], rtol=1e-3, atol=1e-5 * np.abs(both).max())
    assert np.abs(both - found[()]).max() > 0.1 * np.abs(both).max()


def test_both_ways_to_gradients_agree():
    settings = {"aux_tasks": ("forward_dynamics", "egomotion"), "weighting": "ol_aux"}
    _, update, working, batch = learner("per_loss", **settings)
    _, other_update, _, _ = learner(**settings)
    one, other = update(working, batch), other_update(working, batch)
    for left, right in zip(jax.tree.leaves(one[1:]), jax.tree.leaves(other[1:]), strict=True):
        np.testing.assert_allclose(left, right, rtol=2e-3, atol=1e-5)


def test_targets_move_with_the_images_whoever_makes_them(monkeypatch):
    """Results are equal for images shifted one by one and for the patches of the GPU's kernels, here without a GPU."""
    settings = {
        "aux_tasks": ("autoencoder", "optical_flow", "egomotion"),
        "weighting": "ol_aux",
        "encoder_filters": (16, 16, 16),
    }
    found = {}
    for random_shift, uses_kernel in ((0, False), (3, False), (3, True)):
        monkeypatch.setattr(Networks, "uses_kernel", uses_kernel)
        learner.cache_clear()
        _, update, working, batch = learner(**settings, random_shift=random_shift)
        shift = jnp.arange(2 * BATCH).reshape(BATCH, 2) % 7 - 3
        _, gradients, metrics = update(working, batch.replace(shift=shift if random_shift else None))
        found[random_shift, uses_kernel] = jax.device_get((gradients.critic, metrics))
    for left, right in zip(jax.tree.leaves(found[3, True]), jax.tree.leaves(found[3, False]), strict=True):
        np.testing.assert_allclose(left, right, rtol=5e-3, atol=2e-5)
    for name in ("autoencoder", "optical_flow"):
        assert found[0, False][1][f"train/loss/{name}"] != found[3, False][1][f"train/loss/{name}"]


def test_weights_move_every_so_many_updates():
    _, update, working, batch = learner(aux_tasks=("inverse_dynamics",), weighting="ol_aux", weighting_interval=5)
    seen = []
    for _ in range(11):
        working, _, metrics = update(working, batch)
        seen.append(float(metrics["train/weight/inverse_dynamics"]))
    assert seen[:5] == [1.0] * 5 and seen[5] != 1.0
    assert len(set(seen[5:10])) == 1 and seen[10] != seen[5]


@pytest.mark.parametrize("mode", ["per_loss", "latents"])
def test_heads_of_both_networks_learn_while_their_losses_are_kept_out_of_the_encoders(mode):
    tasks = {"aux_tasks": ("inverse_dynamics",)}
    _, update, working, batch = learner(mode, **tasks, weighting="ol_aux", weighting_heads="always")
    weights = {**working.agent.weighting.weights, "inverse_dynamics": jnp.zeros(())}
    state = working.agent.weighting.replace(weights=weights)
    working = working._replace(agent=working.agent.replace(weighting=state))
    _, always, _ = update(working, batch)
    _, balanced, start, _ = learner(**tasks, weighting="balance")
    _, ones, _ = balanced(start, batch)
    for found, one in ((always.critic, ones.critic), (always.actor, ones.actor)):
        for left, right in zip(jax.tree.leaves(found["heads"]), jax.tree.leaves(one["heads"]), strict=True):
            np.testing.assert_allclose(left, right, rtol=1e-4, atol=1e-6)
        assert magnitudes(found["heads"])["inverse_dynamics"] > 0
    _, update, start, _ = learner(mode, **tasks, weighting="ol_aux")
    _, weighted, _ = update(start._replace(agent=start.agent.replace(weighting=state)), batch)
    for found, one in ((always.critic, weighted.critic), (always.actor, weighted.actor)):
        for left, right in zip(jax.tree.leaves(found["encoder"]), jax.tree.leaves(one["encoder"]), strict=True):
            np.testing.assert_allclose(left, right, rtol=1e-4, atol=1e-6)
        assert magnitudes(one["heads"])["inverse_dynamics"] == 0


def test_the_ablation_compares_gradients_of_held_parameters():
    settings = {"aux_tasks": ("inverse_dynamics",), "weighting_interval": 5}
    _, update, working, batch = learner(**settings, weighting="ol_aux_ablation")
    # On the same batch five times, its mean is the gradient at the beginning, which OL-AUX-1 has in its first update.
    for _ in range(6):
        working, _, metrics = update(working, batch)
    _, one_step, start, _ = learner(
        aux_tasks=("inverse_dynamics",), weighting="ol_aux", weighting_interval=1, weighting_beta=25.0
    )
    start, _, _ = one_step(start, batch)
    _, _, expected = one_step(start, batch)
    np.testing.assert_allclose(metrics["train/weight/inverse_dynamics"], expected["train/weight/inverse_dynamics"], rtol=1e-4)
    assert metrics["train/weight/inverse_dynamics"] != 1.0


def test_an_actor_that_shares_the_encoder_has_no_heads():
    shared = {"encoders": "shared", "target_encoder": False}
    _, update, working, batch = learner(aux_tasks=("inverse_dynamics",), weighting="balance", **shared)
    _, gradients, metrics = update(working, batch)
    assert set(gradients.actor) == {"head"} and set(gradients.critic) == {"encoder", "head", "heads"}
    assert np.isfinite(metrics["train/actor_loss"])


def test_kept_flow_is_that_of_the_images():
    episodes = jax.device_get(stored(True))
    (flow,) = episodes.stored.values()
    assert flow.shape == (EPISODES, HORIZON, 16, 16) and flow.dtype == jnp.uint8
    images = episodes.observations
    wanted = jax.jit(optical_flow.flow_strength)(images[1, 2:4])[0]
    np.testing.assert_allclose(optical_flow.from_bytes(flow[1, 2]), np.clip(wanted, 0.0, 255 / 16), atol=1 / 32 + 1e-4)
    assert wanted.max() > 0.5
    _, _, _, batch = learner(aux_tasks=("optical_flow",), weighting="sum")
    place = drawn_places()[:, 3]
    np.testing.assert_array_equal(batch.targets["optical_flow"][3], optical_flow.from_bytes(flow[place[0], place[1]]))


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"aux_tasks": ("egomotion",)}, "weighting none learns none: choose --weighting ol_aux"),
        ({"weighting": "ol_aux"}, "has no auxiliary tasks to weight: add --aux-tasks"),
        (
            {"weighting": "ol_aux", "aux_tasks": ("egomotion",), "weighting_interval": 3},
            "weighting_interval (3) must divide updates_per_iteration (10)",
        ),
        ({"weighting": "balance", "aux_tasks": ("egomotion",), "n_step": 2}, "n_step and aux_tasks exclude"),
        (
            {"weighting": "balance", "aux_tasks": ("egomotion",), "weighting_task_eps": (0.1, 0.2)},
            "weighting_task_eps has 2 values for 1 aux_tasks: give one for each",
        ),
        ({"weighting_cosines": True}, "weighting_cosines compares auxiliary losses, and there are none"),
        (
            {"weighting": "moco", "aux_tasks": ("egomotion",), "weighting_cosines": True},
            "weighting moco needs whole gradients, and its cosines are not logged",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(overrides, words):
    with pytest.raises(RequestError) as caught:
        make_auxiliary(config(**overrides), SPEC, ACTIONS, 1, jnp.float32)
    assert words in str(caught.value) and "\n" not in str(caught.value)


TWO = ("inverse_dynamics", "forward_dynamics")


@pytest.mark.parametrize("weighting", ["mgda", "famo", "gradnorm", "pcgrad", "moco"])
def test_a_weighting_of_any_kind_trains_both_networks(weighting):
    """Weightings use a Gramian, losses, learned gradient lengths, random orders, or tracked gradients."""
    _, update, working, batch = learner(aux_tasks=TWO, weighting=weighting)
    for _ in range(2):
        before, (working, gradients, metrics) = working, update(working, batch)
    for network in (gradients.critic, gradients.actor):
        assert all(size > 0 for size in magnitudes(network).values()) and all(np.isfinite(list(magnitudes(network).values())))
    assert all(np.isfinite(value).all() for value in jax.tree.leaves(metrics))
    assert {f"train/weight/{name}" for name in ("main", *TWO)} <= set(metrics)
    assert jax.tree.structure(before.agent.weighting) == jax.tree.structure(working.agent.weighting)


def test_both_ways_to_a_gramian_train_alike():
    found = []
    for mode in ("per_loss", "latents"):
        _, update, working, batch = learner(mode=mode, aux_tasks=TWO, weighting="upgrad")
        found.append(update(working, batch)[1])
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=2e-3, atol=2e-5), *found)


def test_a_main_loss_that_is_like_the_others_is_weighted_in_both_networks():
    """`uniform` yields a third of the sum's gradients; where weights are for encoders alone, heads learn as with the sum."""
    found = {}
    for weighting in ("sum", "uniform", "mgda"):
        _, update, working, batch = learner(aux_tasks=TWO, weighting=weighting)
        found[weighting] = update(working, batch)[1]

    def assert_same(one, other):
        """Compare up to the rounding of each array's largest numbers."""
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-5 * np.abs(one).max())

    of_sum, uniform = ((found[name].critic, found[name].actor) for name in ("sum", "uniform"))
    jax.tree.map(lambda one, other: assert_same(one, 3.0 * other), of_sum, uniform)
    for part in ("head", "heads"):
        for network in ("critic", "actor"):
            one, other = (getattr(found[name], network)[part] for name in ("sum", "mgda"))
            jax.tree.map(assert_same, one, other)
    assert magnitudes(found["mgda"].actor)["encoder"] < magnitudes(found["sum"].actor)["encoder"]


def test_learners_draw_apart():
    auxiliary = make_auxiliary(config(aux_tasks=TWO, weighting="random"), SPEC, ACTIONS, 1, jnp.float32)
    states = [auxiliary.init_state({"encoder": jnp.zeros(2)}, jax.random.key(seed)) for seed in (0, 1)]
    losses = dict.fromkeys(("main", *TWO), jnp.ones(()))
    one, other = (auxiliary.weighting.update(losses, None, state)[0]["main"] for state in states)
    assert float(one) != float(other)


def test_weights_are_bounded_and_scaled_and_cosines_logged_where_asked():
    options = {"weighting_maximum": 0.5, "weighting_total": 2.0, "weighting_cosines": True, "weighting_log": True}
    _, update, working, batch = learner(aux_tasks=TWO, weighting="nash_mtl", weighting_task_eps=(0.1, 0.2), **options)
    _, _, metrics = update(working, batch)
    weights = [float(metrics[f"train/weight/{name}"]) for name in ("main", *TWO)]
    np.testing.assert_allclose(sum(weights), 2.0, rtol=1e-4)
    assert -1.0 <= metrics["train/cosine/least"] <= metrics[f"train/cosine/{TWO[0]}"] <= 1.0
    auxiliary = make_auxiliary(
        config(aux_tasks=TWO, weighting="balance", weighting_task_eps=(0.1, 0.2)), SPEC, ACTIONS, 1, jnp.float32
    )
    slopes = auxiliary.weighting.slopes(dict.fromkeys(("main", *TWO), jnp.ones(())))
    np.testing.assert_allclose([slopes[name] for name in TWO], [1 / 1.1, 1 / 1.2], rtol=1e-6)


def test_states_have_no_auxiliary_tasks():
    state = jax.ShapeDtypeStruct((3,), jnp.float32)
    with pytest.raises(RequestError, match="choose a task that shows images"):
        make_auxiliary(config(aux_tasks=("egomotion",), weighting="balance"), state, ACTIONS, 1, jnp.float32)


def test_an_actor_learns_the_logarithm_of_its_distance_from_the_best_value():
    """Log losses are defined for any rewards: with +1/-1, values reach R+/(1 - gamma), not 0."""
    _, update, working, batch = learner(weighting="none_log", reward_positive=1.0)
    _, _, metrics = update(working, batch)
    resolved = resolve(config(reward_positive=1.0), HORIZON)
    best = resolved.reward_positive / (1.0 - resolved.discount)
    penalty = float(metrics["train/action_size"]) ** 2
    # The critic is fresh: all values are near 0.
    np.testing.assert_allclose(metrics["train/actor_loss"] - penalty, np.log(best), atol=0.2)


def test_an_actor_learns_the_logarithm_of_value_and_penalty_together_where_asked():
    weight = 1e6
    _, update, working, batch = learner(weighting="none_log", actor_log="loss", action_penalty=weight)
    _, _, metrics = update(working, batch)
    penalty = weight * float(metrics["train/action_size"]) ** 2
    assert penalty > 1000.0  # else the value, which is near 0 here, would matter
    np.testing.assert_allclose(metrics["train/actor_loss"], np.log(penalty), atol=0.2)


def test_a_head_begins_alike_wherever_its_task_stands_in_the_list():
    """Keys of built-in heads depend neither on the order of tasks nor on user-defined ones, so that runs stay reproducible."""
    key = jax.random.key(3)
    made = list(auxtasks.make([*reversed(ALL)], auxtasks.Spec(SPEC, ACTIONS, 8)).values())
    new = [auxtasks.AuxTask(name, made[0].init, lambda *_: 0.0, lambda *_: 0.0) for name in ("new_one", "another")]
    tasks = {task.name: task._replace(init=lambda key: {"key": jax.random.key_data(key)}) for task in (new[0], *made, new[1])}
    heads = Auxiliary(tasks, make_weighting("balance")).init_heads(key)
    for number, name in enumerate(ALL):
        np.testing.assert_array_equal(heads[name]["key"], jax.random.key_data(jax.random.fold_in(key, number)))
    assert len({tuple(head["key"].tolist()) for head in heads.values()}) == 7
