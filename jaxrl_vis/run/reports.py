"""Reports of a run's iterations, and callbacks that receive them."""

import dataclasses
from collections.abc import Callable

from jaxrl_vis.run.storage.metrics import PerSeed


@dataclasses.dataclass(frozen=True)
class Report:
    """Record of one iteration on the host.

    Attributes:
        iteration: Iterations done since the run began, this one included.
        env_steps: Environment steps so far, per seed.
        updates: Gradient steps so far, per seed.
        metrics: One number per seed, by name; ``eval/*`` only if the iteration ended with an evaluation.
    """

    iteration: int
    env_steps: int
    updates: int
    metrics: PerSeed


Callback = Callable[[Report], bool | None]
"""Function called in every process with each report that has an evaluation; returns True to end the run early."""
