"""``jaxrl-vis phenotype``."""

import dataclasses
import importlib.util
from pathlib import Path
from typing import Annotated, Literal

from jaxrl_vis.cli.checks import check_counts
from jaxrl_vis.cli.parsing import ByPlaceToo
from jaxrl_vis.cli.progress import progress
from jaxrl_vis.devices import check_devices
from jaxrl_vis.errors import RequestError
from jaxrl_vis.report.outputs import check_writable

_NEEDED = {"cv2": "opencv-python-headless", "scipy": "scipy", "tifffile": "tifffile", "pandas": "pandas"}


@dataclasses.dataclass(frozen=True)
class Synth:
    """Write synthetic plots of sorghum: folders of stereo pairs with calibration, odometry and exact truth."""

    out: Annotated[Path, ByPlaceToo()]
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
    check_extra()
    check_writable(options.out, "--out", folder=True)
    family = family_of(options)
    check_devices()
    from jaxrl_vis.phenotyping.synth import name_of, write_plots

    seeds = range(options.seed, options.seed + options.plots)
    try:
        with progress("pairs") as say:

            def done(seed: int, pairs: int) -> None:
                say(name_of(seed), pairs, family.rig.frames)

            present = write_plots(options.out, family, seeds, options.format, options.truth, done)
    except OSError as error:
        raise RequestError(f"cannot write to {options.out}: {error.strerror or error}") from error
    print(
        f"{options.out}: {options.plots} synthetic plots of family {family.name}"
        + (f", {present} there already" if present else "")
    )
    return 0


def family_of(options: Synth):
    """The family that the options ask for.

    Raises:
        RequestError: They contradict each other, or the file of a family does not make sense.
    """
    from jaxrl_vis_envs.plants import FAMILIES, read, shift

    if options.spec is not None and (options.shift or options.family != "training"):
        raise RequestError("--spec describes the whole family: leave out --family and --shift")
    try:
        family = FAMILIES[options.family] if options.spec is None else read(options.spec)
        if options.shift:
            family = shift(family, *options.shift)
        if options.width is not None:
            family = family.at_width(options.width)
        if options.frames is not None:
            family = dataclasses.replace(family, rig=dataclasses.replace(family.rig, frames=options.frames))
    except ValueError as error:
        raise RequestError(str(error)) from error
    return family


def check_extra() -> None:
    """Checks that what phenotyping needs beyond the base installation is there.

    Raises:
        RequestError: It is not.
    """
    missing = [package for module, package in _NEEDED.items() if importlib.util.find_spec(module) is None]
    if missing:
        raise RequestError(f"phenotype needs {', '.join(missing)}: pip install 'jaxrl-vis[phenotyping]'")
