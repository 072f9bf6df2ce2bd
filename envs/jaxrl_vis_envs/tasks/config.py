"""Settings shared by all built-in tasks."""

import dataclasses

from jaxrl_vis_envs import checks
from jaxrl_vis_envs.randomization import OFF, Randomization


@dataclasses.dataclass(frozen=True)
class TaskConfig(checks.CheckedConfig):
    """Settings shared by all built-in tasks."""

    horizon: int
    """Number of control steps in an episode."""
    threshold: float
    """Distance to the goal within which an episode succeeds, in the task's `distance_unit`."""
    randomization: Randomization = OFF
    """Ranges of domain randomisation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.integers(self, "horizon")
        checks.positive(self, "threshold")
        if not isinstance(self.randomization, Randomization):
            raise ValueError(f"randomization must be a Randomization, got {self.randomization!r}")
