"""Plays whole episodes with the current policy, all environments in step.

reset S x E environments (each draws its goal image once)
scan over T:  act -> advance -> observe        frames [T, S, E, ...], each kept once
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.networks import Networks
from jaxrl_vis.types import Episodes, Metrics, TrainState
from jaxrl_vis_envs.base import GoalEnv


class Exploration(NamedTuple):
    """How far actions stray from the policy; the default not at all.

    Attributes:
        random_action_probability: Share of actions replaced by uniformly random ones, whole vectors at a time.
        action_noise: Standard deviation of the Gaussian noise on the others.
    """

    random_action_probability: float = 0.0
    action_noise: float = 0.0


NO_EXPLORATION = Exploration()


def encode(networks: Networks, train: TrainState, frames: jax.Array) -> jax.Array:
    """What the online actor makes of images (or states) [E, ...]: [E, Z]."""
    return networks.encode(train.actor, networks.prepare(train.normalizer, frames))


def choose_actions(
    networks: Networks, train: TrainState, goal_latents: jax.Array, exploration: Exploration, key: jax.Array, frames: jax.Array
) -> jax.Array:
    """The online actor, with noise where it is asked for.

    Args:
        networks: What the parameters mean.
        train: The learner.
        goal_latents: [E, Z] from `encode`: goals stay, so they are encoded once an episode.
        exploration: The noise.
        key: [] typed; draws the noise.
        frames: [E, ...] observations.

    Returns:
        [E, A] float32 in [-1, 1].
    """
    action = networks.act(train.actor, jnp.stack([encode(networks, train, frames), goal_latents]))
    if exploration == NO_EXPLORATION:
        return action
    noise_key, choice_key, random_key = jax.random.split(key, 3)
    action = jnp.clip(action + exploration.action_noise * jax.random.normal(noise_key, action.shape), -1.0, 1.0)
    uniform = jax.random.uniform(random_key, action.shape, minval=-1.0, maxval=1.0)
    choose = jax.random.bernoulli(choice_key, exploration.random_action_probability, (*action.shape[:-1], 1))
    return jnp.where(choose, uniform, action)


def play(
    env: GoalEnv,
    networks: Networks,
    train: TrainState,
    keys: jax.Array,
    num_envs: int,
    exploration: Exploration = NO_EXPLORATION,
    num_kept: int | None = None,
) -> tuple[Episodes, Metrics]:
    """Plays one episode in each of E environments, for each of S learners side by side.

    To the world learners are nothing but more environments: one `jax.vmap` less means half as much to trace.

    Args:
        env: The world.
        networks: What the parameters mean.
        train: The learners, [S, ...].
        keys: [S] typed keys of this rollout.
        num_envs: E.
        exploration: The noise.
        num_kept: How many of the episodes to keep (the first ones); None: all.

    Returns:
        The kept episodes [S, E, ...], and the outcome of all at their last step: ``success`` and ``goal_distance``, [S, E].
    """
    num_seeds = keys.shape[0]

    def by_seed(leaf: jax.Array) -> jax.Array:
        return leaf.reshape(num_seeds, num_envs, *leaf.shape[1:])

    def kept(leaf: jax.Array) -> jax.Array:
        return by_seed(leaf)[:, :num_kept]

    reset_keys, policy_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
    state = jax.vmap(env.reset)(jax.vmap(lambda key: jax.random.split(key, num_envs))(reset_keys).reshape(-1))
    assert state.obs is not None
    first_frame, goal_frame = state.obs["observation"], state.obs["desired_goal"]
    first_state = state.achieved_state
    goal_latents = jax.vmap(lambda train, goals: encode(networks, train, goals))(train, by_seed(goal_frame))

    def act(train: TrainState, goal_latents: jax.Array, key: jax.Array, frames: jax.Array) -> jax.Array:
        return choose_actions(networks, train, goal_latents, exploration, key, frames)

    def step(carry, step_keys):
        state, frame = carry
        action = jax.vmap(act)(train, goal_latents, step_keys, by_seed(frame)).reshape(num_seeds * num_envs, -1)
        state = jax.vmap(env.advance)(state, action)
        frame = jax.vmap(env.observe)(state)
        return (state, frame), tuple(kept(leaf) for leaf in (frame, state.achieved_state, action))

    carry = (state.replace(obs=None), first_frame)
    step_keys = jax.vmap(lambda key: jax.random.split(key, env.horizon), out_axes=1)(policy_keys)
    (state, _), steps = jax.lax.scan(step, carry, step_keys)
    outcome = {name: by_seed(state.metrics[name]) for name in ("success", "goal_distance")}

    def episode_major(first: jax.Array, rest: jax.Array, goal: jax.Array) -> jax.Array:
        return jnp.moveaxis(jnp.concatenate([kept(first)[None], rest, kept(goal)[None]]), 0, 2)

    frames, states, actions = steps
    episodes = Episodes(
        frames=episode_major(first_frame, frames, goal_frame),
        states=episode_major(first_state, states, state.goal_state),
        actions=jnp.moveaxis(actions, 0, 2),
    )
    return episodes, outcome
