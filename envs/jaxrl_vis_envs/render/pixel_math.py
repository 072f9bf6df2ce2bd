"""Arithmetic of single pixels, in as few instructions as the device has for it."""

import jax
import jax.numpy as jnp


def larger(one: jax.Array, other: jax.Array | float) -> jax.Array:
    """The maximum of numbers, [P]: one instruction on a CPU, where XLA's, which has to keep a NaN, takes five."""
    return jnp.where(one > other, one, other) if jax.default_backend() == "cpu" else jnp.maximum(one, other)


def smaller(one: jax.Array, other: jax.Array | float) -> jax.Array:
    """The minimum of numbers, [P], as `larger`."""
    return jnp.where(one < other, one, other) if jax.default_backend() == "cpu" else jnp.minimum(one, other)


def clipped(value: jax.Array) -> jax.Array:
    """Numbers [P] within 0 and 1."""
    return smaller(larger(value, 0.0), 1.0)


def power(base: jax.Array, exponent: jax.Array) -> jax.Array:
    """``base ** exponent`` [P] for a base in [0, 1], with finite gradients at 0 and vectorised everywhere."""
    return jnp.exp(exponent * jnp.log(larger(base, 1e-6)))


def reciprocal(value: jax.Array) -> jax.Array:
    """1 / value for positive values, right to a few bits, by Newton's method from a guess at the exponent.

    XLA never fuses a division of which the quotient is used twice: it would store it, and compute all else in the loop again.
    """
    guess = jax.lax.bitcast_convert_type(0x7EF311C7 - jax.lax.bitcast_convert_type(value, jnp.int32), jnp.float32)
    for _ in range(3):
        guess = guess * (2.0 - value * guess)
    return guess
