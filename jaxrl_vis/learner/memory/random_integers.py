"""Random integers from random fractions, so that related numbers take a single draw.

XLA compiles every draw of `jax.random` as a separate computation, a quarter of a second on a CPU; integers take three. Drawn
one by one, the numbers of a batch took two fifths of the time that gradient steps took to compile.
"""

import jax
import jax.numpy as jnp


def scaled(fraction: jax.Array, count: int | jax.Array) -> jax.Array:
    """Scale fractions to integers from 0 to ``count`` - 1, uniform up to the fractions' resolution: [...] int32.

    Args:
        fraction: [...] float32 in [0, 1), of which `jax.random.uniform` has 2**23.
        count: At least 1.
    """
    # A number just below 1 may round up to `count` when it is scaled.
    return jnp.minimum(jnp.floor(fraction * count).astype(jnp.int32), count - 1)
