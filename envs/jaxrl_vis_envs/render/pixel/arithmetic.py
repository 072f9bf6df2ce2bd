"""Arithmetic of single pixels and their vectors, in as few instructions as the device has for it."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.compiling.compilation import targets_cpu, tracing_for


def _fitted(values: Callable, degree: int) -> tuple[float, ...]:
    """The polynomial through a function's values on [0, 1] at the zeros of a Chebyshev polynomial: nearly the best."""
    nodes = 0.5 + 0.5 * np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    return tuple(np.polyfit(nodes, values(nodes), degree).tolist())


_LOG2 = _fitted(lambda x: np.log2(1.0 + x) / x, 5)
_EXP2 = _fitted(lambda x: 2.0**x, 4)
_LEAST_BASE = 1e-6

Vector = tuple  # of three numbers or arrays [P]


def larger(one: jax.Array, other: jax.Array | float) -> jax.Array:
    """The maximum of numbers, [P]: one instruction on a CPU, where XLA's, which has to keep a NaN, takes five."""
    return jnp.where(one > other, one, other) if targets_cpu() else jnp.maximum(one, other)


def smaller(one: jax.Array, other: jax.Array | float) -> jax.Array:
    """The minimum of numbers, [P], as `larger`."""
    return jnp.where(one < other, one, other) if targets_cpu() else jnp.minimum(one, other)


def clipped(value: jax.Array) -> jax.Array:
    """Numbers [P] within 0 and 1."""
    return smaller(larger(value, 0.0), 1.0)


def power(base: jax.Array, exponent: jax.Array) -> jax.Array:
    """``base ** exponent`` [P] for a base in [0, 1], with finite gradients at 0 and vectorised everywhere."""
    return (_power_of_polynomials if targets_cpu() else _power)(base, exponent)


def _power(base: jax.Array, exponent: jax.Array) -> jax.Array:
    return jnp.exp(exponent * jnp.log(larger(base, _LEAST_BASE)))


@jax.custom_jvp
def _power_of_polynomials(base: jax.Array, exponent: jax.Array) -> jax.Array:
    """`_power` in half the instructions, for exponents up to 128 right to a fifth of a grey level."""
    bits = jax.lax.bitcast_convert_type(larger(base, _LEAST_BASE), jnp.int32)
    fraction = jax.lax.bitcast_convert_type((bits & 0x7FFFFF) | 0x3F800000, jnp.float32) - 1.0
    logarithm = ((bits >> 23) - 127).astype(jnp.float32) + fraction * _polynomial(_LOG2, fraction)
    product = larger(exponent * logarithm, -126.0)
    whole = jnp.floor(product)
    scaled = jax.lax.bitcast_convert_type(_polynomial(_EXP2, product - whole), jnp.int32)
    return jax.lax.bitcast_convert_type(scaled + (whole.astype(jnp.int32) << 23), jnp.float32)


@_power_of_polynomials.defjvp
def _power_slope(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    with tracing_for("cpu"):  # the only platform that polynomials are for
        return jax.jvp(_power, primals, tangents)


def _polynomial(coefficients: tuple[float, ...], x: jax.Array) -> jax.Array:
    """The highest power first."""
    value = jnp.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        value = value * x + coefficient
    return value


def reciprocal(value: jax.Array) -> jax.Array:
    """1 / value for positive values, right to a few bits, by Newton's method from a guess at the exponent.

    XLA never fuses a division whose quotient is used twice: it stores the quotient and computes all else in the loop again.
    """
    guess = jax.lax.bitcast_convert_type(0x7EF311C7 - jax.lax.bitcast_convert_type(value, jnp.int32), jnp.float32)
    for _ in range(3):
        guess = guess * (2.0 - value * guess)
    return guess


def dot(left: Vector, right: Vector) -> jax.Array:
    """Scalar product of two vectors of three values."""
    return left[0] * right[0] + left[1] * right[1] + left[2] * right[2]


def normalized(vector: Vector) -> Vector:
    """The vector at length 1 (0 stays 0)."""
    scale = jax.lax.rsqrt(dot(vector, vector) + 1e-30)
    return vector[0] * scale, vector[1] * scale, vector[2] * scale
