"""Training on a few dozen to a few hundred annotated images: goes on from weights, and stops where held-out images say so.

    read -> split by photograph -> compile -> updates, with a look at held-out images between them -> the best weights

Minutes are those of updates: what is read and compiled before is timed apart. Layers near the pixels stay as they are where
there are weights to start from, as a few images are too few to learn them from.
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
    beginning,
    image_batch,
    initial_networks,
    update_networks,
)
from jaxrl_vis.stalks.phenotyping.training.examples import Example, cut_out, resized_snips
from jaxrl_vis.stalks.phenotyping.training.held_out import Finds, find_in, score
from jaxrl_vis.stalks.phenotyping.training.photographs import Split

FROZEN = ("stem", "fine")
"""Layers that stay as they are where there are weights to start from."""
_WARM_UP = 50  # updates until the rate is highest
_STRIP, _BESIDE = 256, 3.0  # columns of what is learned from at once: pixels, and widths of the widest box
_HEARTBEAT = 10.0  # s between signs of life of what takes long

Say = Callable[[str], None]
"""Called with a line about what goes on."""


@dataclasses.dataclass(frozen=True)
class Tuning:
    """Schedule.

    Attributes:
        steps: Most updates.
        minutes: Most minutes of updates; None for no limit.
        batch: Images per update.
        snips: Snips per update; 0 where masks are not learned.
        rate: Highest learning rate.
        look: Updates between looks at held-out images.
        patience: Looks without a better score until training ends.
        seed: Seed of everything random.
    """

    steps: int
    minutes: float | None
    batch: int
    snips: int
    rate: float
    look: int = 25
    patience: int = 8
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Tuned:
    """Result of a training.

    Attributes:
        params: Parameters with ``detector`` and ``segmenter``.
        steps: Update that they are of.
        made: Number of updates that were made.
        why: Reason for the end.
        before, after: Finds in each image of the report, with the weights of the beginning and of the end.
        compile_s, update_s: Time of compilation, and of updates and looks, s.
    """

    params: Any
    steps: int
    made: int
    why: str
    before: list[Finds]
    after: list[Finds]
    compile_s: float
    update_s: float


def tune(
    examples: Sequence[Example],
    parts: Split,
    settings: Settings,
    tuning: Tuning,
    start: Any,
    say: Say,
    keep: Callable[[Any, int], None] = lambda params, step: None,
) -> Tuned:
    """Train networks on annotated images.

    Args:
        examples: All images.
        parts: Split of them.
        settings: Settings of the networks.
        tuning: Schedule.
        start: Parameters to go on from; None for random ones.
        say: See `Say`.
        keep: Called with the best parameters so far and their update, so that a training that is stopped leaves them.

    Raises:
        NonFiniteError: A loss is not finite any more.
    """
    dtype = jnp.bfloat16 if jax.default_backend() in ("gpu", "tpu") else jnp.float32
    frozen = ((*FROZEN,) if start is not None else ()) + (() if tuning.snips else ("segmenter",))
    detector_key, segmenter_key, steps_key = jax.random.split(jax.random.key(tuning.seed), 3)
    state = beginning(start if start is not None else initial_networks(settings, detector_key, segmenter_key))
    shape = padded_shape(_largest(examples))
    batches = _Batches([examples[place] for place in parts.train], shape, tuning)
    stop, test = ([examples[place] for place in part] for part in (parts.stop, parts.test))

    began = time.monotonic()
    words = f"compiling for images of {shape[1]} x {shape[0]} pixels on {jax.default_backend()}"
    with heartbeat(words, say):
        zeros = jnp.float32(0.0), jnp.float32(0.0)
        update = update_networks.lower(state, batches.draw(), steps_key, zeros, settings, dtype, frozen).compile()
        before = find_in(state[1]["detector"], test, shape, settings, dtype)
    compile_s = time.monotonic() - began
    say(f"compiled in {compile_s:.0f} s; --minutes count from here")

    watch = _Watch(stop, shape, settings, dtype, state[1], tuning.patience)
    if stop:
        say(f"before: score {watch.best:.3f} on {len(stop)} images that decide when to stop")
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
        told = step == 1 or time.monotonic() - last > _HEARTBEAT
        if told or step % tuning.look == 0:
            values = {name: float(value) for name, value in losses.items()}
            if not np.isfinite(list(values.values())).all():
                raise NonFiniteError(f"a loss is not finite at step {step}: try a lower --rate")
            line = "  ".join(f"{name} {value:.3f}" for name, value in values.items())
            looked = watch.look(state[1], step) if step % tuning.look == 0 else ""
            if step % tuning.look == 0 and (watch.step == step or not stop):
                keep(state[1], step)
            say(f"{(time.monotonic() - started) / 60:5.1f} min  {progress:4.0%}  step {step}  {line}{looked}")
            last = time.monotonic()
        if watch.over:
            why = f"the score has not become better for {tuning.patience * tuning.look} updates"
            break
    if stop and step % tuning.look:
        watch.look(state[1], step)
    params, best = (watch.params, watch.step) if stop else (state[1], step)
    update_s = time.monotonic() - started
    after = find_in(params["detector"], test, shape, settings, dtype)
    return Tuned(jax.device_get(params), best, step, why, before, after, compile_s, update_s)


class _Watch:
    """Looks at held-out images and keeps the best weights; those of the beginning count, too."""

    def __init__(
        self, examples: list[Example], shape: tuple[int, int], settings: Settings, dtype: Any, params: Any, patience: int
    ) -> None:
        self._examples, self._about, self._patience = examples, (shape, settings, dtype), patience
        self.params, self.step, self._since = jax.tree.map(jnp.copy, params), 0, 0
        self.best = self._score(params)

    def _score(self, params: Any) -> float:
        return score(find_in(params["detector"], self._examples, *self._about)).soft if self._examples else 0.0

    def look(self, params: Any, step: int) -> str:
        """Look at the images with other weights; return what to say of it."""
        if not self._examples:
            return ""
        now = self._score(params)
        self._since += 1
        if now > self.best:
            # Updates donate what they are given.
            self.best, self.step, self._since, self.params = now, step, 0, jax.tree.map(jnp.copy, params)
        return f"  held out {now:.3f}" + ("" if self._since else ", the best so far")

    @property
    def over(self) -> bool:
        """True where the score has not become better for long."""
        return bool(self._examples) and self._since >= self._patience


class _Batches:
    """Batches of images and snips, drawn at random."""

    def __init__(self, examples: list[Example], shape: tuple[int, int], tuning: Tuning) -> None:
        self._examples, self._tuning = examples, tuning
        # All lines, as the height of a find is a matter of what is above and below it.
        widest = max(float((stalk[2] - stalk[0]).max()) for stalk in (example.stalks.T for example in examples))
        self._shape = shape[0], min(shape[1], padded_shape((1, max(_STRIP, round(_BESIDE * widest))))[1])
        self._rng = np.random.default_rng(tuning.seed)
        self._snips, self._masks = _alike(examples) if tuning.snips else (np.zeros(0), np.zeros(0))

    def draw(self) -> Any:
        """Draw a batch, as `update_networks` takes it."""
        chosen = [
            cut_out(self._examples[place], self._shape, self._rng)
            for place in self._rng.integers(len(self._examples), size=self._tuning.batch)
        ]
        strips = None
        if len(self._snips):
            places = self._rng.integers(len(self._snips), size=self._tuning.snips)
            strips = self._snips[places], self._masks[places]
        return image_batch(chosen, self._shape), strips


def _alike(examples: list[Example]) -> tuple[np.ndarray, np.ndarray]:
    """Return snips [N, H, W, 3] uint8 and masks [N, H, W] bool of all examples, resized to the size in the middle of theirs."""
    shapes = sorted(example.snips.shape[1:3] for example in examples for _ in example.snips)
    if not shapes:
        return np.zeros((0, 8, 8, 3), np.uint8), np.zeros((0, 8, 8), bool)
    lines, columns = shapes[len(shapes) // 2]
    alike = [resized_snips(example, (lines, columns)) for example in examples if len(example.snips)]
    return np.concatenate([each.snips for each in alike]), np.concatenate([each.masks for each in alike])


def _largest(examples: Sequence[Example]) -> tuple[int, int]:
    lines, columns = (max(example.image.shape[axis] for example in examples) for axis in (0, 1))
    return lines, columns


@contextlib.contextmanager
def heartbeat(words: str, say: Say) -> Iterator[None]:
    """Say every ten seconds that something is still going on."""
    over, began = threading.Event(), time.monotonic()

    def beat() -> None:
        while not over.wait(_HEARTBEAT):
            say(f"{words}: {time.monotonic() - began:.0f} s")

    say(f"{words} ...")
    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
