"""Replay and relabelling, on episodes in which every entry encodes its episode and slot."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrl_vis.learner.memory.relabel import choose_goal_slots
from jaxrl_vis.learner.memory.replay import make_replay, num_bytes, pack, unpack
from jaxrl_vis.types import Episodes

HORIZON, ENVS = 5, 3


def encoded_rollout(first_episode: int) -> Episodes:
    """Return episodes whose frames, states and actions hold (episode id, slot)."""
    episode = jnp.arange(first_episode, first_episode + ENVS)
    slots = jnp.arange(HORIZON + 2)
    both = jnp.stack(jnp.broadcast_arrays(episode[:, None], slots[None]), axis=-1)  # [E, T+2, 2]
    frames = jnp.broadcast_to(both[..., None, None], (ENVS, HORIZON + 2, 2, 4, 4)).astype(jnp.uint8)
    return Episodes(observations=frames, states=both.astype(jnp.float32), actions=both[:, :HORIZON].astype(jnp.float32))


@pytest.mark.parametrize("width", [8, 6])
def test_images_come_back_byte_for_byte(width):
    frames = jax.random.bits(jax.random.key(0), (2, HORIZON + 2, 3, 5, width), jnp.uint8)
    packed = pack(frames)
    assert packed.nbytes == frames.nbytes
    assert packed.dtype == (jnp.uint32 if width % 4 == 0 else jnp.uint8)
    np.testing.assert_array_equal(unpack(packed), frames)


def filled(rollouts: int, capacity: int = 3):
    replay = make_replay(capacity * ENVS * HORIZON, ENVS, HORIZON)
    state = replay.init(jax.ShapeDtypeStruct((2, 4, 4), jnp.uint8), goal_state_size=2, action_size=2)
    insert = jax.jit(replay.insert, donate_argnums=0)
    for iteration in range(rollouts):
        state = insert(state, encoded_rollout(iteration * ENVS), iteration)
    return replay, state


def test_a_goal_may_be_another_episodes():
    replay, state = filled(3)
    indices = replay.sample_indices(state, jax.random.key(0), jnp.int32(2), 200)
    other = jnp.roll(indices.episode, 1)
    batch = replay.gather(state, indices, indices.time + 1, goal_episode=other)
    np.testing.assert_array_equal(batch.goal[:, 0, 0, 0], other)
    np.testing.assert_array_equal(batch.goal[:, 1, 3, 3], indices.time + 1)
    np.testing.assert_array_equal(batch.goal_state, np.stack([other, indices.time + 1], axis=-1))
    np.testing.assert_array_equal(batch.observation_t[:, 0, 0, 0], indices.episode)


@pytest.mark.parametrize("rollouts", [1, 2, 3, 4, 8])
def test_samples_are_whole_and_from_what_is_stored(rollouts):
    replay, state = filled(rollouts)
    indices = replay.sample_indices(state, jax.random.key(0), jnp.int32(rollouts - 1), 4000)
    goal_slot = choose_goal_slots(jax.random.key(1), indices.time, HORIZON, 0.8, 0.3)
    batch = replay.gather(state, indices, goal_slot)
    episode, slot = np.asarray(batch.action).T
    # The newest rollouts and no others, each of their transitions.
    oldest = max(0, rollouts - 3) * ENVS
    expected = {(e, t) for e in range(oldest, rollouts * ENVS) for t in range(HORIZON)}
    assert set(zip(episode.astype(int), slot.astype(int), strict=True)) == expected
    # Everything of a transition comes from one episode, and from its own instants.
    for frames, expected_slot in (
        (batch.observation_t, slot),
        (batch.observation_tp1, slot + 1),
        (batch.goal, np.asarray(goal_slot)),
    ):
        assert frames.dtype == jnp.uint8
        np.testing.assert_array_equal(frames[:, 0, 0, 0], episode)
        np.testing.assert_array_equal(frames[:, 1, 3, 3], expected_slot)
    np.testing.assert_array_equal(batch.state_tp1, np.stack([episode, slot + 1], axis=-1))
    np.testing.assert_array_equal(batch.goal_state, np.stack([episode, np.asarray(goal_slot)], axis=-1))


def test_transitions_are_sampled_evenly():
    replay, state = filled(4)
    indices = replay.sample_indices(state, jax.random.key(0), jnp.int32(3), 90_000)
    counts = np.bincount(np.asarray(indices.episode) * HORIZON + np.asarray(indices.time), minlength=45)
    # 2,000 expected in each of 45 cells; 5 standard deviations.
    assert np.all(np.abs(counts - 2000) < 5 * np.sqrt(2000))


@pytest.mark.parametrize("rollouts", [2, 8])
def test_older_transitions_are_sampled_as_seldom_as_asked_for(rollouts):
    """Probabilities decrease exponentially with age among stored episodes, as if each new episode replaced a random one."""
    capacity, mean_age = 6, 2
    replay = make_replay(capacity * ENVS * HORIZON, ENVS, HORIZON, mean_age=mean_age * ENVS * HORIZON)
    state = replay.init(jax.ShapeDtypeStruct((2, 4, 4), jnp.uint8), goal_state_size=2, action_size=2)
    for iteration in range(rollouts):
        state = replay.insert(state, encoded_rollout(iteration * ENVS), jnp.int32(iteration))
    indices = replay.sample_indices(state, jax.random.key(0), jnp.int32(rollouts - 1), 50_000)
    batch = replay.gather(state, indices, indices.time + 1)
    age = rollouts - 1 - np.asarray(batch.action)[:, 0] // ENVS
    shares = np.exp(-np.arange(min(rollouts, capacity)) / mean_age)
    found = np.bincount(age.astype(int), minlength=len(shares)) / len(age)
    np.testing.assert_allclose(found, shares / shares.sum(), atol=0.01)


def test_after_an_emptied_ring_only_new_episodes_are_sampled():
    """Resuming without the replay restores the iteration but starts with an empty ring."""
    replay, state = filled(0)
    state = replay.insert(state, encoded_rollout(40), jnp.int32(7))
    indices = replay.sample_indices(state, jax.random.key(0), jnp.int32(7), 200)
    batch = replay.gather(state, indices, indices.time + 1)
    assert set(np.asarray(batch.action)[:, 0]) == {40.0, 41.0, 42.0}


def test_an_episode_takes_one_frame_a_step_and_two_more():
    """A transition takes at most (T+2)/T frames and 64 bytes."""
    replay = make_replay(1000, 4, 50)
    image = jax.ShapeDtypeStruct((4, 64, 64), jnp.uint8)
    per_transition = num_bytes(replay.spec(image, 3, 4)) / (replay.num_episodes * 50)
    assert per_transition <= 64 * 64 * 4 * 52 / 50 + 64


def test_relabelled_slots_stay_in_the_future_and_have_their_shares():
    time = jnp.tile(jnp.arange(HORIZON), 20_000)
    slots = np.asarray(choose_goal_slots(jax.random.key(0), time, HORIZON, 0.9, 0.5))
    time = np.asarray(time)
    original = slots == HORIZON + 1
    assert np.all(slots > time) and np.all(slots <= HORIZON + 1)
    assert abs(original.mean() - 0.1) < 0.005
    # The next slot: p1 p2 for certain, and p1 (1 - p2) / (T - t) by chance.
    for step in range(HORIZON):
        at_step = time == step
        expected = 0.45 + 0.45 / (HORIZON - step)
        assert abs((slots[at_step] == step + 1).mean() - expected) < 0.015
        for later in range(step + 2, HORIZON + 1):
            assert abs((slots[at_step] == later).mean() - 0.45 / (HORIZON - step)) < 0.015


def test_no_relabelling_keeps_the_original_goal():
    slots = choose_goal_slots(jax.random.key(0), jnp.arange(HORIZON), HORIZON, 0.0, 0.5)
    np.testing.assert_array_equal(slots, HORIZON + 1)
