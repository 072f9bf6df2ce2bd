"""``jaxrl-vis phenotype``."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from jaxrl_vis.cli.checks import check_counts, check_extra
from jaxrl_vis.cli.families import family_of
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.cli.progress import progress
from jaxrl_vis.devices import check_devices
from jaxrl_vis.errors import RequestError
from jaxrl_vis.report.outputs import check_writable

if TYPE_CHECKING:
    from jaxrl_vis_envs.plants import Family


@dataclasses.dataclass(frozen=True)
class Synth:
    """Write synthetic plots of sorghum: folders of stereo pairs with calibration, odometry and exact truth."""

    out: Annotated[Path, AlsoPositional()]
    """The folder to write to; plots that it holds already are not drawn again."""
    family: Literal["training", "shifted"] = "training"
    """What plots are drawn from: what networks learn on, or with every factor of the world shifted."""
    shift: tuple[str, ...] = ()
    """Shift only these factors of the family: flash, lean, rig, noise, leaves, textures."""
    spec: Path | None = None
    """A JSON or TOML file with the values of a family of your own."""
    plots: int = 1
    """How many plots."""
    seed: int = 0
    """Seed of the first plot; the others have the numbers that follow."""
    frames: int | None = None
    """Pairs of a plot, in place of the family's 34."""
    width: int | None = None
    """Width of an image in pixels, in place of the family's 3376; what is seen stays the same."""
    format: Literal["png", "tiff", "jpeg"] = "png"
    """Format of the cameras' images."""
    truth: Literal["all", "boxes", "none"] = "all"
    """What is written of the truth: masks and disparities too, boxes only, or nothing but counts and diameters."""


def synth(options: Synth) -> int:
    """Writes the plots."""
    check_counts(plots=options.plots, frames=options.frames, width=options.width)
    if options.seed < 0:
        raise RequestError(f"--seed must be at least 0, not {options.seed}")
    check_extra("phenotype", "phenotyping")
    check_writable(options.out, "--out", folder=True)
    family = family_of(options, "phenotyping")
    check_devices()
    seeds = range(options.seed, options.seed + options.plots)
    write_synthetic(options.out, family, seeds, options.format, options.truth, "plots")
    return 0


def write_synthetic(
    out: Path,
    family: "Family",
    seeds: range,
    image_format: Literal["png", "tiff", "jpeg"],
    truth: Literal["all", "boxes", "none"],
    word: str,
) -> None:
    """Writes plots and says so.

    Args:
        out: The folder to write to.
        family: What plots are drawn from.
        seeds: One plot each.
        image_format: Of the cameras' images.
        truth: What is written of it.
        word: What plots are called.

    Raises:
        RequestError: The folder cannot be written to, or holds another family's plots.
    """
    from jaxrl_vis.phenotyping.synth import name_of, write_plots

    try:
        with progress("pairs") as say:

            def done(seed: int, pairs: int) -> None:
                say(name_of(seed), pairs, family.rig.frames)

            present = write_plots(out, family, seeds, image_format, truth, done)
    except OSError as error:
        raise RequestError(f"cannot write to {out}: {error.strerror or error}") from error
    there = f", {present} there already" if present else ""
    print(f"{out}: {len(seeds)} synthetic {word} of family {family.name}{there}")
