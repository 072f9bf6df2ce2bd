"""Plays whole episodes with the current policy, all environments in step.

reset E environments (each draws its goal picture once)
scan over T:  act -> advance -> observe        frames [T, E, ...], each kept once
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.networks import Networks
from jaxrl_vis.types import Episodes, Metrics, TrainState
from jaxrl_vis_envs.base import GoalEnv

Policy = Callable[[jax.Array, jax.Array], jax.Array]
"""(key, frames [E, ...]) -> actions [E, A] float32."""


class Exploration(NamedTuple):
    """How far actions stray from the policy; the default not at all.

    Attributes:
        random_action_probability: Share of actions replaced by uniformly random ones, whole vectors at a time.
        action_noise: Standard deviation of the Gaussian noise on the others.
    """

    random_action_probability: float = 0.0
    action_noise: float = 0.0


NO_EXPLORATION = Exploration()


def make_policy(networks: Networks, train: TrainState, goals: jax.Array, exploration: Exploration) -> Policy:
    """The online actor with these goals, which are encoded once, and with noise where it is asked for.

    Args:
        networks: What the parameters mean.
        train: The learner.
        goals: [E, ...] observations of the goals.
        exploration: The noise.
    """

    def encode(frames: jax.Array) -> jax.Array:
        return networks.encode(train.actor, networks.prepare(train.normalizer, frames))

    goal_latents = encode(goals)

    def policy(key: jax.Array, frames: jax.Array) -> jax.Array:
        action = networks.act(train.actor, jnp.stack([encode(frames), goal_latents]))
        if exploration == NO_EXPLORATION:
            return action
        noise_key, choice_key, random_key = jax.random.split(key, 3)
        action = jnp.clip(action + exploration.action_noise * jax.random.normal(noise_key, action.shape), -1.0, 1.0)
        uniform = jax.random.uniform(random_key, action.shape, minval=-1.0, maxval=1.0)
        choose = jax.random.bernoulli(choice_key, exploration.random_action_probability, (*action.shape[:-1], 1))
        return jnp.where(choose, uniform, action)

    return policy


def play(
    env: GoalEnv,
    networks: Networks,
    train: TrainState,
    key: jax.Array,
    num_envs: int,
    exploration: Exploration = NO_EXPLORATION,
    num_kept: int | None = None,
) -> tuple[Episodes, Metrics]:
    """Plays one episode in each of E environments.

    Args:
        env: The world.
        networks: What the parameters mean.
        train: The learner.
        key: [] typed key of this rollout.
        num_envs: E.
        exploration: The noise.
        num_kept: How many of the episodes to keep (the first ones); None: all.

    Returns:
        The kept episodes, and the outcome of all E at their last step: ``success`` and ``goal_distance``, [E].
    """
    reset_key, policy_key = jax.random.split(key)
    state = jax.vmap(env.reset)(jax.random.split(reset_key, num_envs))
    assert state.obs is not None
    first_frame, goal_frame = state.obs["observation"], state.obs["desired_goal"]
    first_state = state.achieved_state
    policy = make_policy(networks, train, goal_frame, exploration)

    def kept(tree):
        return jax.tree.map(lambda leaf: leaf[:num_kept], tree)

    def step(carry, step_key):
        state, frame = carry
        action = policy(step_key, frame)
        state = jax.vmap(env.advance)(state, action)
        frame = jax.vmap(env.observe)(state)
        return (state, frame), kept((frame, state.achieved_state, action))

    carry = (state.replace(obs=None), first_frame)
    (state, _), steps = jax.lax.scan(step, carry, jax.random.split(policy_key, env.horizon))
    outcome = {name: state.metrics[name] for name in ("success", "goal_distance")}

    def episode_major(first: jax.Array, rest: jax.Array, goal: jax.Array) -> jax.Array:
        return jnp.moveaxis(jnp.concatenate([first[None], rest, goal[None]]), 0, 1)

    frames, states, actions = steps
    episodes = Episodes(
        frames=episode_major(kept(first_frame), frames, kept(goal_frame)),
        states=episode_major(kept(first_state), states, kept(state.goal_state)),
        actions=jnp.moveaxis(actions, 0, 1),
    )
    return episodes, outcome
