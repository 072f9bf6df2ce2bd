"""Command ``jaxrl-vis verify``: repeat the beginning of a run, and compare its files bit for bit."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated

from jaxrl_vis.cli.checks import check_counts, check_run, may_run_code
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.cli.trained.options import TrustOption
from jaxrl_vis.errors import RequestError


@dataclasses.dataclass(frozen=True)
class Verify(TrustOption):
    """Repeat the beginning of a run, and check that its files have the same numbers, bit for bit.

    Nothing in the folder is changed. Exit status 0: everything repeated is equal, and nothing is missing, damaged or another
    run's; 1: a check failed; 2: nothing could be verified.
    """

    run_dir: Annotated[Path, AlsoPositional()]
    """The run folder; the run may still be in progress."""
    iterations: int | None = None
    """Number of iterations to repeat, from the seed and from each full checkpoint; up to the second evaluation if not given."""


def run(options: Verify) -> int:
    """Verify a run, and print the results."""
    run_dir = check_run(options.run_dir)
    trust = may_run_code(run_dir, options.trust)
    check_counts(iterations=options.iterations)
    from jaxrl_vis.run.verifying.verification import verify_run

    report = verify_run(run_dir, options.iterations, cache_programs=True, echo=print, trust=trust)
    for title, lines in (("not verified", report.unverified), ("note", report.notes), ("caveat", report.caveats)):
        for line in lines:
            print(f"{title}: {line}")
    for line in report.problems:
        print(f"wrong: {line}")
    if report.differences and report.caveats:
        largest = "not a number" if math.isinf(report.largest) else f"{report.largest:.1e}"
        print(f"numbers may differ on this machine, see the caveats; the largest relative difference: {largest}")
    if report.problems:
        print(f"verification failed: see what is wrong above; {report.rows} rows were repeated")
        return 1
    if not report.rows:
        raise RequestError(
            f"no row of {options.run_dir / 'metrics.jsonl'} can be repeated yet: let the run reach an evaluation"
        )
    passed = f", and the state at checkpoints {', '.join(report.checkpoints)}" if report.checkpoints else ""
    print(f"equal bit for bit: {report.rows} rows, {report.numbers} numbers{passed}")
    return 0
