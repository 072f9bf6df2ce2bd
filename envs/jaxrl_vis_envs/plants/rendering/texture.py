"""Procedural textures: noise evaluated on demand from surface coordinates. Plain JAX, any shape."""

import jax
import jax.numpy as jnp


def hash_words(*words: jax.Array) -> jax.Array:
    """Hash one to four uint32 arrays into one pseudo-random uint32 array."""
    value = jnp.uint32(0x9E3779B9)
    for word, factor in zip(words, (0x85EBCA6B, 0xC2B2AE35, 0x27D4EB2F, 0x165667B1)):
        value = (value ^ (word * jnp.uint32(factor))) * jnp.uint32(0x2545F491)
        value = value ^ (value >> 15)
    value = value * jnp.uint32(0x846CA68B)
    return value ^ (value >> 16)


def uniform(bits: jax.Array) -> jax.Array:
    """Convert uint32 to float32 in [0, 1)."""
    return (bits >> 8).astype(jnp.int32).astype(jnp.float32) * jnp.float32(2.0**-24)


def approximate_normal(bits: jax.Array) -> jax.Array:
    """Convert uint32 to approximately standard normal float32, within 3.5 of 0, from the sum of the four bytes."""
    total = (bits & 255) + ((bits >> 8) & 255) + ((bits >> 16) & 255) + (bits >> 24)
    return (total.astype(jnp.int32).astype(jnp.float32) - 510.0) * jnp.float32(1.0 / 147.8)


def noise(x: jax.Array, y: jax.Array, layer: int) -> jax.Array:
    """Evaluate smooth noise float32 in [0, 1) with features of size 1 in both coordinates; layers are independent."""
    column, row = jnp.floor(x), jnp.floor(y)
    u, v = x - column, y - row
    u, v = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v)
    left, top = column.astype(jnp.int32).astype(jnp.uint32), row.astype(jnp.int32).astype(jnp.uint32)

    def corner(dx: int, dy: int) -> jax.Array:
        # One round of mixing suffices: neighbours differ by an odd multiple of a large number.
        value = (left + jnp.uint32(dx)) * jnp.uint32(0x85EBCA6B) + (top + jnp.uint32(dy)) * jnp.uint32(0xC2B2AE35)
        value = (value ^ jnp.uint32(0x9E3779B9 * (layer + 1) & 0xFFFFFFFF)) * jnp.uint32(0x2545F491)
        value = (value ^ (value >> 15)) * jnp.uint32(0x846CA68B)
        return uniform(value ^ (value >> 16))

    upper = corner(0, 0) + (corner(1, 0) - corner(0, 0)) * u
    lower = corner(0, 1) + (corner(1, 1) - corner(0, 1)) * u
    return upper + (lower - upper) * v


def ramp(low: float | jax.Array, high: float | jax.Array, value: jax.Array) -> jax.Array:
    """Interpolate smoothly from 0 below ``low`` to 1 above ``high``."""
    t = jnp.clip((value - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
