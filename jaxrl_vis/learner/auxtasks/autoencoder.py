"""Autoencoder: reconstruction of the observation from its latent, by a decoder (thesis, 5.2.3.1)."""

import jax

from jaxrl_vis.learner.auxtasks import heads
from jaxrl_vis.learner.auxtasks.images import grey
from jaxrl_vis.learner.auxtasks.task import AuxTask, Spec, View, mean_squared_error, read
from jaxrl_vis.learner.networks.blocks import from_blocks, to_blocks
from jaxrl_vis.types import Params


def make(spec: Spec) -> AuxTask:
    """Build the autoencoder task.

    With ``spec.options.in_grey``, as in the authors' release, one grey channel of the newest image is reconstructed rather than
    all channels of the observation. Here it is the luminance of the normalised channels; the release normalises again.
    """
    in_grey = spec.options.in_grey
    channels, height, width = spec.observation.shape
    shape = (1 if in_grey else channels, height, width)
    size = (height >> spec.levels << spec.levels, width >> spec.levels << spec.levels)

    def target(view: View) -> jax.Array:
        image = read(view, "image")
        return grey(image, spec.frame_stack)[:, None] if in_grey else image

    def decode(params: Params, view: View) -> jax.Array:
        return heads.decode(params, view.latent_t, spec.dtype)

    def loss(params: Params, view: View) -> jax.Array:
        if view.patches is not None and not in_grey and heads.has_kernel(view.latent_t.shape[0], shape, spec.levels):
            return heads.decoding_error(params, view.latent_t, view.patches, spec.dtype)
        return mean_squared_error(decode(params, view), to_blocks(target(view), spec.levels))

    return AuxTask(
        name="autoencoder",
        needs=frozenset({"image"}),
        init=lambda key: heads.init_decoder(key, spec.latent_size, shape, spec.levels),
        predict=lambda params, view: from_blocks(decode(params, view), *size),
        loss=loss,
        key_index=3,
    )
