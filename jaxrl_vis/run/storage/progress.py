"""Host-side progress of a run, saved with every checkpoint."""

import dataclasses
from collections.abc import Mapping
from typing import Any, Self

from jaxrl_vis.host.files import is_count
from jaxrl_vis.run.storage.metrics import PerSeed


@dataclasses.dataclass
class Progress:
    """Part of a run's state that is kept on the host.

    Attributes:
        wall_s: Wall-clock time of earlier processes in seconds; a saved copy includes the process that saved it.
        compile_s: Compilation time of all processes so far, in seconds.
        since_evaluation: train/* and other metrics of every iteration since the last scheduled evaluation.
        evaluation_due: True while the evaluation at the current iteration is still to be run, or its rows are not yet written.
        filtered: Number of consecutive evaluations with too large a fraction of filtered negatives.
        replay_lost_at: Last iteration at which the run resumed without its replay; None if it never did.
    """

    wall_s: float = 0.0
    compile_s: float = 0.0
    since_evaluation: list[PerSeed] = dataclasses.field(default_factory=list)
    evaluation_due: bool = False
    filtered: int = 0
    replay_lost_at: int | None = None

    @classmethod
    def from_dict(cls, saved: Mapping[str, Any]) -> Self:
        """Invert `dataclasses.asdict`; fields of other versions are ignored.

        Raises:
            ValueError: A field has another type than when it was saved.
        """
        names = {field.name for field in dataclasses.fields(cls)}
        progress = cls(**{name: value for name, value in saved.items() if name in names})
        counts = (progress.filtered, 0 if progress.replay_lost_at is None else progress.replay_lost_at)
        is_good = (
            all(_is_number(value) for value in (progress.wall_s, progress.compile_s))
            and all(map(is_count, counts))
            and isinstance(progress.evaluation_due, bool)
            and isinstance(progress.since_evaluation, list)
            and all(map(_are_metrics, progress.since_evaluation))
        )
        if not is_good:
            raise ValueError("its progress has fields of other types")
        return progress


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < 2**63


def _are_metrics(value: Any) -> bool:
    return isinstance(value, dict) and all(
        isinstance(row, list) and all(isinstance(number, int | float) and not isinstance(number, bool) for number in row)
        for row in value.values()
    )
