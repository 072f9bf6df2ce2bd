"""Random integers from random fractions, so that what belongs together is one draw.

Every draw of `jax.random` is a program of its own to XLA, which takes a CPU a quarter of a second to compile, and one of
integers is three. Drawn one by one, the numbers of a batch took two fifths of the time that gradient steps took to compile.
"""

import jax
import jax.numpy as jnp


def scaled(fraction: jax.Array, count: int | jax.Array) -> jax.Array:
    """Integers of 0 to ``count`` - 1, evenly as far as there are fractions: [...] int32.

    Args:
        fraction: [...] float32 in [0, 1), of which `jax.random.uniform` has 2**23.
        count: At least 1.
    """
    # A number just below 1 may round up to `count` when it is scaled.
    return jnp.minimum(jnp.floor(fraction * count).astype(jnp.int32), count - 1)
