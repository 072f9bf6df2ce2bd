"""``jaxrl-vis grasp synth``: write synthetic runs."""

import dataclasses

from jaxrl_vis.cli.checks import check_counts
from jaxrl_vis.stalks.cli.options import SynthOptions
from jaxrl_vis.stalks.cli.phenotype_synth import write_synthetic


@dataclasses.dataclass(frozen=True, kw_only=True)
class Synth(SynthOptions):
    """Write synthetic runs for grasping: folders of five stereo pairs over half a metre, with odometry and ground truth."""

    runs: int = 1
    """Number of runs."""


def synth(options: Synth) -> int:
    """Write the runs, and return the exit status.

    Raises:
        RequestError: An option is invalid, a package is missing, no device works, or the folder cannot be written to.
    """
    check_counts(runs=options.runs)
    write_synthetic(options, "grasping", options.runs, "all", "runs")
    return 0
