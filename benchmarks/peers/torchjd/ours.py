"""Results of our weightings for the Jacobians of `jacobians`, in float64, in the format of `peer`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrl_vis.weighting as jw
from jaxrl_vis.weighting import loss_values, surgery
from jaxrl_vis.weighting.directions import graddrop_direction

STCH_MU, CAGRAD_RADIUS, FAIR_ALPHA, VAC_BETA = 0.2, 0.5, 2.0, 0.3  # as in `peer`
DIRECTIONS = ("uniform", "sum", "imtl_g", "aligned_mtl", "config")
"""Methods in closed form; the direction [SIZE] is compared."""
SOLVED: dict[str, jw.Weighting] = {
    "mgda": jw.mgda(),
    "cagrad": jw.cagrad(CAGRAD_RADIUS),
    "fairgrad": jw.fairgrad(FAIR_ALPHA),
    "upgrad": jw.upgrad(),
    "dualproj": jw.dualproj(),
    "nash_mtl": jw.nash_mtl(),
}
"""Methods with a solver; directions are compared, and the residuals of the weights [K]."""
READERS: dict[str, jw.Weighting] = {
    "geometric_mean": jw.geometric_mean(eps=1e-14),
    "stch": jw.stch(STCH_MU),
    "uncertainty": jw.uncertainty(1e-2),
    "imtl_l": jw.imtl_l(1e-2),
    "dwa": jw.dwa(epoch=2),
    "famo": jw.famo(),
}
"""Methods that read losses; the weights [STEPS, K] are compared."""


def names_of(count: int) -> tuple[str, ...]:
    """Return the names of K losses, in the order of the arrays' loss axis."""
    return tuple(f"loss_{index}" for index in range(count))


def weights_function(weighting: jw.Weighting, count: int) -> Callable[[jax.Array], jax.Array]:
    """Return the function from a Jacobian [K, SIZE] to the weights [K] of the first step."""
    names = names_of(count)

    def weights(jacobian: jax.Array) -> jax.Array:
        gradients = dict(zip(names, jacobian, strict=True))
        losses = dict.fromkeys(names, jnp.ones(()))
        step, _, _ = weighting.update(losses, jw.measure(weighting, losses, gradients), weighting.init(names))
        assert isinstance(step, dict)
        return jnp.stack([step[name] for name in names])

    return weights


def path_function(weighting: jw.Weighting, count: int) -> Callable[[jax.Array], jax.Array]:
    """Return the function from losses [STEPS, K] to weights [STEPS, K]."""
    names = names_of(count)

    def path(losses: jax.Array) -> jax.Array:
        def step(state: Any, values: jax.Array) -> Any:
            weights, state, _ = weighting.update(dict(zip(names, values, strict=True)), None, state)
            assert isinstance(weights, dict)
            return state, jnp.stack([weights[name] for name in names])

        return jax.lax.scan(step, weighting.init(names), losses)[1]

    return path


def gradvac_with_state(jacobian: jax.Array, orders: jax.Array) -> jax.Array:
    """Compute the direction [P] of GradVac's second step from a Jacobian [K, P] and the orders [K, K] of its losses."""
    gramian, usual, weights = jacobian @ jacobian.T, jnp.zeros(2 * (len(jacobian),)), jnp.zeros(len(jacobian))
    for _ in range(2):
        weights, usual = surgery.gradvac_weights(gramian, usual, orders, VAC_BETA)
    return weights @ jacobian


def results(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Compute the results of all methods for the arrays of `jacobians.draw`, by ``K/NAME``; needs 64-bit JAX.

    Returns:
        Weights [n, K] of the methods in `SOLVED`, weights [n, STEPS, K] of those in `READERS`, directions [n, SIZE] of others.
    """
    directions: dict[str, Any] = {}
    for count in sorted({int(name.split("/")[0]) for name in arrays}):
        jacobians, orders = (jnp.asarray(arrays[f"{count}/{name}"]) for name in ("jacobians", "orders"))
        for name in DIRECTIONS:
            one = weights_function(jw.make_weighting(name), count)
            directions[f"{count}/{name}"] = jax.jit(jax.vmap(lambda jacobian, one=one: one(jacobian) @ jacobian))(jacobians)
        for name, weighting in SOLVED.items():
            directions[f"{count}/{name}"] = jax.jit(jax.vmap(weights_function(weighting, count)))(jacobians)
        for name, weighting in READERS.items():
            path = jax.jit(jax.vmap(path_function(weighting, count)))
            directions[f"{count}/{name}"] = path(jnp.asarray(arrays[f"{count}/losses"]))
        drawn: dict[str, Any] = {
            "pcgrad": lambda jacobian, order: surgery.pcgrad_weights(jacobian @ jacobian.T, order) @ jacobian,
            "gradvac": gradvac_with_state,
            "graddrop": lambda jacobian, uniform: graddrop_direction(
                dict(zip(names_of(len(jacobian)), jacobian, strict=True)), uniform
            ),
            "random": lambda jacobian, normal: loss_values.random_weights(normal) @ jacobian,
        }
        noise = {"graddrop": "uniform", "random": "normal"}
        for name, function in drawn.items():
            inputs = jnp.asarray(arrays[f"{count}/{noise[name]}"]) if name in noise else orders
            directions[f"{count}/{name}"] = jax.jit(jax.vmap(function))(jacobians, inputs)
    return {name: np.asarray(value) for name, value in directions.items()}
