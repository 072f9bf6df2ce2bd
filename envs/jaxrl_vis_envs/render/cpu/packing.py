"""Colours and normals packed into one integer per pixel."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render.pixel.arithmetic import Vector, clip_to_unit, maximum, normalized, reciprocal

_NORMAL_STEPS = 32767.0


def pack(colour: Vector, bits: int) -> jax.Array:
    """Quantise three channels [P] in [0, 1] to ``bits`` bits each, and pack them: [P] int32."""
    steps = float(2**bits - 1)
    red, green, blue = ((clip_to_unit(channel) * steps + 0.5).astype(jnp.int32) for channel in colour)
    return red | (green << bits) | (blue << 2 * bits)


def unpack_channels(packed: jax.Array, bits: int) -> Vector:
    """Unpack the result of `pack`: three channels [P] float32 in [0, 1]."""
    steps = 2**bits - 1
    return tuple(((packed >> shift * bits) & steps).astype(jnp.float32) / float(steps) for shift in range(3))


def unpack(packed: jax.Array, bits: int) -> jax.Array:
    """Unpack colours to 8 bits: [H, W] int32 -> [3, H, W] uint8."""
    shifts = jnp.array([0, bits, 2 * bits], jnp.int32)[:, None, None]
    if bits == 8:
        return (packed >> shifts).astype(jnp.uint8)
    steps = 2**bits - 1
    return ((((packed >> shifts) & steps) * 255 + steps // 2) // steps).astype(jnp.uint8)


def pack_normal(normal: Vector) -> jax.Array:
    """Encode directions of any norm in the octahedral encoding: [P] int32, 16 bits per axis."""
    inverse = reciprocal(jnp.abs(normal[0]) + jnp.abs(normal[1]) + jnp.abs(normal[2]) + 1e-30)
    x, y = normal[0] * inverse, normal[1] * inverse
    below = normal[2] < 0.0
    folded = (1.0 - jnp.abs(y)) * jnp.where(x >= 0.0, 1.0, -1.0), (1.0 - jnp.abs(x)) * jnp.where(y >= 0.0, 1.0, -1.0)
    low, high = (
        ((jnp.where(below, fold, flat) + 1.0) * _NORMAL_STEPS + 0.5).astype(jnp.int32)
        for fold, flat in zip(folded, (x, y), strict=True)
    )
    return low | (high << 16)


def unpack_normal(packed: jax.Array) -> Vector:
    """Decode `pack_normal` to unit vectors, accurate to 5e-5."""
    x, y = (
        half.astype(jnp.float32) * (1.0 / _NORMAL_STEPS) - 1.0
        for half in (packed & 0xFFFF, jax.lax.shift_right_logical(packed, np.int32(16)))
    )
    z = 1.0 - jnp.abs(x) - jnp.abs(y)
    fold = maximum(-z, 0.0)
    return normalized((x - jnp.where(x >= 0.0, fold, -fold), y - jnp.where(y >= 0.0, fold, -fold), z))
