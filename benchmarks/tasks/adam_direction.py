"""OL-AUX-5 that compares auxiliary gradients with the direction in which Adam moves for the main loss.

--weighting benchmarks.tasks.adam_direction:ol_aux_5_adam

A step of Adam changes the main loss by the inner product of its gradient with P g, where g is the whole gradient and P divides
by the root of the mean squared gradients. OL-AUX (equation 5.9 of the thesis) assumes gradient descent, P = 1. Here each
auxiliary gradient is compared with P g_main, scaled to the norm of g_main, so that beta keeps its meaning.
"""

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.types import Metrics, Params
from jaxrl_vis.weighting import MAIN, Weighting, WeightingState
from jaxrl_vis.weighting.base import Losses, Weights, dot, scale_tree, start, weight_metrics, weighted_sum, zeros_for
from jaxrl_vis.weighting.ol_aux import make_rule

INTERVAL, LEARNING_RATE = 5, 1e-3
DECAY, EPS = 0.999, 1e-8  # of Adam's mean squared gradients


def ol_aux_5_adam() -> Weighting:
    """Build the weighting; its ``init`` needs the shared parameters, and its state has their mean squared gradients."""
    move = make_rule("ol_aux_5_adam", INTERVAL, LEARNING_RATE, None, 0.0)

    def init(names: Iterable[str], shared: Params = None) -> WeightingState:
        others = [name for name in names if name != MAIN]
        squares = zeros_for("ol_aux_5_adam", (MAIN,), shared)[MAIN]
        return start(others, dict.fromkeys(others, 1.0), sums={name: jnp.zeros(()) for name in others}, memory=squares)

    def update(losses: Losses, statistics: Any, state: WeightingState) -> tuple[Weights, WeightingState, Metrics]:
        gradients = {name: scale_tree(statistics[name], slope) for name, slope in weighting.slopes(losses).items()}
        total = weighted_sum(gradients, state.weights)
        squares = jax.tree.map(lambda old, new: DECAY * old + (1.0 - DECAY) * new**2, state.memory, total)
        direction = adam_direction(gradients[MAIN], squares, state.updates + 1)
        dots = {name: dot(direction, gradients[name]) for name in state.sums}
        sums = jax.tree.map(jnp.add, state.sums, dots)
        after = move(state, scale_tree(sums, 1.0 / INTERVAL), sums, memory=squares)
        return state.weights, after, weight_metrics(state.weights, dots)

    weighting = Weighting(
        "ol_aux_5_adam", init, update, needs="gradients", log=True, eps=0.02, main_eps=1e-8, interval=INTERVAL
    )
    return weighting


def adam_direction(gradient: Params, squares: Params, updates: jax.Array) -> Params:
    """Divide a gradient by the root of mean squared gradients, and scale it back to its own norm.

    Args:
        gradient: Tree of the gradient.
        squares: Exponential moving average of the squared gradients, a tree of the same structure.
        updates: [] int32, number of updates of ``squares``, at least 1, for the correction of its bias.
    """
    correction = 1.0 - DECAY ** updates.astype(jnp.float32)
    direction = jax.tree.map(lambda leaf, square: leaf / (jnp.sqrt(square / correction) + EPS), gradient, squares)
    norm = jnp.sqrt(dot(gradient, gradient) / jnp.maximum(dot(direction, direction), jnp.finfo(jnp.float32).tiny))
    return scale_tree(direction, norm)
