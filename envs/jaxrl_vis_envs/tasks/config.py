"""Settings that every built-in task has."""

import dataclasses

from jaxrl_vis_envs import checks
from jaxrl_vis_envs.randomization import OFF, Randomization


@dataclasses.dataclass(frozen=True)
class TaskConfig(checks.CheckedConfig):
    """Settings that every built-in task has."""

    horizon: int
    """Control steps in an episode."""
    threshold: float
    """An episode succeeds within this distance of the goal, in the unit of the distance."""
    randomization: Randomization = OFF
    """What varies between episodes, and how far."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.whole(self, "horizon")
        checks.positive(self, "threshold")
        if not isinstance(self.randomization, Randomization):
            raise ValueError(f"randomization must be a Randomization, got {self.randomization!r}")
