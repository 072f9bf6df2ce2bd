"""Environments so small that the right answer is known, each isolating one failure (after Andy Jones, "Debugging RL").

They are pure arithmetic, without MuJoCo and rendering, and episodes have a few steps.
"""

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.base import GoalEnv, State, sanitize_action


class Probe(GoalEnv):
    """Environment of a point on a line, with a start and a goal.

    Subclasses define `start`, and may define `move`; by default, the point stays. Point and goal are observed by `see`.
    """

    threshold = 0.1
    control_period = 1.0
    horizon = 4
    action_size = 1
    name = "Probe"

    def start(self, key):
        """Sample start and goal of an episode, [1] each."""
        raise NotImplementedError

    def move(self, position, action):
        """Return the point [1] after an action [1]."""
        return position

    def see(self, position):
        """Return the observation of a point [1]; by default the point itself."""
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
    """Probe whose start is the goal: every reward is R+, every value R+ / (1 - gamma). Tests the value loss."""

    def start(self, key):
        return jnp.zeros(1), jnp.zeros(1)


class ThreeStepsAway(Probe):
    """Probe that moves from -3 by one per step to the goal at 0 and stays, whatever the action. Tests discounting.

    With rewards 0/-1 the values at -3, -2, -1, 0 are -1 - gamma, -1, 0, 0.
    """

    def start(self, key):
        return jnp.full(1, -3.0), jnp.zeros(1)

    def move(self, position, action):
        return jnp.minimum(position + 1.0, 0.0)


class TwoPlaces(Probe):
    """Probe that stays at its start, 0 or 1; the goal is 0. Tests that the value depends on the observation."""

    def start(self, key):
        return jax.random.bernoulli(key, 0.5, (1,)).astype(jnp.float32), jnp.zeros(1)


class TwoGoals(Probe):
    """Probe that stays at 0; the goal is 0 or 1. Tests that the value depends on the goal."""

    def start(self, key):
        return jnp.zeros(1), jax.random.bernoulli(key, 0.5, (1,)).astype(jnp.float32)


class GoWhereTold(Probe):
    """Probe that moves to the action; the goal lies in [-0.8, 0.8). Tests that the policy follows the goal."""

    def start(self, key):
        return jnp.zeros(1), jax.random.uniform(key, (1,), minval=-0.8, maxval=0.8)

    def move(self, position, action):
        return action


class GoAgainstTheSign(Probe):
    """Probe of one step from -1 or 1 to the opposite goal, by an action of its sign. Tests that the policy uses its inputs."""

    horizon = 1

    def start(self, key):
        side = jnp.where(jax.random.bernoulli(key, 0.5, (1,)), 1.0, -1.0)
        return side, -side

    def move(self, position, action):
        return jnp.where(jnp.sign(action) == -jnp.sign(position), -position, position)

    def see(self, position):
        return position


class PointImage(Probe):
    """Probe that drifts, observed as an image [1, 4, 4] uint8 of its float32 bytes: frames of an episode are all different."""

    def start(self, key):
        return jax.random.uniform(key, (1,)), jnp.full(1, 100.0)

    def move(self, position, action):
        return position + 1.0 + 0.1 * action

    def see(self, position):
        bits = jax.lax.bitcast_convert_type(position, jnp.uint8)  # [1, 4]: all of the float32, so equal bytes are equal points
        return jnp.broadcast_to(bits[:, None, :], (1, 4, 4))


class SeenGoWhereTold(GoWhereTold):
    """`GoWhereTold` observed as images [1, 8, 8] uint8, in which a bright column shows the position of point or goal."""

    def see(self, position):
        column = jnp.arange(8, dtype=jnp.float32) - 3.5
        brightness = jnp.clip(255.0 * (1.0 - jnp.abs(column - 3.5 * position) / 2.0), 0.0, 255.0)
        return jnp.broadcast_to(brightness, (1, 8, 8)).astype(jnp.uint8)
