"""Updates for a number of steps or of minutes, whichever ends first, on examples that are made meanwhile."""

import time
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.errors import NonFiniteError, RequestError
from jaxrl_vis.stalks.phenotyping.training.pool import Pool

Report = Callable[[int, float, int, dict[str, float], Any], None]
"""Called now and then with the step, progress from 0 to 1, how many images there are, losses, and the weights so far."""

Update = Callable[[int, tuple[jax.Array, jax.Array]], tuple[dict[str, jax.Array], Any] | None]
"""(step, (learning rate, share of the old weights that stays in the average)) -> (losses, averaged weights); or None where
there is nothing to learn from yet."""


class Schedule(Protocol):
    """A schedule of training: most updates and minutes, number of examples to begin with, highest rate, share of the mean."""

    @property
    def steps(self) -> int: ...  # noqa: D102
    @property
    def minutes(self) -> float | None: ...  # noqa: D102
    @property
    def rate(self) -> float: ...  # noqa: D102
    @property
    def average(self) -> float: ...  # noqa: D102


def repeat(update: Update, pool: Pool, plan: Schedule, started: float, report: Report, every: float) -> int:
    """Update until the plan's steps or minutes are over.

    Args:
        update: Makes one.
        pool: Source of examples; filled with as many as are wanted to begin with.
        plan: Schedule.
        started: Start of the minutes, by `time.monotonic`.
        report: See `Report`.
        every: Interval of reports, s.

    Returns:
        How many updates were made.

    Raises:
        NonFiniteError: A loss is not finite any more.
        RequestError: The time was over before the first update.
    """
    last_report, step, before = started, 0, None
    while step < plan.steps:
        pool.fill(0)
        elapsed = (time.monotonic() - started) / 60.0
        progress = max(step / plan.steps, elapsed / plan.minutes if plan.minutes else 0.0)
        if progress >= 1.0:
            break
        rate = plan.rate * min((step + 1) / 200.0, 1.0) * 0.5 * (1.0 + np.cos(np.pi * progress))
        # At first the average forgets quickly, so that it holds nothing of the random start.
        rates = jnp.float32(rate), jnp.float32(min(plan.average, (1.0 + step) / (10.0 + step)))
        made = update(step, rates)
        if made is None:
            pool.fill(len(pool.examples) + 1)
            continue
        (parts, weights), step = made, step + 1
        if step % 8 == 0 and time.monotonic() - last_report > every:
            last_report = time.monotonic()
            losses = {name: float(part) for name, part in parts.items()}
            if not np.isfinite(list(losses.values())).all():
                raise NonFiniteError(f"a loss is not finite at step {step}: try a lower --rate")
            report(step, progress, len(pool.examples), losses, weights)
        # The device is kept one update ahead and no more: examples are drawn on it, too, and wait for what is queued.
        jax.block_until_ready(before)
        before = parts
    if not step:
        raise RequestError(f"{plan.minutes:g} minutes were over before the first update: allow more with --minutes")
    return step
