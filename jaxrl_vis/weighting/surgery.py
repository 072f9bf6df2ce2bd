"""Weightings that modify each gradient by the others, one after another in random order. All losses are treated alike.

Each modified gradient is a linear combination of the original ones, so that the Gramian [K, K] suffices.
"""

from typing import Unpack

import jax
import jax.numpy as jnp

from jaxrl_vis.errors import RequestError
from jaxrl_vis.weighting.base import Weighting, WeightingState
from jaxrl_vis.weighting.gramian_based import Options, of_gramian


def pcgrad(seed: int = 0, **options: Unpack[Options]) -> Weighting:
    """Remove conflicting components from each gradient (PCGrad; Yu et al., 2020, "Gradient Surgery", algorithm 1).

    If <g_i, g_j> < 0, g_i is projected onto the normal plane of g_j; the modified gradients are summed. With two losses the sum
    opposes neither gradient; with more it may. Cheap and common.

    Args:
        seed: Seed of the initial key, for the orders; replace ``state.key`` to make several states sample independently.
        options: See `Options`.
    """

    def solve(gramian: jax.Array, state: WeightingState) -> tuple[jax.Array, None]:
        return pcgrad_weights(gramian, _random_orders(state, len(gramian))), None

    return of_gramian("pcgrad", solve, seed=seed, **options)


def pcgrad_weights(gramian: jax.Array, orders: jax.Array) -> jax.Array:
    """Compute the weights of `pcgrad`, [K].

    Args:
        gramian: [K, K] float.
        orders: [K, K] int; row i is the order in which g_i is compared with the others (i itself is skipped).
    """
    rows, squares = jnp.arange(len(gramian)), jnp.diagonal(gramian)
    changed = jnp.eye(len(gramian), dtype=gramian.dtype)  # row i: modified g_i as a combination of the gradients
    for index in range(len(gramian)):
        others = orders[:, index]
        dots = jnp.sum(gramian[others] * changed, axis=1)
        opposes = (dots < 0.0) & (others != rows) & (squares[others] > 0.0)
        removed = jnp.where(opposes, dots / jnp.where(opposes, squares[others], 1.0), 0.0)
        changed = changed.at[rows, others].add(-removed)
    return jnp.sum(changed, axis=0)


def gradvac(beta: float = 0.01, seed: int = 0, **options: Unpack[Options]) -> Weighting:
    """Rotate each gradient towards the others, up to their usual cosine (GradVac; Wang et al., 2021, "Gradient Vaccine").

    If the cosine of g_i and g_j is below its running mean (initially 0), the multiple of g_j that makes them equal is added to
    g_i; the modified gradients are summed. `pcgrad` is the same with a mean fixed at 0. Suited to losses whose gradients
    usually agree, such as those of many languages.

    Args:
        beta: Weight of the latest cosine in the running mean.
        seed: See `pcgrad`.
        options: See `Options`.

    Raises:
        RequestError: ``beta`` is not between 0 and 1.
    """
    if not 0.0 <= beta <= 1.0:
        raise RequestError(f"beta of weighting gradvac must be between 0 and 1, not {beta}")

    def solve(gramian: jax.Array, state: WeightingState) -> tuple[jax.Array, jax.Array]:
        return gradvac_weights(gramian, state.memory, _random_orders(state, len(gramian)), beta)

    return of_gramian("gradvac", solve, memory=lambda count, dtype: jnp.zeros((count, count), dtype), seed=seed, **options)


def gradvac_weights(
    gramian: jax.Array, target_cosines: jax.Array, orders: jax.Array, beta: float
) -> tuple[jax.Array, jax.Array]:
    """Compute the weights of `gradvac`, [K], and the updated running means of cosines, [K, K].

    Args:
        gramian: [K, K] float.
        target_cosines: [K, K] float, running means of the cosines of modified gradients (rows) and original ones (columns).
        orders: See `pcgrad_weights`.
        beta: See `gradvac`.
    """
    rows, lengths = jnp.arange(len(gramian)), jnp.sqrt(jnp.maximum(jnp.diagonal(gramian), 0.0))
    changed = jnp.eye(len(gramian), dtype=gramian.dtype)
    for index in range(len(gramian)):
        others = orders[:, index]
        dots = jnp.matmul(changed, gramian, precision=jax.lax.Precision.HIGHEST)
        length = jnp.sqrt(jnp.maximum(jnp.sum(dots * changed, axis=1), 0.0))
        other_lengths = lengths[others]
        # A modified gradient that almost vanishes is rounding error, without a meaningful direction.
        is_some = length > 4.0 * jnp.finfo(gramian.dtype).eps ** 0.5 * lengths
        is_pair = (others != rows) & is_some & (other_lengths > 0.0)
        safe = jnp.where(is_pair, other_lengths, 1.0)
        cosine = jnp.clip(jnp.where(is_pair, dots[rows, others] / (jnp.where(is_pair, length, 1.0) * safe), 0.0), -1.0, 1.0)
        target_cosine = target_cosines[rows, others]
        sine, target_sine = jnp.sqrt(1.0 - cosine**2), jnp.sqrt(1.0 - jnp.minimum(target_cosine**2, 1.0))
        gains = is_pair & (cosine < target_cosine) & (target_sine > 0.0)
        gain = length * (target_cosine * sine - cosine * target_sine) / (safe * jnp.where(gains, target_sine, 1.0))
        changed = changed.at[rows, others].add(jnp.where(gains, gain, 0.0))
        target_cosines = target_cosines.at[rows, others].add(jnp.where(others != rows, beta * (cosine - target_cosine), 0.0))
    return jnp.sum(changed, axis=0), target_cosines


def _random_orders(state: WeightingState, count: int) -> jax.Array:
    """Sample a random order of the losses for each loss: [K, K] int."""
    keys = jax.random.split(jax.random.fold_in(state.key, state.updates), count)
    return jax.vmap(lambda key: jax.random.permutation(key, count))(keys)
