"""Encoder, actor and critic (OL-AUX, appendix; hyper-parameters in `Config`) as pure functions of parameters.

Observation and goal pass through the same encoder; actor and critic have one each, unless the actor shares the critic's.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.networks import normalizer
from jaxrl_vis.learner.networks.blocks import shift_images, to_blocks
from jaxrl_vis.learner.networks.kernels import encoder as encoder_kernel
from jaxrl_vis.learner.networks.modules import Encoder, Head
from jaxrl_vis.learner.networks.normalizer import Scaling
from jaxrl_vis.types import Batch, NormalizerState, Params, Statistics

# Folded into a critic's key for heads after the first. Large, because small numbers give the keys of `jax.random.split`.
_FURTHER_HEADS = 0x686473


def compute_dtype(config: Config) -> Any:
    """Return the compute dtype of a configuration's networks."""
    chosen = config.network.compute_dtype
    if chosen == "auto":
        chosen = "float32" if jax.default_backend() == "cpu" else "bfloat16"
    return jnp.dtype(chosen)


class BatchScaling(NamedTuple):
    """Scaling of observations and goals.

    Attributes:
        observations: Scaling of observations before and after the action; also of goals, unless they have their own.
        goals: Separate scaling of goals; None if they share ``observations``.
        states: Scaling of true states [P]; None if the critic does not observe them.
    """

    observations: Scaling
    goals: Scaling | None
    states: Scaling | None = None


_OBSERVED = ("before", "goal", "after")  # in the order of `Inputs.observed`

Piece = tuple[jax.Array, slice]
"""Rows of an array of prepared observations: the array (3 B rows of `Inputs.observed`, or B of a view), and their slice."""


class Inputs(NamedTuple):
    """Observations of B transitions in the form that encoders read (`Networks.prepare_batch`).

    Attributes:
        observed: [3 B, ...], observations before the action, goals, observations after the action.
        views: [B, ...] images computed by auxiliary tasks, by name.
        states: [2, B, P] true states before and after the action, each followed by the goal's; None if the critic does not
            observe them.
    """

    observed: jax.Array
    views: Mapping[str, jax.Array]
    states: jax.Array | None = None

    @property
    def states_t(self) -> jax.Array:
        """True states [B, P] before the action, and of the goal, of a critic that observes them."""
        assert self.states is not None
        return self.states[0]

    @property
    def states_tp1(self) -> jax.Array:
        """True states [B, P] after the action, and of the goal, of a critic that observes them."""
        assert self.states is not None
        return self.states[1]

    @property
    def size(self) -> int:
        """Number B of transitions."""
        return self.observed.shape[0] // len(_OBSERVED)

    def pieces(self, *names: str) -> list[Piece]:
        """Return slices of the observations ``names``, in this order; adjacent ones are merged into one slice.

        Args:
            *names: ``before``, ``goal``, ``after``, or names of views.
        """
        size, pieces = self.size, []
        for name in names:
            if name in self.views:
                pieces.append((self.views[name], slice(0, size)))
                continue
            start = _OBSERVED.index(name) * size
            if pieces and pieces[-1][0] is self.observed and pieces[-1][1].stop == start:  # neighbours are one piece
                start = pieces.pop()[1].start
            pieces.append((self.observed, slice(start, (_OBSERVED.index(name) + 1) * size)))
        return pieces


@dataclasses.dataclass(frozen=True)
class Networks:
    """Pure functions of parameters, for one task and one configuration.

    Attributes:
        config: Configuration of the run.
        observation_spec: Shape and dtype of an observation: [C, H, W] uint8 or [S] float32.
        action_size: A.
        critic_output_bias: Initial bias of the critic's output.
        critic_heads: K, number of heads of the critic on one encoder. With several, their parameters have a leading axis [K].
        critic_state_size: P, size of the true states that the critic observes instead of images; 0 if it observes what the
            actor observes.
    """

    config: Config
    observation_spec: jax.ShapeDtypeStruct
    action_size: int
    critic_output_bias: float
    critic_heads: int = 1
    critic_state_size: int = 0

    def __post_init__(self) -> None:
        """Check the image size, and the maximum shift against it.

        Raises:
            RequestError: The image is smaller than one block of the encoder or than the maximum shift; or a shift is set, but
                observations are not images.
        """
        shift = self.config.network.random_shift
        if shift and not self.sees_images:
            raise RequestError(
                f"random_shift {shift} moves images, and {self.config.environment.env} observes states: leave it out"
            )
        if self.sees_images:
            *_, height, width = self.observation_spec.shape
            minimum = 2**self._levels
            if min(height, width) < minimum:
                raise RequestError(
                    f"image_size {min(height, width)} is too small for {self._levels} encoder layers, which need at least "
                    f"{minimum}: raise --image-size or shorten --encoder-filters"
                )
            if shift >= min(height, width):
                raise RequestError(
                    f"random_shift {shift} could move images of {min(height, width)} pixels out of sight: take a few pixels, "
                    "such as --random-shift 2"
                )

    @property
    def sees_images(self) -> bool:
        """True if observations are planar images rather than state vectors."""
        return len(self.observation_spec.shape) == 3

    @property
    def shares_encoder(self) -> bool:
        """True if the actor uses the critic's encoder."""
        return self.config.network.encoders == "shared" and not self.critic_state_size

    @property
    def uses_kernel(self) -> bool:
        """True if the first layers are computed by `kernels.encoder`, one kernel on a GPU, instead of a product each."""
        return (
            self.sees_images
            and self.dtype == jnp.bfloat16
            and encoder_kernel.supports(self.config.network.encoder_filters, self.observation_spec.shape)
            and encoder_kernel.is_available()
        )

    @property
    def _levels(self) -> int:
        return len(self.config.network.encoder_filters)

    @property
    def dtype(self) -> Any:
        """Compute dtype of the networks."""
        return compute_dtype(self.config)

    @property
    def _encoder(self) -> Any:
        return Encoder(self.config.network.encoder_filters, self.config.network.latent_size, self.dtype)

    def head(self, outputs: int, output_bias: float = 0.0, stabilized: bool = False) -> Any:
        """Build a head with the configured hidden layers, a flax module; arguments as for `modules.Head`."""
        return Head(self.config.network.hidden_sizes, outputs, output_bias, self.dtype, stabilized)

    @property
    def latent_size(self) -> int:
        """Size of an encoded observation; a state vector is its own latent."""
        return self.config.network.latent_size if self.sees_images else math.prod(self.observation_spec.shape)

    def _init(self, key: jax.Array, head: Head, head_inputs: int, has_encoder: bool = True) -> Params:
        encoder_key, head_key = jax.random.split(key)
        params = {"head": head.init(head_key, jnp.zeros((1, head_inputs)))["params"]}
        if self.sees_images and has_encoder:
            params["encoder"] = self.init_encoder(encoder_key)
        return params

    def init_encoder(self, key: jax.Array) -> Params:
        """Initialise the parameters of an encoder of images, for ``{"encoder": ...}``, from a typed key []."""
        blocks = to_blocks(jnp.zeros((1, *self.observation_spec.shape)), self._levels)
        return self._encoder.init(key, blocks)["params"]

    def init_actor(self, key: jax.Array) -> Params:
        """Initialise the actor, {"encoder": ..., "head": ...}: without an encoder for states, or if it shares the critic's."""
        return self._init(key, self.head(self.action_size, 0.0), 2 * self.latent_size, has_encoder=not self.shares_encoder)

    def init_critic(self, key: jax.Array) -> Params:
        """Initialise the critic, {"encoder": ..., "head": ...}: without an encoder for states; K > 1 heads are stacked."""
        head = self.head(1, self.critic_output_bias)
        width = self.action_size + (self.critic_state_size or 2 * self.latent_size)
        critic = self._init(key, head, width, has_encoder=not self.critic_state_size)
        if self.critic_heads == 1:
            return critic
        keys = jax.random.split(jax.random.fold_in(key, _FURTHER_HEADS), self.critic_heads - 1)
        others = [head.init(own, jnp.zeros((1, width)))["params"] for own in keys]
        return {**critic, "head": jax.tree.map(lambda *leaves: jnp.stack(leaves), critic["head"], *others)}

    def init_target(self, online: Params) -> Params:
        """Copy online parameters for a target network: only the head if targets have no encoders."""
        copied = online if self.config.network.target_encoder else {"head": online["head"]}
        return jax.tree.map(jnp.copy, copied)  # a donated buffer must not appear twice

    def with_encoder(self, params: Params, other: Params) -> Params:
        """Return ``params`` with the encoder of ``other``, unless they have their own or ``other`` has none."""
        if "encoder" in params or "encoder" not in other:
            return params
        return {**params, "encoder": other["encoder"]}

    def compute_copy(self, params: Params) -> Params:
        """Copy the large kernels in the compute dtype; None for all parameters that are used unconverted.

        Together with `with_compute_copy`, copying when parameters change saves the networks a conversion at every use.
        """

        def copy(path: Any, leaf: jax.Array) -> jax.Array | None:
            stays = leaf.ndim < 2 or leaf.dtype == self.dtype or any(entry.key == "output" for entry in path)
            return None if stays else leaf.astype(self.dtype)

        return jax.tree_util.tree_map_with_path(copy, params)

    def with_compute_copy(self, params: Params, copy: Params) -> Params:
        """Substitute compute copies for parameters; all methods accept the result like the original parameters."""
        return jax.tree.map(
            lambda converted, leaf: leaf if converted is None else converted, copy, params, is_leaf=lambda leaf: leaf is None
        )

    def scaling(self, statistics: NormalizerState) -> Scaling:
        """Return the scaling that `prepare` and `normalize` take."""
        return Scaling(statistics.mean, normalizer.scale(statistics, self.config.network.normalizer_floor))

    def batch_scaling(self, statistics: Statistics) -> BatchScaling:
        """Return the scaling that `prepare_batch` takes. It stays the same for all gradient steps of an iteration."""
        of_goals = None if statistics.own_goals is None else self.scaling(statistics.own_goals)
        of_states = None if statistics.states is None else self.scaling(statistics.states)
        return BatchScaling(self.scaling(statistics.observations), of_goals, of_states)

    def prepare_batch(self, scaling: BatchScaling, batch: Batch) -> Inputs:
        """Apply `prepare` to all observations of B transitions."""
        of_observations, of_goals, of_states = scaling
        states = None if of_states is None else self._normalize(_with_goals(batch), *of_states)
        views = {name: self.prepare(of_observations, images, batch.shift) for name, images in batch.views.items()}
        if of_goals is None:  # together, and while they are bytes
            count, size, *shape = batch.observations.shape
            shift = None if batch.shift is None else jnp.tile(batch.shift, (count, 1))
            together = self.prepare(of_observations, batch.observations.reshape(count * size, *shape), shift)
            return Inputs(together, views, states)
        scalings = (of_observations, of_goals, of_observations)
        pieces = [self.prepare(own, rows, batch.shift) for own, rows in zip(scalings, batch.observations, strict=True)]
        return Inputs(jnp.concatenate(pieces), views, states)

    def prepare(self, scaling: Scaling, observations: jax.Array, shift: jax.Array | None = None) -> jax.Array:
        """Normalise and reorder observations [B, ...] for the encoders, once for all networks, in the compute dtype.

        The result is [B, blocks, block size], or [B, patches, patch size] for the kernel, or [B, S] for states.

        Images are shifted by ``shift`` [B, 2] int32 (see `Batch`) after normalisation, so they are padded with the mean.
        """
        mean, scale = scaling
        if not self.sees_images:
            return self._normalize(observations, mean, scale)
        if self.uses_kernel:
            limit = self.config.network.normalizer_clip
            return encoder_kernel.prepare(observations, mean, scale, self._levels, limit, self.dtype, shift)
        if shift is not None:
            return to_blocks(shift_images(self._normalize(observations, mean, scale), shift), self._levels)
        return self._normalize(*(to_blocks(array, self._levels) for array in (observations, mean, scale)))

    def normalize(self, scaling: Scaling, observations: jax.Array, shift: jax.Array | None = None) -> jax.Array:
        """Normalise like `prepare`, without reordering: [B, ...] in the compute dtype."""
        normalized = self._normalize(observations, *scaling)
        return normalized if shift is None else shift_images(normalized, shift)

    def _normalize(self, observations: jax.Array, mean: jax.Array, scale: jax.Array) -> jax.Array:
        limit = self.config.network.normalizer_clip
        return jnp.clip((observations.astype(jnp.float32) - mean) * scale, -limit, limit).astype(self.dtype)

    def encode(self, params: Params, inputs: jax.Array, selection: slice = slice(None)) -> jax.Array:
        """Encode prepared observations: [B, latent]; a state vector is its own latent.

        Args:
            params: Parameters of the actor or critic; only ``encoder`` is read.
            inputs: Observations from `prepare`.
            selection: Slice of their first axis that is encoded, of length B.
        """
        return self.encode_pieces(params, [(inputs, selection)])

    def encode_pieces(self, params: Params, pieces: Sequence[Piece]) -> jax.Array:
        """Encode slices of several arrays of prepared observations; concatenate the latents: [B, latent]."""
        if not self.sees_images:
            return jnp.concatenate([inputs[selection] for inputs, selection in pieces])
        if not self.uses_kernel:
            return self._encoder.apply({"params": params["encoder"]}, *(inputs[selection] for inputs, selection in pieces))
        channels = self.observation_spec.shape[0]
        weights = encoder_kernel.make_weights(params["encoder"], channels)
        features = [encoder_kernel.encode(inputs, weights, selection) for inputs, selection in pieces]
        finer = 4 ** (self._levels - encoder_kernel.LEVELS)
        blocks = [part.reshape(part.shape[0], part.shape[1] // finer, finer * part.shape[2]) for part in features]
        return self._encoder.apply({"params": params["encoder"]}, *blocks, first_layer=encoder_kernel.LEVELS)

    def act(self, actor: Params, latents: jax.Array) -> jax.Array:
        """Compute actions [B, A] float32 in [-1, 1] from latents [2, B, latent] of observations and goals."""
        return jnp.tanh(self.head(self.action_size, 0.0).apply({"params": actor["head"]}, latents))

    def values(self, critic: Params, observed: jax.Array, action: jax.Array) -> jax.Array:
        """Compute each head's values [K, B] float32 of actions [B, A].

        ``observed`` are latents [2, B, latent] as for `act`, or normalised true states [B, P] (`Inputs.states`) for a critic
        that observes these.
        """
        if self.critic_heads == 1:
            return self._value(critic["head"], observed, action)[None]
        return jax.vmap(self._value, (0, None, None))(critic["head"], observed, action)

    def value(self, critic: Params, observed: jax.Array, action: jax.Array) -> jax.Array:
        """Compute the first head's values [B] float32; arguments as for `values`."""
        head = critic["head"]
        first = head if self.critic_heads == 1 else jax.tree.map(lambda leaf: leaf[0], head)
        return self._value(first, observed, action)

    def _value(self, head: Params, observed: jax.Array, action: jax.Array) -> jax.Array:
        return self.head(1, self.critic_output_bias).apply({"params": head}, observed, action)[..., 0]


def _with_goals(batch: Batch) -> jax.Array:
    """Append the goal's true state to those before and after the action: [2, B, P]."""
    assert batch.full_states is not None
    goals = jnp.broadcast_to(batch.goal_state, (len(batch.full_states), *batch.goal_state.shape))
    return jnp.concatenate([batch.full_states, goals], axis=-1)
