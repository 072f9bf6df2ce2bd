"""Environments so small that the right answer is known, each failing for one reason only (after Andy Jones, "Debugging RL").

They are pure arithmetic: no MuJoCo, no images, a few steps.
"""

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.base import GoalEnv, State, sanitize_action


class Probe(GoalEnv):
    """A point that may or may not move, with a start and a goal.

    The observation holds the point (or nothing), the goal's observation holds the goal (or nothing).
    """

    threshold = 0.1
    control_period = 1.0
    horizon = 4
    action_size = 1
    name = "Probe"

    def start(self, key):
        """Start and goal of an episode, [1] each."""
        raise NotImplementedError

    def move(self, position, action):
        """The point after an action."""
        return position

    def see(self, position):
        """What an observation shows of a point."""
        return position

    def reset(self, key):
        position, goal = self.start(key)
        observation = self.see(position)
        obs = {"observation": observation, "achieved_goal": observation, "desired_goal": self.see(goal)}
        return self._measure(position, position, goal, obs)

    def advance(self, state: State, action):
        position = self.move(state.data, sanitize_action(action))
        return self._measure(position, position, state.goal_state, state.obs)

    def observe(self, state: State):
        return self.see(state.data)


class AlwaysThere(Probe):
    """The start is the goal and nothing moves: every reward is R+, every value R+ / (1 - gamma). Tests the value loss."""

    def start(self, key):
        return jnp.zeros(1), jnp.zeros(1)


class ThreeStepsAway(Probe):
    """The point moves from -3 by one a step to the goal at 0 and stays, whatever the action. Tests discounting.

    With rewards 0/-1 the values at -3, -2, -1, 0 are -1 - gamma, -1, 0, 0.
    """

    def start(self, key):
        return jnp.full(1, -3.0), jnp.zeros(1)

    def move(self, position, action):
        return jnp.minimum(position + 1.0, 0.0)


class TwoPlaces(Probe):
    """The point stays where it starts, at 0 or 1; the goal is 0. Tests that the value depends on the observation."""

    def start(self, key):
        return jax.random.bernoulli(key, 0.5, (1,)).astype(jnp.float32), jnp.zeros(1)


class TwoGoals(Probe):
    """The point stays at 0; the goal is 0 or 1. Tests that the value depends on the goal."""

    def start(self, key):
        return jnp.zeros(1), jax.random.bernoulli(key, 0.5, (1,)).astype(jnp.float32)


class GoWhereTold(Probe):
    """The action is where the point goes; the goal lies in (-0.8, 0.8). Tests that the policy follows the goal."""

    def start(self, key):
        return jnp.zeros(1), jax.random.uniform(key, (1,), minval=-0.8, maxval=0.8)

    def move(self, position, action):
        return action


class GoAgainstTheSign(Probe):
    """The goal is at the end (-1 or 1) that the observation's sign shows, not the goal. Tests that the policy looks."""

    horizon = 1

    def start(self, key):
        side = jnp.where(jax.random.bernoulli(key, 0.5, (1,)), 1.0, -1.0)
        return side, -side

    def move(self, position, action):
        return jnp.where(jnp.sign(action) == -jnp.sign(position), -position, position)

    def see(self, position):
        return position


class PointImage(Probe):
    """A drifting point as a 4x4 image whose bytes never repeat within an episode: every frame is one of a kind."""

    def start(self, key):
        return jax.random.uniform(key, (1,)), jnp.full(1, 100.0)

    def move(self, position, action):
        return position + 1.0 + 0.1 * action

    def see(self, position):
        bits = jax.lax.bitcast_convert_type(position, jnp.uint8)  # [1, 4]: all of the float32, so equal bytes are equal points
        return jnp.broadcast_to(bits[:, None, :], (1, 4, 4))


class SeenGoWhereTold(GoWhereTold):
    """`GoWhereTold` as an image: the point is a bright column of 8x8 pixels, and the goal is where the column shall be."""

    def see(self, position):
        column = jnp.arange(8, dtype=jnp.float32) - 3.5
        brightness = jnp.clip(255.0 * (1.0 - jnp.abs(column - 3.5 * position) / 2.0), 0.0, 255.0)
        return jnp.broadcast_to(brightness, (1, 8, 8)).astype(jnp.uint8)
