"""Random integers from random fractions, so that related numbers share a single call of `jax.random`.

XLA compiles every call of `jax.random` as a separate computation, which takes a quarter of a second on a CPU; integers need
three. Sampled separately, the numbers of a batch took 40 % of the compilation time of gradient steps.
"""

import jax
import jax.numpy as jnp


def fractions_to_integers(fraction: jax.Array, count: int | jax.Array) -> jax.Array:
    """Scale fractions to integers from 0 to ``count`` - 1, uniform up to the fractions' resolution: [...] int32.

    Args:
        fraction: [...] float32 in [0, 1), such as from `jax.random.uniform`, whose resolution is 2**-23.
        count: Number of integers, at least 1; broadcasts to ``fraction``.
    """
    # A number just below 1 may round up to `count` when it is scaled.
    return jnp.minimum(jnp.floor(fraction * count).astype(jnp.int32), count - 1)
