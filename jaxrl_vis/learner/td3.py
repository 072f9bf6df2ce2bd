"""Twin delayed DDPG (Fujimoto et al., 2018, arXiv 1802.09477): DDPG with three changes.

    two critics         heads on one encoder; targets use the minimum of both, which counters overestimation
    target smoothing    clipped noise on the next action, so that values do not overfit to narrow peaks
    delayed actor       one update of the actor and the target networks for several of the critics

The last is `DDPGOptions.actor_interval` and ``target_update_interval``, which presets set to at least 2 for this algorithm.
Encoders, rewards, filters and auxiliary losses are those of DDPG. The paper's two critics share nothing; here, they share the
encoder, which dominates the cost for images, as in DrQ-v2 (Yarats et al., 2021).
"""

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.algorithm import Algorithm, Setup
from jaxrl_vis.learner.ddpg import ddpg

NOISE, CLIP = 0.2, 0.5
"""Standard deviation and bound of the noise on next actions in [-1, 1], as in the paper."""


def make(setup: Setup) -> Algorithm:
    """Build TD3; errors as in `ddpg.make`."""
    run, shards = setup.config.run, setup.shards

    def draw_noise(key: jax.Array, count: int) -> jax.Array:
        noise = shards.noise(key, (run.batch_size // shards.count, count, setup.action_size))
        return jnp.clip(NOISE * noise, -CLIP, CLIP).swapaxes(0, 1)

    return ddpg.build(setup, critic_heads=2, draw_noise=draw_noise)
