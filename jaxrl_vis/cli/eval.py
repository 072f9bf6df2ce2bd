"""``jaxrl-vis eval``."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated

from jaxrl_vis.cli.checks import check_counts, check_run, may_run_code
from jaxrl_vis.cli.parsing import ByPlaceToo
from jaxrl_vis.files import write_atomically
from jaxrl_vis.report.outputs import check_writable


@dataclasses.dataclass(frozen=True)
class Eval:
    """Measure a trained run: success and distance at the last step, without exploration."""

    run_dir: Annotated[Path, ByPlaceToo()]
    """The run folder."""
    episodes: int | None = None
    """Episodes; the run's own number if not given."""
    json: Path | None = None
    """Also write the figures here."""
    trust: bool = False
    """Run the run's own code without a question, where its task is module:Name and somebody else trained it (docs/runs.md)."""


def run(options: Eval) -> int:
    """Evaluates a run and prints its figures."""
    check_run(options.run_dir)
    trust = may_run_code(options.run_dir, options.trust)
    check_counts(episodes=options.episodes)
    if options.json is not None:
        check_writable(options.json, "--json")
    from jaxrl_vis.run.trained import evaluate_run

    figures = evaluate_run(options.run_dir, episodes=options.episodes, keep_programs=True, trust=trust)
    for name, per_seed in figures.items():
        print(f"{name:28}" + "".join(f" {value:9.4f}" for value in per_seed))
    if options.json is not None:
        write_atomically(options.json, json.dumps(figures, indent=2) + "\n")
    return 0
