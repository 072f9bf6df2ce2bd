"""What the host remembers of a run from one part to the next; saved with every checkpoint."""

import dataclasses
from collections.abc import Mapping
from typing import Any, Self

from jaxrl_vis.run.metrics import PerSeed


@dataclasses.dataclass
class Progress:
    """The host's side of a run's state.

    Attributes:
        wall_s, compile_s: Spent by earlier parts, s.
        since_evaluation: train/* and the like of every iteration since the last scheduled evaluation.
        evaluation_due: The iteration ends with an evaluation, which a signal prevented.
        filtered: Evaluations in a row with too large a filtered share.
        replay_lost_at: The last iteration at which the run went on without the replay it had; None where it never did.
    """

    wall_s: float = 0.0
    compile_s: float = 0.0
    since_evaluation: list[PerSeed] = dataclasses.field(default_factory=list)
    evaluation_due: bool = False
    filtered: int = 0
    replay_lost_at: int | None = None

    @classmethod
    def from_dict(cls, saved: Mapping[str, Any]) -> Self:
        """The inverse of `dataclasses.asdict`; fields of other versions are left out."""
        names = {field.name for field in dataclasses.fields(cls)}
        return cls(**{name: value for name, value in saved.items() if name in names})
