"""Training loop for a number of steps or minutes, whichever ends first, on examples generated in the background."""

import time
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.errors import NonFiniteError, RequestError
from jaxrl_vis.stalks.phenotyping.training.pool import Pool

Report = Callable[[int, float, int, dict[str, float], Any], None]
"""Progress callback (step, progress from 0 to 1, number of examples, losses by name, averaged parameters)."""

Update = Callable[[int, tuple[jax.Array, jax.Array]], tuple[dict[str, jax.Array], Any] | None]
"""Update function (step, (learning rate, decay rate of the parameter average)) -> (losses by name, averaged parameters), or
None if there are not enough examples yet."""


class Schedule(Protocol):
    """Training schedule: maximum updates and minutes, peak learning rate, and decay rate of the parameter average."""

    @property
    def steps(self) -> int: ...  # noqa: D102
    @property
    def minutes(self) -> float | None: ...  # noqa: D102
    @property
    def rate(self) -> float: ...  # noqa: D102
    @property
    def ema_decay(self) -> float: ...  # noqa: D102


def run_updates(update: Update, pool: Pool, plan: Schedule, start_time: float, report: Report, report_interval: float) -> int:
    """Run updates until the plan's steps or minutes are reached.

    The learning rate has a linear warm-up over 200 updates and a cosine decay in progress, which follows steps or time.

    Args:
        update: Update function, see `Update`.
        pool: Pool of examples, already filled with the initial ones.
        plan: Training schedule.
        start_time: Start time of the minutes, by `time.monotonic`.
        report: Progress callback, see `Report`.
        report_interval: Minimum interval between reports, s.

    Returns:
        Number of updates.

    Raises:
        NonFiniteError: A loss is not finite when it is to be reported.
        RequestError: The time limit was reached before the first update.
    """
    last_report, step, before = start_time, 0, None
    while step < plan.steps:
        pool.fill(0)
        elapsed = (time.monotonic() - start_time) / 60.0
        progress = max(step / plan.steps, elapsed / plan.minutes if plan.minutes else 0.0)
        if progress >= 1.0:
            break
        rate = plan.rate * min((step + 1) / 200.0, 1.0) * 0.5 * (1.0 + np.cos(np.pi * progress))
        # The decay rate is lower at first, so that the average forgets the random initialisation.
        rates = jnp.float32(rate), jnp.float32(min(plan.ema_decay, (1.0 + step) / (10.0 + step)))
        made = update(step, rates)
        if made is None:
            pool.fill(len(pool.examples) + 1)
            continue
        (parts, weights), step = made, step + 1
        if step % 8 == 0 and time.monotonic() - last_report > report_interval:
            last_report = time.monotonic()
            losses = {name: float(part) for name, part in parts.items()}
            if not np.isfinite(list(losses.values())).all():
                raise NonFiniteError(f"a loss is not finite at step {step}: try a lower --rate")
            report(step, progress, len(pool.examples), losses, weights)
        # Queue at most one update ahead: examples are rendered on the same device and would wait for the queue.
        jax.block_until_ready(before)
        before = parts
    if not step:
        raise RequestError(f"{plan.minutes:g} minutes were over before the first update: allow more with --minutes")
    return step
