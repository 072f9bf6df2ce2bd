"""Goal relabelling: replacement of goals by observations of the same episode (thesis, section 5.1.4).

Slots 0 ... T of an episode hold its frames, slot T+1 its original goal (`types.Episodes`), so to relabel is to choose a slot.
For the transition from slot t to t+1, with probability

    p1 p2          slot t+1                       certainly reached: a positive even under the indicator reward
    p1 (1 - p2)    a slot of t+1 ... T, uniform   hindsight experience replay's "future" (Andrychowicz et al., 2017)
                   or slot t+k with probability proportional to gamma^k, for contrastive RL (Eysenbach et al., 2022)
    1 - p1         slot T+1                       the goal that the policy was given

`sampling` converts the observation in that slot to the goal.
"""

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.memory.random_integers import fractions_to_integers


def geometric_offsets(fraction: jax.Array, remaining: jax.Array, discount: float) -> jax.Array:
    """Map uniform samples to integers k in [0, remaining), with probability proportional to discount^k: [B] int32.

    Args:
        fraction: [B] float32 in [0, 1).
        remaining: [B] int32, at least 1.
        discount: gamma in (0, 1).
    """
    # The inverse of the cumulative distribution, (1 - gamma^(k+1)) / (1 - gamma^n).
    tail = 1.0 - fraction * (1.0 - discount**remaining)
    offsets = jnp.floor(jnp.log(tail) / jnp.log(discount)).astype(jnp.int32)
    return jnp.clip(offsets, 0, remaining - 1)


def choose_goal_slots(
    key: jax.Array,
    time: jax.Array,
    horizon: int,
    relabel_probability: float,
    balance_probability: float,
    discount: float | None = None,
) -> jax.Array:
    """Choose a goal slot for every transition: [B] int32 in {t+1, ..., T+1}.

    Args:
        key: [] typed key.
        time: [B] int32, t in [0, T).
        horizon: T.
        relabel_probability: p1.
        balance_probability: p2.
        discount: gamma of geometrically distributed goals; None for a uniform distribution.
    """
    strategy, fraction = jax.random.uniform(key, (2, *time.shape))
    remaining = horizon - time
    later = fractions_to_integers(fraction, remaining) if discount is None else geometric_offsets(fraction, remaining, discount)
    future = time + 1 + later
    slots = jnp.where(strategy < relabel_probability, future, horizon + 1)
    return jnp.where(strategy < relabel_probability * balance_probability, time + 1, slots).astype(jnp.int32)
