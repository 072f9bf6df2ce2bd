"""Options shared by commands that use trained runs."""

import dataclasses


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckpointOption:
    """Option of a command that loads a checkpoint; `checks.read_checkpoint` reads it."""

    checkpoint: str | None = None
    """Iteration of the checkpoint, or best for the best one by --best-by; the newest valid one if not given."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrustOption:
    """Option of a command that may run a run's custom code; see `checks.may_run_code`."""

    trust: bool = False
    """Execute the run's custom code (module:Name) without asking, even if it was not trained here (docs/runs.md)."""
