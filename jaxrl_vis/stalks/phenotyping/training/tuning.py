"""Fine-tuning on a few dozen to a few hundred annotated images, with early stopping on held-out images.

    read -> split by photograph -> compile -> updates, with evaluations on held-out images in between -> the best weights

The time limit applies to updates and evaluations only: reading and compilation are timed separately. When starting from trained
weights, the first layers are frozen, as a few images are too few to train them.
"""

import contextlib
import dataclasses
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.errors import NonFiniteError
from jaxrl_vis.stalks.phenotyping.detector.detect import Settings, padded_shape
from jaxrl_vis.stalks.phenotyping.training.detector_training import (
    batch_images,
    init_networks,
    init_state,
    update_networks,
)
from jaxrl_vis.stalks.phenotyping.training.examples import Example, crop_randomly, resize_crops
from jaxrl_vis.stalks.phenotyping.training.held_out import ImageDetections, detect_in_examples, score_detections
from jaxrl_vis.stalks.phenotyping.training.photographs import Split

FROZEN = ("stem", "fine")
"""Prefixes of the names of layers that are frozen when starting from trained weights."""
_WARM_UP = 50  # updates of linear warm-up of the learning rate
_STRIP, _BESIDE = 256, 3.0  # minimum width of training crops: pixels, and multiples of the widest box
_HEARTBEAT = 10.0  # s between progress messages of long operations

ProgressCallback = Callable[[str], None]
"""Callback that is called with a line of text on the progress."""


@dataclasses.dataclass(frozen=True)
class Tuning:
    """Fine-tuning schedule.

    Attributes:
        steps: Maximum number of updates.
        minutes: Maximum duration of updates and evaluations in minutes; None for no limit.
        batch: Batch size of images.
        crops: Batch size of stalk crops; 0 if masks are not trained.
        rate: Peak learning rate.
        evaluation_interval: Number of updates between evaluations on held-out images.
        patience: Number of evaluations without improvement after which training stops.
        seed: Random seed.
    """

    steps: int
    minutes: float | None
    batch: int
    crops: int
    rate: float
    evaluation_interval: int = 25
    patience: int = 8
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class TuningResult:
    """Result of fine-tuning.

    Attributes:
        params: Best averaged parameters, with keys ``detector`` and ``segmenter``; the last ones without images for early
            stopping.
        best_step: Number of updates after which these parameters were reached.
        updates: Total number of updates.
        stop_reason: Reason why training ended.
        before, after: Detections in each test image with the initial and the resulting parameters.
        compile_s, update_s: Durations of compilation, and of updates and evaluations, s.
    """

    params: Any
    best_step: int
    updates: int
    stop_reason: str
    before: list[ImageDetections]
    after: list[ImageDetections]
    compile_s: float
    update_s: float


def tune(
    examples: Sequence[Example],
    split: Split,
    settings: Settings,
    tuning: Tuning,
    start: Any,
    echo: ProgressCallback,
    keep: Callable[[Any, int], None] = lambda params, step: None,
) -> TuningResult:
    """Fine-tune the networks on annotated images.

    Args:
        examples: Examples of all images.
        split: Split of the examples.
        settings: Settings of the networks.
        tuning: Fine-tuning schedule.
        start: Initial parameters, whose first layers are frozen; None for random initialisation.
        echo: Progress callback, see `ProgressCallback`.
        keep: Called with the best parameters so far and the number of updates that led to them, so that they survive an
            interruption. Without images for early stopping, called with the latest parameters at each evaluation.

    Returns:
        Result, whose parameters are on the host: those with the best score on the images for early stopping, which may be the
        initial ones, or the last ones without such images.

    Raises:
        NonFiniteError: A loss is not finite when it is reported or held-out images are evaluated.
    """
    dtype = jnp.bfloat16 if jax.default_backend() in ("gpu", "tpu") else jnp.float32
    frozen = ((*FROZEN,) if start is not None else ()) + (() if tuning.crops else ("segmenter",))
    detector_key, segmenter_key, steps_key = jax.random.split(jax.random.key(tuning.seed), 3)
    state = init_state(start if start is not None else init_networks(settings, detector_key, segmenter_key))
    shape = padded_shape(_largest(examples))
    batches = _Batches([examples[place] for place in split.train], shape, tuning)
    stop, test = ([examples[place] for place in part] for part in (split.stop, split.test))

    began = time.monotonic()
    words = f"compiling for images of {shape[1]} x {shape[0]} pixels on {jax.default_backend()}"
    with heartbeat(words, echo):
        zeros = jnp.float32(0.0), jnp.float32(0.0)
        update = update_networks.lower(state, batches.draw(), steps_key, zeros, settings, dtype, frozen).compile()
        before = detect_in_examples(state[1]["detector"], test, shape, settings, dtype)
    compile_s = time.monotonic() - began
    echo(f"compiled in {compile_s:.0f} s; --minutes count from here")

    watch = _EarlyStopping(stop, shape, settings, dtype, state[1], tuning.patience)
    if stop:
        echo(f"before: score {watch.best:.3f} on {len(stop)} images that decide when to stop")
    started, step, why = time.monotonic(), 0, f"{tuning.steps} updates are made"
    last = started
    while step < tuning.steps:
        elapsed = time.monotonic() - started
        progress = max(step / tuning.steps, elapsed / (60.0 * tuning.minutes) if tuning.minutes else 0.0)
        if step and progress >= 1.0:
            why = f"{tuning.minutes:g} minutes are over"
            break
        rate = tuning.rate * min((step + 1) / _WARM_UP, 1.0) * 0.5 * (1.0 + np.cos(np.pi * progress))
        rates = jnp.float32(rate), jnp.float32(min(0.99, (1.0 + step) / (10.0 + step)))
        state, losses = update(state, batches.draw(), jax.random.fold_in(steps_key, step), rates)
        step += 1
        reports = step == 1 or time.monotonic() - last > _HEARTBEAT
        if reports or step % tuning.evaluation_interval == 0:
            values = {name: float(value) for name, value in losses.items()}
            if not np.isfinite(list(values.values())).all():
                raise NonFiniteError(f"a loss is not finite at step {step}: try a lower --rate")
            line = "  ".join(f"{name} {value:.3f}" for name, value in values.items())
            looked = watch.evaluate(state[1], step) if step % tuning.evaluation_interval == 0 else ""
            if step % tuning.evaluation_interval == 0 and (watch.step == step or not stop):
                keep(state[1], step)
            echo(f"{(time.monotonic() - started) / 60:5.1f} min  {progress:4.0%}  step {step}  {line}{looked}")
            last = time.monotonic()
        if watch.should_stop:
            why = f"the score has not become better for {tuning.patience * tuning.evaluation_interval} updates"
            break
    if stop and step % tuning.evaluation_interval:
        watch.evaluate(state[1], step)
    params, best = (watch.params, watch.step) if stop else (state[1], step)
    update_s = time.monotonic() - started
    after = detect_in_examples(params["detector"], test, shape, settings, dtype)
    return TuningResult(jax.device_get(params), best, step, why, before, after, compile_s, update_s)


class _EarlyStopping:
    """Early stopping on held-out images, which keeps the parameters with the best soft F1 (`Score.soft`).

    Without held-out images nothing is evaluated, and ``params`` remain the initial ones: do not use them.

    Args:
        examples: Held-out images; may be empty.
        shape: Height and width to which images are padded.
        settings: Settings of the networks.
        dtype: Compute dtype of the convolutions.
        params: Initial parameters, evaluated at once.
        patience: Number of evaluations without improvement after which training should stop.

    Attributes:
        params: Copy of the best parameters so far, which may be the initial ones.
        step: Update after which they were reached; 0 for the initial ones.
        best: Their soft F1; 0 without held-out images.
    """

    def __init__(
        self, examples: list[Example], shape: tuple[int, int], settings: Settings, dtype: Any, params: Any, patience: int
    ) -> None:
        self._examples, self._about, self._patience = examples, (shape, settings, dtype), patience
        self.params, self.step, self._since = jax.tree.map(jnp.copy, params), 0, 0
        self.best = self._score(params)

    def _score(self, params: Any) -> float:
        return (
            score_detections(detect_in_examples(params["detector"], self._examples, *self._about)).soft
            if self._examples
            else 0.0
        )

    def evaluate(self, params: Any, step: int) -> str:
        """Evaluate new parameters and return text for the progress line, empty without held-out images."""
        if not self._examples:
            return ""
        now = self._score(params)
        self._since += 1
        if now > self.best:
            # Copy, as updates donate their input buffers.
            self.best, self.step, self._since, self.params = now, step, 0, jax.tree.map(jnp.copy, params)
        return f"  held out {now:.3f}" + ("" if self._since else ", the best so far")

    @property
    def should_stop(self) -> bool:
        """True if the score has not improved for ``patience`` evaluations."""
        return bool(self._examples) and self._since >= self._patience


class _Batches:
    """Sampler of random batches of images and stalk crops."""

    def __init__(self, examples: list[Example], shape: tuple[int, int], tuning: Tuning) -> None:
        self._examples, self._tuning = examples, tuning
        # Crops span the full height, as the vertical extent of a box depends on what is above and below it.
        widest = max(float((stalk[2] - stalk[0]).max()) for stalk in (example.stalks.T for example in examples))
        self._shape = shape[0], min(shape[1], padded_shape((1, max(_STRIP, round(_BESIDE * widest))))[1])
        self._rng = np.random.default_rng(tuning.seed)
        self._crops, self._masks = _stack_crops(examples) if tuning.crops else (np.zeros(0), np.zeros(0))

    def draw(self) -> Any:
        """Sample a batch for `update_networks`."""
        chosen = [
            crop_randomly(self._examples[place], self._shape, self._rng)
            for place in self._rng.integers(len(self._examples), size=self._tuning.batch)
        ]
        strips = None
        if len(self._crops):
            places = self._rng.integers(len(self._crops), size=self._tuning.crops)
            strips = self._crops[places], self._masks[places]
        return batch_images(chosen, self._shape), strips


def _stack_crops(examples: list[Example]) -> tuple[np.ndarray, np.ndarray]:
    """Return the stalk crops [N, H, W, 3] uint8 and masks [N, H, W] bool of all examples, resized to one size.

    The size is the median one of all crops; N is 0 if there are none.
    """
    shapes = sorted(example.crops.shape[1:3] for example in examples for _ in example.crops)
    if not shapes:
        return np.zeros((0, 8, 8, 3), np.uint8), np.zeros((0, 8, 8), bool)
    rows, columns = shapes[len(shapes) // 2]
    alike = [resize_crops(example, (rows, columns)) for example in examples if len(example.crops)]
    return np.concatenate([example.crops for example in alike]), np.concatenate([example.masks for example in alike])


def _largest(examples: Sequence[Example]) -> tuple[int, int]:
    rows, columns = (max(example.image.shape[axis] for example in examples) for axis in (0, 1))
    return rows, columns


@contextlib.contextmanager
def heartbeat(message: str, echo: ProgressCallback) -> Iterator[None]:
    """Report progress through ``echo`` at the start and every ten seconds while the context is active."""
    over, began = threading.Event(), time.monotonic()

    def beat() -> None:
        while not over.wait(_HEARTBEAT):
            echo(f"{message}: {time.monotonic() - began:.0f} s")

    echo(f"{message} ...")
    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
