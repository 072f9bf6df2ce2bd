"""Line search of `scalar_newton` in scalars: the step length of minimum cost."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.physics.scalar.sparse_algebra import Column

MAX_STEPS = 10
"""Maximum number of evaluations of the slope along a line."""
_TOLERANCE = 1e-5  # relative change of the step length below which an episode has converged
_UNBOUNDED = 1e30


def minimize_along_line(
    slope_at: Callable[[Any], tuple[Any, Any]],
    corners: Column,
    like: Any,
    max_steps: int = MAX_STEPS,
    active: Any = None,
) -> Any:
    """Minimize a convex cost along a line by Newton steps within a shrinking bracket.

    A step that leaves the bracket, or is not shorter than half of the previous step, is replaced by the corner nearest to the
    middle of the bracket, or by the middle if there are no corners. Without corners, the search would forever step over a slope
    that changes only within a short interval, as that of dry friction does.

    Args:
        slope_at: Function from a step length to the cost's slope and curvature there; the slope at 0 is not positive.
        corners: Step lengths at which the curvature jumps.
        like: Scalar with the shape and dtype of the batch.
        max_steps: Number of evaluations of ``slope_at``; with ``active``, their maximum.
        active: Inside a kernel, a mask of the episodes whose result is used: the search ends, after at least two steps, once it
            has converged for all of these. None outside of kernels; all steps are then taken.

    Returns:
        Step length at the end of the final bracket with the smaller absolute slope.
    """

    def narrow(_: Any, state: tuple[Any, ...]) -> tuple[Any, ...]:
        length, before, low, low_slope, high, high_slope = state
        slope, curvature = slope_at(length)
        is_low = slope <= 0
        low, low_slope = jnp.where(is_low, length, low), jnp.where(is_low, slope, low_slope)
        high, high_slope = jnp.where(is_low, high, length), jnp.where(is_low, high_slope, slope)
        step = -slope / jnp.where(curvature > 0, curvature, 1.0)  # 0 where every direction is level
        onward, middle = length + step, 0.5 * (low + high)
        converges = (onward > low) & (onward < high) & (jnp.abs(step) < 0.5 * before) | (high == _UNBOUNDED) | (step == 0)
        nearest, distance = middle, 0.499 * (high - low)  # excludes, despite rounding, corners that are ends of the bracket
        for corner in corners:
            away = jnp.abs(corner - middle)
            is_nearer = away < distance
            nearest, distance = jnp.where(is_nearer, corner, nearest), jnp.where(is_nearer, away, distance)
        proposal = jnp.where(converges, onward, nearest)
        return proposal, jnp.abs(proposal - length), low, low_slope, high, high_slope

    start = 0.0 * like
    unbounded = start + _UNBOUNDED
    state = (start, unbounded, start, -unbounded, unbounded, unbounded)
    if active is not None:
        # The loop ends when all episodes of the warp have converged.
        def continues(counted: tuple[Any, ...]) -> Any:
            step, length, change, *_ = counted
            moves = active & (change > _TOLERANCE * jnp.abs(length))
            return (step < max_steps) & ((step < 2) | (jnp.max(jnp.where(moves, 1, 0)) > 0))

        counted = jax.lax.while_loop(continues, lambda counted: (counted[0] + 1, *narrow(0, counted[1:])), (0, *state))
        state = counted[1:]
    else:
        state = jax.lax.fori_loop(0, max_steps, narrow, state)
    _, _, low, low_slope, high, high_slope = state
    return jnp.where(high_slope < -low_slope, high, low)
