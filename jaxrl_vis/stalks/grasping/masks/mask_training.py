"""Training of the generator, against a discriminator as in pix2pix or as a plain segmentation, on the same data.

gan             the discriminator classifies paintings as true or generated; the generator minimises the adversarial loss plus
                100 times the mean absolute difference from the true painting
segmentation    cross entropy and Dice loss of the mask

Threads render examples while the network is trained on those that already exist.
"""

import dataclasses
import functools
import time
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxrl_vis.stalks.grasping.masks.examples import Example
from jaxrl_vis.stalks.grasping.masks.mask_networks import Discriminator
from jaxrl_vis.stalks.grasping.masks.painter import Settings, compute_dtype, normalize
from jaxrl_vis.stalks.grasping.masks.variation import augment
from jaxrl_vis.stalks.phenotyping.detector.losses import mask_loss
from jaxrl_vis.stalks.phenotyping.training.pool import Pool
from jaxrl_vis.stalks.phenotyping.training.updates import Report, run_updates

_NEAR_TRUTH = 100.0
"""Weight of the mean absolute difference, as in pix2pix."""
_RED = (1.0, -1.0, -1.0)


@dataclasses.dataclass(frozen=True)
class Plan:
    """Schedule of the generator's training.

    Attributes:
        steps: Maximum number of updates.
        minutes: Maximum duration in minutes, including compilation and rendering of the first images; None for no limit.
        images: Maximum number of images in the pool.
        first: Number of images to render before the first update.
        batch: Number of crops per update.
        crop: Height and width of a crop, pixels.
        rate: Peak learning rate of the generator.
        ema_decay: Decay rate of the exponential moving average of the generator's parameters; lower in the first updates.
        seed: Seed of initialisation, crops and augmentation.
    """

    steps: int = 20_000
    minutes: float | None = None
    images: int = 800
    first: int = 16
    batch: int = 16
    crop: int = 384
    rate: float = 1e-3
    ema_decay: float = 0.998
    seed: int = 0


def sample_crops(examples: list[Example], rng: np.random.Generator, count: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample a batch of crops at random positions.

    Args:
        examples: Examples to sample from, with replacement.
        rng: Random number generator.
        count: Number of crops N.
        size: Height and width of the crops, pixels; smaller images are padded with black at the bottom and right.

    Returns:
        Images [N, size, size, 3] uint8 and masks [N, size, size] bool.
    """
    images = np.zeros((count, size, size, 3), np.uint8)
    masks = np.zeros((count, size, size), bool)
    for index, number in enumerate(rng.integers(len(examples), size=count)):
        example = examples[number]
        top, left = (int(rng.integers(max(length - size, 0) + 1)) for length in example.mask.shape)
        part = example.image[top : top + size, left : left + size]
        images[index, : part.shape[0], : part.shape[1]] = part
        masks[index, : part.shape[0], : part.shape[1]] = example.mask[top : top + size, left : left + size]
    return images, masks


@functools.partial(jax.jit, static_argnames=("settings", "dtype"), donate_argnums=0)
def _update(state: Any, batch: Any, key: jax.Array, rates: tuple[jax.Array, jax.Array], settings: Settings, dtype: Any):
    """Perform one update, on an augmented batch.

    Args:
        state: Parameters of the generator, their average, parameters of the discriminator (None for segmentation), and the
            optimiser states of both; donated.
        batch: Crops and their masks, see `sample_crops`.
        key: Typed key of the augmentation.
        rates: Learning rate and decay rate of the average.
        settings: Settings of the generator.
        dtype: Compute dtype of the networks.

    Returns:
        The new state, and the losses by name.
    """
    generator, average, discriminator, moments = state
    rate, decay = rates
    images, masks = augment(batch[0], batch[1], key)
    network, judge, values = settings.generator(dtype), Discriminator(dtype=dtype), normalize(images)
    true = jnp.where(masks[..., None], jnp.array(_RED), values)

    def generator_loss(params: Any):
        painted = network.apply(params, values)
        assert isinstance(painted, jax.Array)
        if settings.loss == "segmentation":
            loss = mask_loss(painted[..., 0], masks)
            return loss, ({"mask": loss}, painted)
        verdict = judge.apply(discriminator, values, painted)
        assert isinstance(verdict, jax.Array)
        adversarial = optax.sigmoid_binary_cross_entropy(verdict, jnp.ones_like(verdict)).mean()
        difference = jnp.abs(painted - true).mean()
        return adversarial + _NEAR_TRUTH * difference, ({"adversarial": adversarial, "difference": difference}, painted)

    gradients, (parts, painted) = jax.grad(generator_loss, has_aux=True)(generator)
    updates, first = _optimizer().update(gradients, moments[0], generator)
    generator = jax.tree.map(lambda old, change: old + rate * change, generator, updates)
    average = jax.tree.map(lambda old, new: decay * old + (1.0 - decay) * new, average, generator)
    if settings.loss == "segmentation":
        return (generator, average, None, (first, None)), parts

    def discriminator_loss(params: Any) -> jax.Array:
        verdicts = [judge.apply(params, values, painting) for painting in (true, jax.lax.stop_gradient(painted))]
        losses = [
            optax.sigmoid_binary_cross_entropy(verdict, jnp.full_like(verdict, wanted)).mean()  # pyright: ignore
            for verdict, wanted in zip(verdicts, (1.0, 0.0))
        ]
        return 0.5 * (losses[0] + losses[1])

    loss, gradients = jax.value_and_grad(discriminator_loss)(discriminator)
    updates, second = _optimizer().update(gradients, moments[1], discriminator)
    # As in pix2pix, the discriminator learns at half the speed.
    discriminator = jax.tree.map(lambda old, change: old + 0.5 * rate * change, discriminator, updates)
    return (generator, average, discriminator, (first, second)), {**parts, "discriminator": loss}


def _optimizer() -> optax.GradientTransformation:
    # The learning rate is applied outside, because it depends on the elapsed time.
    return optax.chain(optax.clip_by_global_norm(5.0), optax.adam(1.0, b1=0.5))


def _init_state(settings: Settings, crop: int, key: jax.Array) -> Any:
    """Return the initial state of `_update`."""
    painter, judge = jax.random.split(key)
    blank = jnp.zeros((1, crop, crop, 3))
    generator = settings.generator(jnp.float32).init(painter, blank)
    average = jax.tree.map(jnp.array, generator)
    if settings.loss == "segmentation":
        return generator, average, None, (_optimizer().init(generator), None)
    discriminator = Discriminator().init(judge, blank, blank)
    return generator, average, discriminator, (_optimizer().init(generator), _optimizer().init(discriminator))


def train(
    sources: list[Iterator[Example]], settings: Settings, plan: Plan, report: Report, report_interval: float = 30.0
) -> tuple[Any, int]:
    """Train a generator.

    Args:
        sources: Iterators over examples, each read by its own thread.
        settings: Settings of the generator, including its loss.
        plan: Schedule of the training.
        report: Callback for reports, see `Report`.
        report_interval: Minimum interval between reports, s.

    Returns:
        The averaged parameters of the generator, and the number of updates.

    Raises:
        NonFiniteError: A loss is not finite when it is to be reported.
        RequestError: The time limit was reached before the first update.
    """
    started = time.monotonic()
    rng = np.random.default_rng(plan.seed)
    start_key, steps_key = jax.random.split(jax.random.key(plan.seed))
    dtype = compute_dtype()
    pool = Pool(sources, plan.images)
    state: Any = None

    def update(step: int, rates: tuple[jax.Array, jax.Array]) -> tuple[dict[str, jax.Array], Any]:
        nonlocal state
        batch = sample_crops(pool.examples, rng, plan.batch, plan.crop)
        state, parts = _update(state, batch, jax.random.fold_in(steps_key, step), rates, settings, dtype)
        return parts, state[1]

    try:
        state = _init_state(settings, plan.crop, start_key)
        pool.fill(plan.first)
        step = run_updates(update, pool, plan, started, report, report_interval)
    finally:
        pool.close()
    return state[1], step
