"""Command ``jaxrl-vis eval``: evaluate the policy of a run."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated

from jaxrl_vis.cli.checks import check_counts, check_run, may_run_code, read_checkpoint
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.cli.trained.options import CheckpointOption, TrustOption
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.report.outputs import check_writable


@dataclasses.dataclass(frozen=True)
class Eval(TrustOption, CheckpointOption):
    """Evaluate a trained run: success and distance at the last step, without exploration."""

    run_dir: Annotated[Path, AlsoPositional()]
    """The run folder, or the name of a policy that comes with the package, such as fetch."""
    episodes: int | None = None
    """Number of episodes; that of the run if not given."""
    json: Path | None = None
    """Also write the results to this file."""


def run(options: Eval) -> int:
    """Evaluate a run and print the results."""
    run_dir = check_run(options.run_dir)
    trust = may_run_code(run_dir, options.trust)
    check_counts(episodes=options.episodes)
    checkpoint = read_checkpoint(options.checkpoint)
    if options.json is not None:
        check_writable(options.json, "--json")
    from jaxrl_vis.run.trained.restored_run import evaluate_run

    figures = evaluate_run(run_dir, episodes=options.episodes, cache_programs=True, trust=trust, checkpoint=checkpoint)
    for name, per_seed in figures.items():
        print(f"{name:28}" + "".join(f" {value:9.4f}" for value in per_seed))
    if options.json is not None:
        write_atomically(options.json, json.dumps(figures, indent=2) + "\n")
    return 0
