"""``jaxrl-vis eval``."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated

from jaxrl_vis.cli.checks import check_counts, check_run
from jaxrl_vis.cli.parsing import ByPlaceToo
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


def run(options: Eval) -> int:
    """Evaluates a run and prints its figures."""
    check_run(options.run_dir)
    check_counts(episodes=options.episodes)
    if options.json is not None:
        check_writable(options.json, "--json")
    from jaxrl_vis.run.trained import evaluate_run

    figures = evaluate_run(options.run_dir, episodes=options.episodes, keep_programs=True)
    for name, per_seed in figures.items():
        print(f"{name:28}" + "".join(f" {value:9.4f}" for value in per_seed))
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(figures, indent=2) + "\n")
    return 0
