"""Rollouts: whole episodes of the current policy, with all environments in lockstep.

reset S x E environments (each renders its goal image once)
scan over T:  act -> advance -> observe        observations [T, S, E, ...], each kept once
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.acting.rollout_parts import RolloutPart
from jaxrl_vis.learner.algorithm import Algorithm
from jaxrl_vis.learner.parallel.shards import ONE, Shards
from jaxrl_vis.types import Episodes, Metrics, TrainState
from jaxrl_vis_envs.base import GoalEnv, State

RandomSource = Shards | RolloutPart
"""Source of random numbers for the environments of a call: all of a learner's, those of one device, or those of one part."""

# Folded into keys for observation noise, so that it changes no other random numbers.
_FIRST_NOISE, _GOAL_NOISE, _STEP_NOISE = 0x6E6F30, 0x6E6F31, 0x6E6F32


class Exploration(NamedTuple):
    """Exploration noise of actions; none by default.

    Attributes:
        random_action_probability: Probability that an action vector is replaced by a uniformly sampled one; float or [].
        action_noise: Standard deviation of the Gaussian noise on the others; float or [].
    """

    random_action_probability: float | jax.Array = 0.0
    action_noise: float | jax.Array = 0.0

    @property
    def is_none(self) -> bool:
        """True if there is certainly no noise; False for traced values, which are unknown."""
        return all(isinstance(value, float | int) and value == 0 for value in self)


NO_EXPLORATION = Exploration()


class Acting(NamedTuple):
    """Environment, and the algorithm whose agents act in it.

    Attributes:
        env: The environment.
        algorithm: Algorithm of the agents.
        observation_noise: Standard deviation of the camera's noise, in the observation's unit.
        observe_state: Function from `State.data` to `Episodes.full_states` of one step; None to collect none.
    """

    env: GoalEnv
    algorithm: Algorithm
    observation_noise: float = 0.0
    observe_state: Callable[[Any], jax.Array] | None = None


def explore(action: jax.Array, exploration: Exploration, key: jax.Array, random_source: RandomSource = ONE) -> jax.Array:
    """Add exploration noise to actions, if there is any: [E, A] float32 in [-1, 1].

    Args:
        action: [E, A] float32 in [-1, 1], the policy's actions.
        exploration: Exploration noise.
        key: [] typed key for the noise.
        random_source: Source of random numbers for these environments.
    """
    if exploration.is_none:
        return action
    noise_key, random_key = jax.random.split(key)
    noise = random_source.draw(lambda shape: jax.random.normal(noise_key, shape), action.shape)
    action = jnp.clip(action + exploration.action_noise * noise, -1.0, 1.0)
    # One sample determines both whether an action is random, and its value.
    drawn = random_source.draw(lambda shape: jax.random.uniform(random_key, shape), (*action.shape[:-1], 1 + action.shape[-1]))
    is_random = drawn[..., :1] < exploration.random_action_probability
    return jnp.where(is_random, 2.0 * drawn[..., 1:] - 1.0, action)


def split_keys(keys: jax.Array, num_envs: int, random_source: RandomSource = ONE) -> tuple[jax.Array, jax.Array]:
    """Split the keys of a rollout [S] into keys of all resets [S * E], seed by seed, and keys of the policies [S]."""
    reset_keys, policy_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
    return jax.vmap(lambda key: random_source.split(key, num_envs))(reset_keys).reshape(-1), policy_keys


def add_noise(key: jax.Array, observations: jax.Array, deviation: float, random_source: RandomSource = ONE) -> jax.Array:
    """Add camera noise to observations [E, ...]: same shape and dtype; bytes are rounded and clipped.

    Args:
        key: [] typed key.
        observations: uint8 images or float32 state vectors.
        deviation: Standard deviation of the noise, in the observation's unit.
        random_source: Source of random numbers for these environments.
    """
    noisy = observations + deviation * random_source.noise(key, observations.shape)
    if observations.dtype == jnp.uint8:
        noisy = jnp.clip(jnp.round(noisy), 0.0, 255.0)
    return noisy.astype(observations.dtype)


class Rollout(NamedTuple):
    """Result of `play`.

    Attributes:
        episodes: [S, K, ...] kept episodes.
        outcome: [S, E] by name, metrics (`GoalEnv.metric_names`) of all episodes at their last step.
        record: [S, K, T+1, ...] results of ``record`` for the kept episodes' states after 0, 1, ..., T steps; None without
            this function.
    """

    episodes: Episodes
    outcome: Metrics
    record: Any


def _episode_major(*arrays: jax.Array) -> jax.Array:
    """Concatenate arrays [steps, S, K, ...] along time, and move that axis behind the episodes: [S, K, all steps, ...]."""
    return jnp.moveaxis(jnp.concatenate(arrays), 0, 2)


def play(
    acting: Acting,
    train: TrainState,
    keys: jax.Array,
    num_envs: int,
    exploration: Exploration = NO_EXPLORATION,
    num_kept: int | None = None,
    record: Callable[[State], Any] | None = None,
    random_source: RandomSource = ONE,
) -> Rollout:
    """Roll out one episode in each of E environments, for each of S learners in parallel.

    Seeds and environments share one axis of S x E environments: one `jax.vmap` less halves the time to trace.

    Args:
        acting: Environment and algorithm.
        train: [S, ...] learners.
        keys: [S] typed keys of this rollout.
        num_envs: E, number of environments per learner in this call.
        exploration: Exploration noise.
        num_kept: K, number of episodes to keep (the first ones); None for all.
        record: Function of the state of one environment that returns a pytree to record, after reset and after each step; None
            to record nothing.
        random_source: Source of random numbers for these environments.
    """
    env, algorithm, deviation, observe_state = acting
    num_seeds = keys.shape[0]

    def by_seed(leaf: jax.Array) -> jax.Array:
        return leaf.reshape(num_seeds, num_envs, *leaf.shape[1:])

    def stored(leaf: jax.Array) -> jax.Array:
        return by_seed(leaf)[:, :num_kept]

    def perturb(observations: jax.Array, keys: jax.Array, number: int) -> jax.Array:
        # Noise is sampled once per frame and stored with it, so that a frame equals itself when it becomes a goal.
        if not deviation:
            return observations
        noise_keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, number)
        noisy = jax.vmap(lambda key, part: add_noise(key, part, deviation, random_source))(noise_keys, by_seed(observations))
        return noisy.reshape(observations.shape)

    def recorded(state: State) -> tuple[jax.Array | None, Any]:
        full_state = None if observe_state is None else jax.vmap(observe_state)(state.data)
        return jax.tree.map(stored, (full_state, None if record is None else jax.vmap(record)(state)))

    reset_keys, policy_keys = split_keys(keys, num_envs, random_source)
    state = jax.vmap(env.reset)(reset_keys)
    assert state.obs is not None
    first_observation = perturb(state.obs["observation"], policy_keys, _FIRST_NOISE)
    goal = perturb(state.obs["desired_goal"], policy_keys, _GOAL_NOISE)
    first_state, first_records = state.achieved_state, recorded(state)
    policies = jax.vmap(algorithm.policy_params)(train.agent, train.statistics)
    encoded_goals = jax.vmap(algorithm.encode_goal)(policies, by_seed(goal))

    def act(policy: Any, encoded_goal: Any, key: jax.Array, observations: jax.Array) -> jax.Array:
        return explore(algorithm.act(policy, observations, encoded_goal), exploration, key, random_source)

    def step(carry, step_keys):
        state, observation = carry
        action = jax.vmap(act)(policies, encoded_goals, step_keys, by_seed(observation)).reshape(num_seeds * num_envs, -1)
        state = jax.vmap(env.advance)(state, action)
        observation = perturb(jax.vmap(env.observe)(state), step_keys, _STEP_NOISE)
        step_results = tuple(stored(leaf) for leaf in (observation, state.achieved_state, action))
        return (state, observation), (step_results, recorded(state))

    carry = (state.replace(obs=None), first_observation)
    step_keys = jax.vmap(lambda key: jax.random.split(key, env.horizon), out_axes=1)(policy_keys)
    (state, _), ((observations, states, actions), records) = jax.lax.scan(step, carry, step_keys)
    outcome = {name: by_seed(state.metrics[name]) for name in env.metric_names}
    full_states, record_of_all = jax.tree.map(lambda first, rest: _episode_major(first[None], rest), first_records, records)
    episodes = Episodes(
        observations=_episode_major(stored(first_observation)[None], observations, stored(goal)[None]),
        states=_episode_major(stored(first_state)[None], states, stored(state.goal_state)[None]),
        actions=jnp.moveaxis(actions, 0, 2),
        full_states=full_states,
    )
    return Rollout(episodes, outcome, record_of_all)
