"""What every auxiliary task is made from, and what it is."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.types import Params, Replaceable


@dataclasses.dataclass(frozen=True)
class Spec:
    """Sizes that the heads of auxiliary tasks adapt to.

    Attributes:
        observation: Shape [C, H, W] and dtype uint8 of one observation.
        action_size: A.
        latent_size: L, of an encoded observation.
        frame_stack: Images that an observation stacks along C, the newest first.
        levels: Strided layers of the encoder; decoders have as many.
        dtype: What decoders compute in. Their last step, linear heads and losses are float32.
    """

    observation: jax.ShapeDtypeStruct
    action_size: int
    latent_size: int
    frame_stack: int = 1
    levels: int = 4
    dtype: Any = jnp.float32


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class View(Replaceable):
    """What losses of auxiliary tasks can read of B transitions; what no task `needs` may be left out.

    Attributes:
        latent_t: [B, L] any float dtype, of the observations before the action.
        action: [B, A] float32 in [-1, 1], as executed.
        latent_tp1: [B, L] of the observations after the action.
        latent_moved: [B, L] of the observations before, rotated (`egomotion.egomotion_pair`).
        motion: [B, 1 or 3] float32 in [-1, 1], how they were rotated (and shifted).
        image: [B, C, H, W] any float dtype, the observations before, normalised as for the encoder.
        flow: [B, H, W] float32, strength of the optical flow (`optical_flow.flow_strength`).
        patches: [at least B, patches, 64 C'], ``image`` and others as `encoder_kernel.prepare` orders them, where the encoder
            reads them so: decoders, too, are kernels then (`decoder_kernel`).
    """

    latent_t: jax.Array
    action: jax.Array
    latent_tp1: jax.Array | None = None
    latent_moved: jax.Array | None = None
    motion: jax.Array | None = None
    image: jax.Array | None = None
    flow: jax.Array | None = None
    patches: jax.Array | None = None


class AuxTask(NamedTuple):
    """An auxiliary task: a head on the latents of an encoder, and its loss. Pure.

    Attributes:
        name: One of `auxtasks.NAMES`.
        needs: The optional fields of `View` that it reads.
        init: key -> parameters of its head, a nested dictionary of float32.
        predict: (parameters, View) -> what the head predicts, float32: a latent [B, L], an action [B, A], a motion [B, 1 or 3],
            an image [B, C, H, W] or a flow strength [B, H, W]. Images end where the encoder's last whole block does.
        loss: (parameters, View) -> [] float32, the mean squared error of that prediction.
    """

    name: str
    needs: frozenset[str]
    init: Callable[[jax.Array], Params]
    predict: Callable[[Params, View], jax.Array]
    loss: Callable[[Params, View], jax.Array]


def read(view: View, field: str) -> jax.Array:
    """An optional field of a view.

    Raises:
        ValueError: It was left out.
    """
    value = getattr(view, field)
    if value is None:
        raise ValueError(f"this auxiliary task needs View.{field}")
    return value


def mean_squared_error(prediction: jax.Array, target: jax.Array) -> jax.Array:
    """[] float32, over all elements of two arrays of the same shape."""
    assert prediction.shape == target.shape, (prediction.shape, target.shape)
    return jnp.mean(jnp.square(prediction.astype(jnp.float32) - target.astype(jnp.float32)))
