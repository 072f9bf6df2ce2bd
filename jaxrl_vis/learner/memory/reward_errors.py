"""Simulated state estimator with errors, instead of the oracle's true states (thesis, equation 5.2).

    estimate      Gaussian noise on the estimated state
    flip          false rewards, everywhere or only in a cluttered part of the workspace

An estimator is a deterministic function of its input. Its errors are sampled with keys derived from the true states themselves,
so that a transition gets the same error every time it is sampled, and errors do not average out.
"""

import jax
import jax.numpy as jnp

_NOISE, _FALSE = 0x6E6F69, 0x66616C


def _keys(states: jax.Array, purpose: int) -> jax.Array:
    """Derive typed keys [B] from states [B, K] float32 alone."""
    words = jax.lax.bitcast_convert_type(states.astype(jnp.float32), jnp.uint32)
    mixed = jnp.zeros(words.shape[:1], jnp.uint32)
    for column in range(words.shape[1]):  # multiplicative hashing (Knuth); `fold_in` mixes the bits once more
        mixed = (mixed ^ words[:, column]) * jnp.uint32(0x9E3779B1)
        mixed = mixed ^ (mixed >> 15)
    return jax.vmap(lambda word: jax.random.fold_in(jax.random.key(purpose), word))(mixed)


def estimate(states: jax.Array, noise: float) -> jax.Array:
    """Estimate true states with errors: [B, G] float32, in their unit.

    Args:
        states: [B, G] float32.
        noise: Standard deviation of the error in each coordinate, in the unit of the states.
    """
    draw = jax.vmap(lambda key: jax.random.normal(key, states.shape[1:]))
    return states + noise * draw(_keys(states, _NOISE))


def flip(
    is_positive: jax.Array,
    states: jax.Array,
    goal_states: jax.Array,
    false_positives: float,
    false_negatives: float,
    clutter: float = 1.0,
    clutter_end: jax.Array | None = None,
) -> jax.Array:
    """Flip some rewards; return the mask of positives afterwards: [B] bool.

    Args:
        is_positive: [B] bool, mask of positives before.
        states: [B, G] float32, true achieved states.
        goal_states: [B, G] float32, true states of the goals.
        false_positives: Fraction of the negatives that become positives.
        false_negatives: Fraction of the positives that become negatives.
        clutter: Fraction of the workspace where errors occur; their rate is increased so that the overall fractions hold.
        clutter_end: [] float32, from `find_clutter_end`; None if errors occur everywhere.
    """
    number = jax.vmap(jax.random.uniform)(_keys(jnp.concatenate([states, goal_states], axis=1), _FALSE))
    is_false = number < jnp.where(is_positive, false_negatives, false_positives) / clutter
    if clutter_end is not None:
        is_false &= states[:, 0] < clutter_end
    return is_positive ^ is_false


def find_clutter_end(goal_states: jax.Array, is_stored: jax.Array, clutter: float) -> jax.Array:
    """Find the value of the first coordinate below which the fraction ``clutter`` of all goals lies: [] float32.

    Args:
        goal_states: [N, G] float32, true states of goals, whose distribution over the workspace is independent of the policy.
        is_stored: [N] bool, mask of occupied positions.
        clutter: Fraction in (0, 1).
    """
    ordered = jnp.sort(jnp.where(is_stored, goal_states[:, 0], jnp.inf))
    return ordered[jnp.clip((clutter * jnp.sum(is_stored)).astype(jnp.int32), 0, len(ordered) - 1)]
