"""Where a cost is least along a line, number by number (`algebra`): the length of a step of `descent`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.physics.algebra import Numbers

STEPS = 10
"""Points of the line at which a slope is computed."""
_STILL = 1e-5  # a change of a step's length, relative to it, that changes nothing
_ENDLESS = 1e30


def lowest(
    slope_at: Callable[[Any], tuple[Any, Any]],
    corners: Numbers,
    like: Any,
    steps: int = STEPS,
    matters: Any = None,
) -> Any:
    """Where a convex cost along a line is least, after a few steps that narrow the range where that can be.

    A step goes to where Newton's method leads; where that is out of the range, or no less far than half of the step before, to
    the corner next to the middle of the range, or to the middle if there are no corners. Without these, a slope that turns
    within a short stretch between two flat ones, as that of dry friction does, is jumped over for ever.

    Args:
        slope_at: The cost's slope, not positive at 0, and its curvature, at a length.
        corners: Lengths at which the curvature jumps.
        like: A number of the batch.
        steps: How many at most.
        matters: In a kernel, for which episodes: steps end, after two of them, where they move none of these any more.
    """

    def narrow(_: Any, state: tuple[Any, ...]) -> tuple[Any, ...]:
        length, before, low, low_slope, high, high_slope = state
        slope, curvature = slope_at(length)
        is_low = slope <= 0
        low, low_slope = jnp.where(is_low, length, low), jnp.where(is_low, slope, low_slope)
        high, high_slope = jnp.where(is_low, high, length), jnp.where(is_low, high_slope, slope)
        step = -slope / jnp.where(curvature > 0, curvature, 1.0)  # 0 where every direction is level
        onward, middle = length + step, 0.5 * (low + high)
        converges = (onward > low) & (onward < high) & (jnp.abs(step) < 0.5 * before) | (high == _ENDLESS) | (step == 0)
        nearest, distance = middle, 0.499 * (high - low)  # not the corner that is an end of the range, but for rounding
        for corner in corners:
            away = jnp.abs(corner - middle)
            is_nearer = away < distance
            nearest, distance = jnp.where(is_nearer, corner, nearest), jnp.where(is_nearer, away, distance)
        there = jnp.where(converges, onward, nearest)
        return there, jnp.abs(there - length), low, low_slope, high, high_slope

    start = 0.0 * like
    endless = start + _ENDLESS
    state = (start, endless, start, -endless, endless, endless)
    if matters is not None:
        # No further than until all episodes of the warp are there.
        def goes_on(counted: tuple[Any, ...]) -> Any:
            step, length, change, *_ = counted
            moves = matters & (change > _STILL * jnp.abs(length))
            return (step < steps) & ((step < 2) | (jnp.max(jnp.where(moves, 1, 0)) > 0))

        counted = jax.lax.while_loop(goes_on, lambda counted: (counted[0] + 1, *narrow(0, counted[1:])), (0, *state))
        state = counted[1:]
    else:
        state = jax.lax.fori_loop(0, steps, narrow, state)
    _, _, low, low_slope, high, high_slope = state
    return jnp.where(high_slope < -low_slope, high, low)
