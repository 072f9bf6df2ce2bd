"""Images, goal images and true distances of a task, without a trained policy.

play         episodes of slowly changing random actions
make_pairs   images of episodes paired with goals: their own last image, that of another episode, and the goal that was given
search       for each of several goals, the random sequence of actions with the highest reward: can the reward be exploited?
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxrl_vis_envs
from jaxrl_vis_envs import goals as truth
from jaxrl_vis_envs.base import GoalEnv

_PERSISTENCE = 0.8  # autocorrelation of successive actions

Reward = Callable[[jax.Array, jax.Array], jax.Array]
"""(images [B, C, H, W] uint8, goal images of the same shape) -> rewards [B] float32 between 0 and 1."""


class Episodes(NamedTuple):
    """E episodes of T steps.

    Attributes:
        images: [E, T+1, C, H, W] uint8, observations.
        states: [E, T+1, G] float32, true states.
        goals: [E, C, H, W] uint8, goal images that were given.
        goal_states: [E, G] float32, true states of these goals.
    """

    images: Any
    states: Any
    goals: Any
    goal_states: Any


class Pairs(NamedTuple):
    """N pairs of an image and a goal image.

    Attributes:
        images, goals: [N, C, H, W] uint8.
        distance: [N] float32, true distance, in the task's unit.
    """

    images: Any
    goals: Any
    distance: Any


class SearchResult(NamedTuple):
    """Result of a search over sequences of actions, for each of E goals.

    Attributes:
        reward: [E] float32, maximum reward at the end of an episode.
        is_reached: [E] bool, whether that episode truly reaches the goal.
        is_reachable: [E] bool, whether any of the sequences reaches it.
    """

    reward: Any
    is_reached: Any
    is_reachable: Any


def _actions(key: jax.Array, horizon: int, size: int) -> jax.Array:
    """Sample slowly changing actions [T, A] in [-1, 1]."""

    def step(action: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
        action = _PERSISTENCE * action + (1.0 - _PERSISTENCE**2) ** 0.5 * noise
        return action, jnp.clip(action, -1.0, 1.0)

    noise = jax.random.normal(key, (horizon, size))
    return jax.lax.scan(step, jnp.zeros(size), noise)[1]


def play(env: GoalEnv, count: int, seed: int) -> Episodes:
    """Roll out E = ``count`` episodes of slowly changing random actions, determined by ``seed``; return NumPy arrays."""

    def episode(key: jax.Array) -> Episodes:
        start_key, action_key = jax.random.split(key)
        start: Any = env.reset(start_key)

        def step(state: Any, action: jax.Array) -> tuple[Any, tuple[jax.Array, jax.Array]]:
            state = env.advance(state, action)
            return state, (env.observe(state), state.achieved_state)

        _, (images, states) = jax.lax.scan(step, start, _actions(action_key, env.horizon, env.action_size))
        images = jnp.concatenate([start.obs["observation"][None], images])
        states = jnp.concatenate([start.achieved_state[None], states])
        return Episodes(images, states, start.obs["desired_goal"], start.goal_state)

    episodes = jaxrl_vis_envs.jit(jax.vmap(episode))(jax.random.split(jax.random.key(seed), count))
    return Episodes(*map(np.asarray, episodes))


def with_noise(pairs: Pairs, deviation: float, seed: int) -> Pairs:
    """Return pairs with camera noise on all images and goals, independent for each: uint8, rounded and clipped.

    Args:
        pairs: Pairs of images and goals.
        deviation: Standard deviation of the noise in grey levels; if it is 0, ``pairs`` are returned unchanged.
        seed: Seed of the noise.
    """
    if deviation == 0.0:
        return pairs
    draw = np.random.default_rng(seed)

    def add_noise(images: Any) -> Any:
        changed = images + deviation * draw.standard_normal(images.shape, np.float32)
        return np.clip(np.round(changed), 0, 255).astype(np.uint8)

    return pairs._replace(images=add_noise(pairs.images), goals=add_noise(pairs.goals))


def make_pairs(env: GoalEnv, episodes: Episodes, seed: int) -> Pairs:
    """Pair every image but the first with the last image of its episode, that of another episode, and the given goal.

    The 3 E T pairs are in this order of goals; for each of them, episode by episode. ``seed`` determines the other
    episodes. If there is only one episode, it is also the other one.
    """
    count, length = episodes.images.shape[0], env.horizon
    draw = np.random.default_rng(seed)
    others = (np.arange(count) + draw.integers(1, max(2, count), count)) % count
    images, states = episodes.images[:, 1:], episodes.states[:, 1:]
    goals = (episodes.images[:, -1], episodes.images[others, -1], episodes.goals)
    goal_states = (episodes.states[:, -1], episodes.states[others, -1], episodes.goal_states)
    flat: list[Any] = [array.reshape(-1, *array.shape[2:]) for array in (images, states)]
    shown: list[Any] = [np.repeat(goal, length, axis=0) for goal in goal_states]
    distance = [np.asarray(truth.goal_distance(flat[1], goal)) for goal in shown]
    repeated = [np.repeat(goal, length, axis=0) for goal in goals]
    return Pairs(np.concatenate([flat[0]] * 3), np.concatenate(repeated), np.concatenate(distance))


def search(env: GoalEnv, reward: Reward, goals: int, sequences: int, seed: int) -> SearchResult:
    """Search for actions that maximise a reward at the end of an episode; return NumPy arrays.

    Args:
        env: Environment of the task.
        reward: Reward to maximise.
        goals: E, number of goals, each with a start of its own.
        sequences: Number of random sequences of actions for each goal.
        seed: Seed of goals, starts and actions.
    """

    def of_goal(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        start_key, action_key = jax.random.split(key)
        start: Any = env.reset(start_key)

        def end(key: jax.Array) -> tuple[jax.Array, jax.Array]:
            actions = _actions(key, env.horizon, env.action_size)
            state, _ = jax.lax.scan(lambda state, action: (env.advance(state, action), None), start, actions)
            return env.observe(state), state.achieved_state

        images, states = jax.vmap(end)(jax.random.split(action_key, sequences))
        rewards = reward(images, jnp.broadcast_to(start.obs["desired_goal"], images.shape))
        is_reached = truth.success(states, start.goal_state[None], env.threshold) > 0
        best = jnp.argmax(rewards)
        return rewards[best], is_reached[best], jnp.any(is_reached)

    episodes = jaxrl_vis_envs.jit(lambda keys: jax.lax.map(of_goal, keys))(jax.random.split(jax.random.key(seed), goals))
    return SearchResult(*map(np.asarray, episodes))
