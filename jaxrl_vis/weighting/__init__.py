"""Weightings of auxiliary losses beside the main one. A leaf: knows neither DDPG nor environments.

base        the interface, `Weighting`, and the logarithm of a loss
constant    weights that are given, or follow from one step
ol_aux      weights that learn; `ol_aux_variants`: as in the authors' release, and the ablation of figure 5.7
registry    all of them by name
gradients   `weighted_grad`: anybody's losses and parameters, differentiated, weighted and added up
"""

from jaxrl_vis.weighting.base import MAIN, Weighting, WeightingState, weighted_sum
from jaxrl_vis.weighting.gradients import Way, Weighted, loss_gradients, measure, weighted_grad
from jaxrl_vis.weighting.registry import WEIGHTINGS, make_weighting

__all__ = [
    "MAIN",
    "WEIGHTINGS",
    "Way",
    "Weighted",
    "Weighting",
    "WeightingState",
    "loss_gradients",
    "make_weighting",
    "measure",
    "weighted_grad",
    "weighted_sum",
]
