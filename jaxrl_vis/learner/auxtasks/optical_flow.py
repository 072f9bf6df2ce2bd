"""Optical flow: prediction of its magnitude at each pixel from the latents of two images, by a decoder (thesis, 5.2.3.1)."""

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.auxtasks import farneback, heads
from jaxrl_vis.learner.auxtasks.images import grey
from jaxrl_vis.learner.auxtasks.task import AuxTask, Spec, View, mean_squared_error, read
from jaxrl_vis.learner.networks.blocks import from_blocks, shift_images, to_blocks
from jaxrl_vis.learner.networks.kernels.patches import to_patches
from jaxrl_vis.types import Params


def make(spec: Spec) -> AuxTask:
    """Build the optical-flow task.

    The flow is computed once per episode, as it takes longer than the rest of a gradient step. With ``spec.options.stretch``,
    as in the authors' release, each flow image is stretched to [0, 1] (`flow_strength`).
    """
    stretch = spec.options.stretch
    _, height, width = spec.observation.shape
    size = (height >> spec.levels << spec.levels, width >> spec.levels << spec.levels)

    def both_latents(view: View) -> jax.Array:
        return jnp.concatenate([view.latent_t, read(view, "latent_tp1")], axis=-1)

    def decode(params: Params, view: View) -> jax.Array:
        return heads.decode(params, both_latents(view), spec.dtype)

    def loss(params: Params, view: View) -> jax.Array:
        if view.patches is not None and heads.has_kernel(view.latent_t.shape[0], (1, height, width), spec.levels):
            patches = to_patches(read(view, "target")[:, None].astype(spec.dtype), spec.levels)
            return heads.decoding_error(params, both_latents(view), patches, spec.dtype)
        return mean_squared_error(decode(params, view), to_blocks(read(view, "target")[:, None], spec.levels))

    return AuxTask(
        name="optical_flow",
        needs=frozenset({"latent_tp1"}),
        init=lambda key: heads.init_decoder(key, 2 * spec.latent_size, (1, height, width), spec.levels),
        predict=lambda params, view: from_blocks(decode(params, view), *size)[:, 0],
        loss=loss,
        episode=lambda images: to_bytes(flow_strength(images, spec.frame_stack, stretch), stretch),
        target=lambda batch: from_bytes(batch.stored, stretch),
        shift=lambda flow, pixels: shift_images(flow[:, None], pixels)[:, 0],
        key_index=4,
    )


_BYTES_PER_PIXEL, _MAX_BYTE = 16.0, 255.0


def to_bytes(strength: jax.Array, stretch: bool = False) -> jax.Array:
    """Quantize flow magnitudes [...] for the replay: uint8, in steps of 1/16 pixel up to 15.9; stretched ones in 255 steps."""
    return jnp.clip(jnp.round(strength * _scale(stretch)), 0.0, _MAX_BYTE).astype(jnp.uint8)


def from_bytes(flow: jax.Array, stretch: bool = False) -> jax.Array:
    """Invert `to_bytes` with the same ``stretch``, up to rounding: [...] uint8 -> [...] float32."""
    return flow.astype(jnp.float32) / _scale(stretch)


def _scale(stretch: bool) -> float:
    return _MAX_BYTE if stretch else _BYTES_PER_PIXEL


def flow_strength(images: jax.Array, frame_stack: int = 1, stretch: bool = False) -> jax.Array:
    """Compute the magnitude of the optical flow at every pixel between successive images: [T, H, W] float32, in pixels.

    Args:
        images: [T + 1, C, H, W] uint8, observations of an episode.
        frame_stack: Number of images that an observation stacks; the newest ones are used.
        stretch: Whether to stretch each flow image linearly to [0, 1], instead of pixels, as in the authors' release, whose
            grey levels also lie in [0, 1]. This discards speeds, and amplifies rounding errors if nothing moves. At such grey
            levels, Farneback's regularisation dominates (`farneback`), so that the sharpness of edges matters more than their
            speed.
    """
    flow = farneback.flow(grey(images, frame_stack) / (255.0 if stretch else 1.0))
    strength = jnp.sqrt(jnp.sum(jnp.square(flow), axis=-1))
    if not stretch:
        return strength
    low, high = (reduce(strength, axis=(1, 2), keepdims=True) for reduce in (jnp.min, jnp.max))
    # Where nothing moves at all, there is nothing to stretch.
    return jnp.where(high > low, (strength - low) / jnp.where(high > low, high - low, 1.0), 0.0)
