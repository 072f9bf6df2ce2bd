"""Inverse dynamics: prediction of the action from two successive latents, by a linear layer (thesis, 5.2.3.1)."""

import jax

from jaxrl_vis.learner.auxtasks import heads
from jaxrl_vis.learner.auxtasks.task import AuxTask, Spec, View, mean_squared_error, read
from jaxrl_vis.types import Params


def make(spec: Spec) -> AuxTask:
    """Build the inverse-dynamics task."""

    def predict(params: Params, view: View) -> jax.Array:
        return heads.linear(params, view.latent_t, read(view, "latent_tp1"))

    return AuxTask(
        name="inverse_dynamics",
        needs=frozenset({"latent_tp1"}),
        init=lambda key: heads.init_linear(key, 2 * spec.latent_size, spec.action_size),
        predict=predict,
        loss=lambda params, view: mean_squared_error(predict(params, view), view.action),
        key_index=1,
    )
