"""Weightings of several losses that share parameters: a self-contained library based on JAX and optax alone.

    import jaxrl_vis.weighting as jw

    weighting = jw.make_weighting("upgrad")                     # or jw.upgrad()
    gradient = jw.weighted_grad(losses_fn, weighting, shared)   # losses_fn: (params, ...) -> {name: loss}
    state = weighting.init(names, shared(params))
    result = gradient(params, state, ...)                       # result.gradient for the optimiser, result.state

base            the interface, `Weighting`, and the logarithm of a loss
constant        constant weights; cosine
ol_aux          OL-AUX; `ol_aux_variants`: the rule of the authors' release, and the ablation of figure 5.7
loss_values     weightings that read only the losses' values
gramian_based   weightings that need the inner products of all gradients; also `surgery` and `learned`. `solvers`: their solvers
directions      weightings that need whole gradients, and return a direction
limits          bounds on the weights, and logging of cosines, for any weighting
registry        all weightings by name
gradients       `weighted_grad`: weighted gradient of any dictionary of losses
"""

from jaxrl_vis.weighting.base import MAIN, Direction, Weighting, WeightingState, weighted_sum
from jaxrl_vis.weighting.constant import balance, cosine, fixed, none, none_log, plain_sum
from jaxrl_vis.weighting.directions import db_mtl, graddrop, moco
from jaxrl_vis.weighting.gradients import GradientMode, Weighted, gramian, loss_gradients, measure, weighted_grad
from jaxrl_vis.weighting.gramian_based import aligned_mtl, cagrad, config, dualproj, fairgrad, imtl_g, mgda, nash_mtl, upgrad
from jaxrl_vis.weighting.learned import auxinash, gradnorm
from jaxrl_vis.weighting.limits import limited, with_cosines
from jaxrl_vis.weighting.loss_values import dwa, famo, geometric_mean, imtl_l, random, stch, uncertainty, uniform
from jaxrl_vis.weighting.ol_aux import ol_aux
from jaxrl_vis.weighting.ol_aux_variants import ol_aux_ablation, ol_aux_window
from jaxrl_vis.weighting.registry import WEIGHTINGS, make_weighting
from jaxrl_vis.weighting.surgery import gradvac, pcgrad

__all__ = [
    "MAIN",
    "WEIGHTINGS",
    "Direction",
    "GradientMode",
    "Weighted",
    "Weighting",
    "WeightingState",
    "aligned_mtl",
    "auxinash",
    "balance",
    "cagrad",
    "config",
    "cosine",
    "db_mtl",
    "dualproj",
    "dwa",
    "fairgrad",
    "famo",
    "fixed",
    "geometric_mean",
    "graddrop",
    "gradnorm",
    "gradvac",
    "gramian",
    "imtl_g",
    "imtl_l",
    "limited",
    "loss_gradients",
    "make_weighting",
    "measure",
    "mgda",
    "moco",
    "nash_mtl",
    "none",
    "none_log",
    "ol_aux",
    "ol_aux_ablation",
    "ol_aux_window",
    "pcgrad",
    "plain_sum",
    "random",
    "stch",
    "uncertainty",
    "uniform",
    "upgrad",
    "weighted_grad",
    "weighted_sum",
    "with_cosines",
]
