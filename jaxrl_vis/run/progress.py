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
        """The inverse of `dataclasses.asdict`; fields of other versions are left out.

        Raises:
            ValueError: A field is not what it was saved as.
        """
        names = {field.name for field in dataclasses.fields(cls)}
        found = cls(**{name: value for name, value in saved.items() if name in names})
        counts = (found.filtered, 0 if found.replay_lost_at is None else found.replay_lost_at)
        is_good = (
            all(_is_number(each) for each in (found.wall_s, found.compile_s))
            and all(_is_number(each) and isinstance(each, int) for each in counts)
            and isinstance(found.evaluation_due, bool)
            and isinstance(found.since_evaluation, list)
            and all(map(_are_metrics, found.since_evaluation))
        )
        if not is_good:
            raise ValueError("its progress holds something else than progress")
        return found


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < 2**63


def _are_metrics(value: Any) -> bool:
    return isinstance(value, dict) and all(
        isinstance(row, list) and all(isinstance(each, int | float) and not isinstance(each, bool) for each in row)
        for row in value.values()
    )
