"""Reports of a run's iterations, and the functions that are told of them."""

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
        metrics: Name -> one number per seed; ``eval/*`` only where the iteration ended with an evaluation.
    """

    iteration: int
    env_steps: int
    updates: int
    metrics: PerSeed


Callback = Callable[[Report], bool | None]
"""Called with each report that has an evaluation, in every process; returns True to end the run, as if it were finished."""
