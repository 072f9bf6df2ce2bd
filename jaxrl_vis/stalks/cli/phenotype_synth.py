"""``jaxrl-vis phenotype synth``: write synthetic plots."""

import dataclasses
from typing import Literal

from jaxrl_vis.cli.checks import check_counts
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.stalks.cli.options import Purpose, SynthOptions, check_extra
from jaxrl_vis.stalks.cli.progress import progress


@dataclasses.dataclass(frozen=True, kw_only=True)
class Synth(SynthOptions):
    """Write synthetic plots of sorghum: folders of stereo pairs with calibration, odometry and exact ground truth."""

    plots: int = 1
    """Number of plots."""
    truth: Literal["all", "boxes", "none"] = "all"
    """Ground truth to write: masks, disparities, boxes, counts and diameters (all), no masks and disparities (boxes), or only
    counts and diameters (none)."""


def synth(options: Synth) -> int:
    """Write the plots, and return the exit status.

    Raises:
        RequestError: An option is invalid, a package is missing, no device works, or the folder cannot be written to.
    """
    check_counts(plots=options.plots)
    write_synthetic(options, "phenotyping", options.plots, options.truth, "plots")
    return 0


def write_synthetic(
    options: SynthOptions,
    purpose: Purpose,
    count: int,
    truth: Literal["all", "boxes", "none"],
    unit: str,
) -> None:
    """Write plots or runs with progress, and print a one-line summary.

    Args:
        options: Family, folder, image format and first seed.
        purpose: Extra whose packages are needed, and purpose of the family.
        count: Number of plots.
        truth: Ground truth to write.
        unit: Noun for the plots in the summary, in the plural.

    Raises:
        RequestError: An option is invalid, a package is missing, no device works, or the folder cannot be written to, or holds
            another family's plots.
    """
    options.check()
    check_extra(purpose)
    check_writable(options.out, "--out", folder=True)
    family = options.read_family(purpose)
    check_devices()
    from jaxrl_vis.stalks.phenotyping.evaluation.synth import plot_name, write_plots

    seeds = range(options.seed, options.seed + count)
    try:
        with progress("pairs") as report:

            def done(seed: int, pairs: int) -> None:
                report(plot_name(seed), pairs, family.rig.frames)

            present = write_plots(options.out, family, seeds, options.format, truth, done)
    except OSError as error:
        raise RequestError(f"cannot write to {options.out}: {error.strerror or error}") from error
    already = f", {present} there already" if present else ""
    print(f"{options.out}: {len(seeds)} synthetic {unit} of family {family.name}{already}")
