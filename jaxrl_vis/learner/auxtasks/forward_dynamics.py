"""Forward dynamics: prediction of the next latent from the current one and the action, by a linear layer (thesis, 5.2.3.1)."""

import jax

from jaxrl_vis.learner.auxtasks import heads
from jaxrl_vis.learner.auxtasks.task import AuxTask, Spec, View, mean_squared_error, read
from jaxrl_vis.types import Params


def make(spec: Spec) -> AuxTask:
    """Build the forward-dynamics task.

    With ``spec.options.detach`` no gradient flows through the next latent. In the authors' release it does, so that the encoder
    can reduce the loss by making all latents equal.
    """
    detach = spec.options.detach

    def predict(params: Params, view: View) -> jax.Array:
        return heads.linear(params, view.latent_t, view.action)

    def loss(params: Params, view: View) -> jax.Array:
        target = read(view, "latent_tp1")
        return mean_squared_error(predict(params, view), jax.lax.stop_gradient(target) if detach else target)

    return AuxTask(
        name="forward_dynamics",
        needs=frozenset({"latent_tp1"}),
        init=lambda key: heads.init_linear(key, spec.latent_size + spec.action_size, spec.latent_size),
        predict=predict,
        loss=loss,
        key_index=0,
    )
