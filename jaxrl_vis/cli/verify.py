"""``jaxrl-vis verify``."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated

from jaxrl_vis.cli.checks import check_counts, check_run, may_run_code
from jaxrl_vis.cli.parsing import ByPlaceToo
from jaxrl_vis.errors import RequestError


@dataclasses.dataclass(frozen=True)
class Verify:
    """Repeat the beginning of a run, and say whether its files hold the same numbers, bit for bit.

    Nothing in the folder is changed. Exit status 0: all that was repeated is equal, and nothing is missing, damaged or another
    run's; 1: something is not; 2: there is nothing that could be verified.
    """

    run_dir: Annotated[Path, ByPlaceToo()]
    """The run folder; the run may still be going on."""
    iterations: int | None = None
    """Iterations to repeat, from the seed and from each full checkpoint; up to the second evaluation if not given."""
    trust: bool = False
    """Run the run's own code without a question, where its task is module:Name and somebody else trained it (docs/runs.md)."""


def run(options: Verify) -> int:
    """Verifies a run, and prints what was found."""
    check_run(options.run_dir)
    trust = may_run_code(options.run_dir, options.trust)
    check_counts(iterations=options.iterations)
    from jaxrl_vis.run.verification import verify_run

    report = verify_run(options.run_dir, options.iterations, keep_programs=True, say=print, trust=trust)
    for title, lines in (("not verified", report.unverified), ("note", report.notes), ("elsewhere", report.elsewhere)):
        for line in lines:
            print(f"{title}: {line}")
    for line in report.problems:
        print(f"wrong: {line}")
    if report.differences and report.elsewhere:
        by = "no number" if math.isinf(report.largest) else f"{report.largest:.1e}"
        print(f"numbers need not be the same here, see elsewhere; the largest relative difference: {by}")
    if report.problems:
        print(f"not as the run left it: see what is wrong above; {report.rows} rows were repeated")
        return 1
    if not report.rows:
        raise RequestError(
            f"no row of {options.run_dir / 'metrics.jsonl'} can be repeated yet: let the run come to an evaluation"
        )
    passed = f", and the state at checkpoints {', '.join(report.checkpoints)}" if report.checkpoints else ""
    print(f"equal bit for bit: {report.rows} rows, {report.numbers} numbers{passed}")
    return 0
