"""The optimisation of both networks, for a number of steps or of minutes, whichever ends first.

Examples are made by threads while the networks already learn from those that are there, so that an accelerator does not wait.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxrl_vis.stalks.phenotyping.detector.detect import Settings, initial, padded_shape
from jaxrl_vis.stalks.phenotyping.detector.detector_networks import Segmenter
from jaxrl_vis.stalks.phenotyping.detector.losses import detector_loss, segmenter_loss
from jaxrl_vis.stalks.phenotyping.training.augment import move, relight, vary_snips
from jaxrl_vis.stalks.phenotyping.training.examples import Example
from jaxrl_vis.stalks.phenotyping.training.pool import Pool
from jaxrl_vis.stalks.phenotyping.training.updates import Report, repeat


@dataclasses.dataclass(frozen=True)
class Plan:
    """Schedule of the networks' training.

    Attributes:
        steps: Most updates.
        minutes: Most minutes of updates, compilation included; None for no limit.
        images: Number of images to learn from.
        first: With how many the updates begin.
        batch: Images per update.
        snips: Snips per update.
        rate: Highest learning rate.
        average: Average of the weights over updates: the share of the old ones.
        seed: Seed of everything random.
    """

    steps: int = 20_000
    minutes: float | None = None
    images: int = 800
    first: int = 24
    batch: int = 8
    snips: int = 32
    rate: float = 1e-3
    average: float = 0.998
    seed: int = 0


Images = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Images [N, H, W, 3] uint8, stalks [N, T, 6] float32, kinds [N, T] int32 and sizes [N, 2] int32 of images without padding."""


def image_batch(examples: Sequence[Example], shape: tuple[int, int]) -> Images:
    """Stack the images of examples, padded below and on the right to a ``shape`` (lines, columns), and their stalks."""
    sizes = np.array([example.image.shape[:2] for example in examples], np.int32)
    images = np.zeros((len(examples), *shape, 3), np.uint8)
    for image, example in zip(images, examples):
        image[: example.image.shape[0], : example.image.shape[1]] = example.image
    stalks, kinds = (np.stack([getattr(example, name) for example in examples]) for name in ("stalks", "kinds"))
    return images, stalks, kinds, sizes


class _Pool(Pool[Example]):
    """Examples of images and of snips, drawn from at random."""

    def __init__(self, sources: list[Iterator[Example]], plan: Plan) -> None:
        self._plan = plan
        self.snips: list[tuple[int, int]] = []
        self._largest = (0, 0)
        super().__init__(sources, plan.images)

    def add(self, example: Example) -> None:
        """Keep an example and its snips."""
        height, width = example.image.shape[:2]
        self._largest = max(self._largest[0], height), max(self._largest[1], width)
        self.snips += [(len(self.examples), place) for place in range(len(example.snips))]
        super().add(example)

    def images(self, rng: np.random.Generator) -> Images:
        """A batch of images, padded to the largest that there were so far, with their stalks, kinds and sizes."""
        chosen = [self.examples[place] for place in rng.integers(len(self.examples), size=self._plan.batch)]
        return image_batch(chosen, padded_shape(self._largest))

    def strips(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray] | None:
        """A batch of snips with their masks; None where there are no snips yet."""
        if not self.snips:
            return None
        # All of one size: in a folder of images of several, those that are as large as one of them.
        shape = self.examples[self.snips[rng.integers(len(self.snips))][0]].snips.shape[1:3]
        alike = [place for place in self.snips if self.examples[place[0]].snips.shape[1:3] == shape]
        chosen = [alike[place] for place in rng.integers(len(alike), size=self._plan.snips)]
        return (
            np.stack([self.examples[image].snips[place] for image, place in chosen]),
            np.stack([self.examples[image].masks[place] for image, place in chosen]),
        )


State = tuple[Any, Any, Any]
"""Parameters, their average over updates, and the optimiser's state."""


@functools.partial(jax.jit, static_argnames=("settings", "dtype", "frozen"), donate_argnums=0)
def update_networks(
    state: State,
    batch: Any,
    key: jax.Array,
    rates: tuple[jax.Array, jax.Array],
    settings: Settings,
    dtype: Any,
    frozen: tuple[str, ...] = (),
) -> tuple[State, dict[str, jax.Array]]:
    """Update both networks once.

    Args:
        state: See `beginning`; donated.
        batch: `Images`, and snips with their masks, or None where masks are not learned.
        key: For augmentation and for the boxes that the head sees.
        rates: Learning rate, and share of the old weights that stays in the average.
        settings: Settings of the networks.
        dtype: In which convolutions are computed.
        frozen: Beginnings of the names of layers, or of a network, that stay as they are.

    Returns:
        The new state, and the parts of the loss by name.
    """
    params, average, moments = state
    rate, share = rates
    (images, stalks, kinds, sizes), strips = batch
    places, light, near, variation = jax.random.split(key, 4)
    images, stalks, kinds = move(images, stalks, kinds, sizes, places)
    images = relight(images, light)

    def loss(params):
        params = _map_frozen(jax.lax.stop_gradient, params, frozen)
        total, parts = detector_loss(params["detector"], images, stalks, kinds, settings, dtype, near)
        if strips is None:
            return total, parts
        snips, masks = vary_snips(strips[0], strips[1], variation)
        of_masks = segmenter_loss(params["segmenter"], snips, masks, settings, dtype)
        return total + of_masks, {**parts, "masks": of_masks}

    gradients, parts = jax.grad(loss, has_aux=True)(params)
    updates, moments = _optimiser().update(gradients, moments, params)
    updates = _map_frozen(jnp.zeros_like, updates, frozen)  # without a gradient, weights would still decay
    params = jax.tree.map(lambda old, change: old + rate * change, params, updates)
    average = jax.tree.map(lambda old, new: share * old + (1.0 - share) * new, average, params)
    return (params, average, moments), parts


def _map_frozen(function: Callable[[jax.Array], jax.Array], tree: Any, frozen: tuple[str, ...]) -> Any:
    """Apply a function to the leaves of which a name on the way to them begins with one of ``frozen``."""

    def change(path: Any, leaf: jax.Array) -> jax.Array:
        return function(leaf) if any(str(step.key).startswith(frozen) for step in path) else leaf

    return jax.tree_util.tree_map_with_path(change, tree) if frozen else tree


def beginning(params: Any) -> State:
    """Return the state before the first update of parameters with ``detector`` and ``segmenter``."""
    params = jax.tree.map(lambda leaf: jnp.array(leaf, jnp.float32), params)
    return params, *_beginning(params)


@jax.jit
def _beginning(params: Any) -> tuple[Any, Any]:
    """The average of parameters before the first update, and the optimiser's state."""
    return jax.tree.map(jnp.copy, params), _optimiser().init(params)  # a donated buffer must not appear twice


def initial_networks(settings: Settings, detector_key: jax.Array, segmenter_key: jax.Array) -> dict[str, Any]:
    """Draw parameters of both networks."""
    blank = jax.ShapeDtypeStruct((1, 32, 32, 3), jnp.float32)
    return {
        "detector": initial(settings, detector_key),
        "segmenter": Segmenter(settings.segmenter).lazy_init(segmenter_key, blank),
    }


def _optimiser() -> optax.GradientTransformation:
    # The rate is applied outside, as it follows the clock.
    return optax.chain(optax.clip_by_global_norm(5.0), optax.adamw(1.0, weight_decay=1e-4))


def train(
    sources: list[Iterator[Example]], settings: Settings, plan: Plan, report: Report, every: float = 30.0, start: Any = None
) -> tuple[Any, int]:
    """Train the networks.

    Args:
        sources: Iterators over examples; each is read by a thread of its own.
        settings: Settings of the networks.
        plan: Schedule.
        report: See `Report`.
        every: Interval of reports, s.
        start: Parameters to go on from, as they are returned; None: random ones.

    Returns:
        Parameters with ``detector`` and ``segmenter``, and the number of updates.

    Raises:
        NonFiniteError: A loss is not finite any more.
        RequestError: The time was over before the first update.
    """
    started = time.monotonic()
    rng = np.random.default_rng(plan.seed)
    root = jax.random.key(plan.seed)
    dtype = jnp.bfloat16 if jax.default_backend() in ("gpu", "tpu") else jnp.float32
    pool = _Pool(sources, plan)
    detector_key, segmenter_key, steps_key = jax.random.split(root, 3)
    state = beginning(initial_networks(settings, detector_key, segmenter_key) if start is None else start)

    def update(step: int, rates: tuple[jax.Array, jax.Array]) -> tuple[dict[str, jax.Array], Any] | None:
        nonlocal state
        strips = pool.strips(rng)
        if strips is None:
            return None
        batch, key = (pool.images(rng), strips), jax.random.fold_in(steps_key, step)
        state, parts = update_networks(state, batch, key, rates, settings, dtype)
        return parts, state[1]

    try:
        pool.fill(plan.first)
        step = repeat(update, pool, plan, started, report, every)
    finally:
        pool.close()
    return state[1], step
