"""Interface of an auxiliary task, and the records that it reads.

A task is a head on the latents of an encoder, and a loss. It declares its inputs beyond the latents of an observation:

    needs      latents and images that are shared with other tasks                                `View`
    episode    arrays that are computed once per episode and stored with it in the replay         [T, ...] for its T steps
    view       images of its own to be encoded, recomputed for each batch, together with its target
    target     target computed from a batch and from the arrays of ``episode``
"""

import dataclasses
import zlib
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.types import Params, Replaceable

Border = Literal["clip", "zero"]
"""Treatment of the empty corners of a rotated image. ``clip``: the image is cropped to the largest rectangle of its aspect
ratio without empty corners, and scaled to its original size, as in the thesis. ``zero``: filled with 0, as in the authors'
release."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options in which the thesis and the authors' release differ: the defaults follow the thesis, `RELEASE` the release.

    Attributes:
        detach: Whether forward dynamics stops the gradient through the next latent. Unspecified in the thesis; not in the
            release.
        border: Treatment of the empty corners of a rotated image.
        max_shift: Maximum shift applied after a rotation, as a fraction of the image's size.
        in_grey: Whether the autoencoder reconstructs one grey channel rather than the observation.
        stretch: Whether the magnitude of the optical flow is stretched to [0, 1] in each image, rather than being in pixels.
    """

    detach: bool = True
    border: Border = "clip"
    max_shift: float = 0.0
    in_grey: bool = False
    stretch: bool = False


RELEASE = Options(detach=False, border="zero", max_shift=0.1, in_grey=True, stretch=True)
"""Options of the authors' release, where a shift of 0.1 is 10 of 100 pixels."""


@dataclasses.dataclass(frozen=True)
class Spec:
    """Sizes and options that auxiliary tasks are built for.

    Attributes:
        observation: Shape [C, H, W] and dtype uint8 of one observation.
        action_size: A.
        latent_size: L, size of an encoded observation.
        frame_stack: Number of images that an observation stacks along C, the newest first.
        levels: Number of strided layers of the encoder; decoders have as many.
        dtype: Compute dtype of decoders. Their last step, linear heads and losses are float32.
        options: Differences between the thesis and the release.
    """

    observation: jax.ShapeDtypeStruct
    action_size: int
    latent_size: int
    frame_stack: int = 1
    levels: int = 4
    dtype: Any = jnp.float32
    options: Options = Options()


class Transitions(NamedTuple):
    """Batch of B sampled transitions, before images are shifted or normalised.

    Attributes:
        images_t: [B, C, H, W] uint8, observations before the action.
        images_tp1: [B, C, H, W] uint8, observations after the action.
        action: [B, A] float32 in [-1, 1], as executed.
        stored: [B, ...] result of `AuxTask.episode` for these steps; None if the task has none.
    """

    images_t: jax.Array
    images_tp1: jax.Array
    action: jax.Array
    stored: jax.Array | None = None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class View(Replaceable):
    """Inputs of an auxiliary task's loss for B transitions; those that the task does not declare may be None.

    Attributes:
        latent_t: [B, L] any float dtype, of the observations before the action.
        action: [B, A] float32 in [-1, 1], as executed.
        latent_tp1: [B, L] of the observations after the action.
        image: [B, C, H, W] any float dtype, the observations before, normalised as for the encoder.
        latent_view: [B, L] of the images from the task's own ``view``.
        target: Target from the task's own ``view`` or ``target``.
        patches: [at least B, patches, 64 C'], ``image`` and others in the order of `kernels.encoder.prepare`, if the encoder
            reads them in this form: decoders can then be kernels, too (`kernels.decoder`). None otherwise.
    """

    latent_t: jax.Array
    action: jax.Array
    latent_tp1: jax.Array | None = None
    image: jax.Array | None = None
    latent_view: jax.Array | None = None
    target: Any = None
    patches: jax.Array | None = None


class AuxTask(NamedTuple):
    """Auxiliary task: a head on the latents of an encoder, and its loss. Pure.

    Attributes:
        name: Unique among the tasks of a run; names its head, its metrics and its weight.
        init: key -> parameters of its head, a nested dictionary of float32.
        predict: (parameters, View) -> prediction of the head, float32: a latent [B, L], an action [B, A], a motion [B, 1 or 3],
            an image [B, C, H, W] or a flow magnitude [B, H, W]. Images end where the encoder's last whole block does.
        loss: (parameters, View) -> [] float32, such as the mean squared error of that prediction.
        needs: Optional fields of `View` that it reads, out of ``latent_tp1`` and ``image``.
        episode: [T + 1, C, H, W] uint8, images of an episode -> [T, ...] uint8 or float32. Computed once, when an episode is
            collected, because a transition is usually sampled several times. None if nothing is stored.
        view: (key, Transitions) -> (images [B, C, H, W] uint8 to be encoded, target). The images are shifted like the batch.
            None if the task has no images of its own.
        target: Transitions -> target, for tasks without ``view``; None if the loss needs no target.
        shift: (target, [B, 2] int32 pixels) -> target for images shifted by this down and to the right; None if the target does
            not change.
        key_index: Integer (uint32) folded into the task's random keys, so that its samples do not depend on the other tasks;
            None for a digest of the name.
        uses_batch_key: Whether ``view`` uses the batch's own key, which only one task may do.
    """

    name: str
    init: Callable[[jax.Array], Params]
    predict: Callable[[Params, View], jax.Array]
    loss: Callable[[Params, View], jax.Array]
    needs: frozenset[str] = frozenset()
    episode: Callable[[jax.Array], jax.Array] | None = None
    view: Callable[[jax.Array, Transitions], tuple[jax.Array, Any]] | None = None
    target: Callable[[Transitions], Any] | None = None
    shift: Callable[[Any, jax.Array], Any] | None = None
    key_index: int | None = None
    uses_batch_key: bool = False

    def fold(self, key: jax.Array) -> jax.Array:
        """Derive the task's own key from a key that all tasks share, [] each."""
        return jax.random.fold_in(key, zlib.crc32(self.name.encode()) if self.key_index is None else self.key_index)


def read(view: View, field: str) -> jax.Array:
    """Return an optional field of a view.

    Raises:
        ValueError: The field is None.
    """
    value = getattr(view, field)
    if value is None:
        raise ValueError(f"this auxiliary task needs View.{field}")
    return value


def mean_squared_error(prediction: jax.Array, target: jax.Array) -> jax.Array:
    """Return the mean squared error of all elements of two arrays of the same shape, [] float32."""
    assert prediction.shape == target.shape, (prediction.shape, target.shape)
    return jnp.mean(jnp.square(prediction.astype(jnp.float32) - target.astype(jnp.float32)))
