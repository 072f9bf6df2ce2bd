"""Goals of a task whose observed states contain more than its goals specify."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxrl_vis_envs
from jaxrl_vis.config import preset
from jaxrl_vis.learner.memory.replay import Indices, make_replay
from jaxrl_vis.learner.memory.sampling import Choice, Sampler
from jaxrl_vis.learner.resolved import resolve
from jaxrl_vis.types import Episodes

ENVS, HORIZON = 2, 4


def test_relabelled_goals_tell_of_the_box_alone():
    """Goals are made by FetchPush's own `as_goal`; if the box is at its goal, the indicator is positive wherever the arm is."""
    env = jaxrl_vis_envs.make("FetchPush")
    observations = np.random.default_rng(0).uniform(0.3, 0.6, (ENVS, HORIZON + 2, 25)).astype(np.float32)
    observations[0, 3, 3:6] = observations[0, 2, 3:6]  # the box rests for a step, the arm does not
    replay = make_replay(ENVS * HORIZON, ENVS, HORIZON, frame_stack=1)
    collected = Episodes(
        jnp.asarray(observations), jnp.zeros((ENVS, HORIZON + 2, 3)), jnp.zeros((ENVS, HORIZON, env.action_size))
    )
    state = replay.insert(replay.init(env.observation_spec, 3, env.action_size), collected, jnp.int32(0))
    episode, time, goal_slot = (jnp.array(values) for values in ([0, 1, 0], [1, 0, 2], [3, 4, 4]))
    config = preset("debug", env="FetchPush", method="indicator")
    sampler = Sampler(config, resolve(config, HORIZON), replay, env.threshold, env.as_goal)
    batch = sampler.batch(state, Choice(Indices(episode, time), goal_slot))
    np.testing.assert_array_equal(batch.observation_t, observations[episode, time])
    np.testing.assert_array_equal(batch.observation_tp1, observations[episode, time + 1])
    np.testing.assert_allclose(batch.goal, jax.vmap(env.as_goal)(jnp.asarray(observations)[episode, goal_slot]), atol=1e-6)
    np.testing.assert_array_equal(np.asarray(batch.reward) > 0, [True, False, False])
