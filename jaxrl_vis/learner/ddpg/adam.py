"""Adam (Kingma and Ba, 2015) for several networks at once: `optax.adam` with its states, in fewer GPU kernels.

XLA fuses the steps of all arrays of one shape, of any network, into one kernel if these steps read a common array; a scalar is
not enough. The bias corrections, which change at each step, are therefore one array for all networks and both moments
(`corrections`), while optax has a scalar for each.
"""

from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxrl_vis.types import Params

# Decay rates of both moments, and the constant in the denominator; defaults of optax.
_DECAYS = (0.9, 0.999)
_SMALL = 1e-8


def init(params: Params) -> Any:
    """Return optax's state before the first step."""
    return optax.adam(0.0).init(params)


def count(state: Any) -> jax.Array:
    """Return the number of steps that a state has taken, [] int32."""
    return state[0].count


def with_count(state: Any, steps: jax.Array) -> Any:
    """Return the state with its `count` replaced by ``steps``, [] int32."""
    return (state[0]._replace(count=steps), *state[1:])


def corrections(counts: jax.Array) -> jax.Array:
    """Return the bias corrections of the first and the second moment: divisors [N, 2] float32.

    Args:
        counts: [N] int32, steps of N networks, from 1.
    """
    return 1.0 - jnp.array(_DECAYS, jnp.float32) ** counts[:, None]


def step(params: Params, gradient: Params, state: Any, learning_rate: float, correction: jax.Array) -> tuple[Params, Any]:
    """Take one step of one network; return new parameters, and a state with new moments and the old `count`.

    Args:
        params: Parameters, float32.
        gradient: Gradient, float32.
        state: State of optax; its `count` is not read.
        learning_rate: Learning rate.
        correction: [2] float32, a row of `corrections`.
    """
    moments = state[0]
    first, second = (_update_average(*terms, gradient) for terms in zip(_DECAYS, (1, 2), (moments.mu, moments.nu), strict=True))

    def update_leaf(leaf: jax.Array, mean: jax.Array, square: jax.Array) -> jax.Array:
        return leaf - learning_rate * (mean / correction[0] / (jnp.sqrt(square / correction[1]) + _SMALL))

    return jax.tree.map(update_leaf, params, first, second), (moments._replace(mu=first, nu=second), *state[1:])


def _update_average(decay: float, order: int, moment: Params, gradient: Params) -> Params:
    return jax.tree.map(lambda average, slope: (1.0 - decay) * slope**order + decay * average, moment, gradient)
