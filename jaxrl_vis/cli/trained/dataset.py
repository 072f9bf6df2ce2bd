"""Command ``jaxrl-vis dataset``: record or convert episodes, as a LeRobot dataset or .npz file."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from jaxrl_vis.cli.checks import check_counts, check_run, may_run_code
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.cli.trained.options import TrustOption
from jaxrl_vis.errors import RequestError


@dataclasses.dataclass(frozen=True)
class Dataset(TrustOption):
    """Record episodes of a run's policy, or convert recorded ones, as a LeRobot dataset or .npz file."""

    source: Annotated[Path, AlsoPositional()]
    """A run folder, whose policy is recorded; or episodes to convert: an .npz file, or the folder of a LeRobot dataset."""
    out: Path
    """A new folder; for npz also the name of an .npz file."""
    format: Literal["lerobot", "npz"] = "lerobot"
    """A LeRobot dataset of version 3 (needs the extra lerobot), or one .npz file of arrays."""
    episodes: int | None = None
    """Number of episodes; 50 for a run, all for a conversion, if not given."""
    seed: int = 0
    """Seed of the starts and goals of a run's episodes; unused by a conversion."""


def run(options: Dataset) -> int:
    """Record or convert episodes, and write them."""
    check_counts(episodes=options.episodes)
    from jaxrl_vis.recordings import convert

    convert.check_out(options.out, options.format)
    if convert.holds_recordings(options.source):
        recordings = convert.read(options.source).first(options.episodes)
    else:
        run_dir = check_run(options.source)
        if not 0 <= options.seed < 2**32:
            raise RequestError(f"--seed must be from 0 to {2**32 - 1}, not {options.seed}")
        trust = may_run_code(run_dir, options.trust)
        from jaxrl_vis.run.trained.record import record_run

        recordings = record_run(run_dir, options.episodes or 50, options.seed, trust)
    written = convert.write(recordings, options.out, options.format)
    reached = "" if recordings.success is None else f", {recordings.success.mean():.0%} reached their goals"
    print(f"{written}: {recordings.count} episodes of {recordings.horizon} steps{reached}")
    return 0
