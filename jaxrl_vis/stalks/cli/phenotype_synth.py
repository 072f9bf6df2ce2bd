"""``jaxrl-vis phenotype synth``."""

import dataclasses
from typing import TYPE_CHECKING, Literal

from jaxrl_vis.cli.checks import check_counts
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.stalks.cli.options import SynthOptions, check_extra
from jaxrl_vis.stalks.cli.progress import progress

if TYPE_CHECKING:
    from jaxrl_vis_envs.plants import Family


@dataclasses.dataclass(frozen=True, kw_only=True)
class Synth(SynthOptions):
    """Write synthetic plots of sorghum: folders of stereo pairs with calibration, odometry and exact truth."""

    plots: int = 1
    """Number of plots."""
    truth: Literal["all", "boxes", "none"] = "all"
    """Truth to write: masks and disparities too, boxes only, or nothing but counts and diameters."""


def synth(options: Synth) -> int:
    """Write the plots."""
    check_counts(plots=options.plots)
    options.check()
    check_extra("phenotyping")
    check_writable(options.out, "--out", folder=True)
    family = options.read_family("phenotyping")
    check_devices()
    write_synthetic(options, family, options.plots, options.truth, "plots")
    return 0


def write_synthetic(
    options: SynthOptions, family: "Family", count: int, truth: Literal["all", "boxes", "none"], noun: str
) -> None:
    """Write plots and print a line about them.

    Args:
        options: Folder, image format and first seed.
        family: Family that the plots are drawn from.
        count: Number of plots.
        truth: Truth to write.
        noun: Word for plots, in the plural.

    Raises:
        RequestError: The folder cannot be written to, or holds another family's plots.
    """
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
    print(f"{options.out}: {len(seeds)} synthetic {noun} of family {family.name}{already}")
