"""``jaxrl-vis grasp synth``, and what the commands of grasping share."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from jaxrl_vis.cli.checks import check_counts, check_extra
from jaxrl_vis.cli.families import family_of
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.cli.phenotype import write_synthetic
from jaxrl_vis.devices import check_devices
from jaxrl_vis.errors import RequestError
from jaxrl_vis.report.outputs import check_writable

if TYPE_CHECKING:
    from jaxrl_vis.grasping.masks.painter import Painter


@dataclasses.dataclass(frozen=True)
class Synth:
    """Write synthetic runs for grasping: folders of five stereo pairs over half a metre, with odometry and exact truth."""

    out: Annotated[Path, AlsoPositional()]
    """The folder to write to; runs that it holds already are not drawn again."""
    family: Literal["training", "shifted"] = "training"
    """What rows are drawn from: what networks learn on, or with every factor of the world shifted."""
    shift: tuple[str, ...] = ()
    """Shift only these factors of the family: flash, lean, rig, noise, leaves, textures."""
    spec: Path | None = None
    """A JSON or TOML file with the values of a family of your own."""
    runs: int = 1
    """How many runs."""
    seed: int = 0
    """Seed of the first run; the others have the numbers that follow."""
    frames: int | None = None
    """Pairs of a run, in place of the family's 5."""
    width: int | None = None
    """Width of an image in pixels, in place of the family's 1024; what is seen stays the same."""
    format: Literal["png", "tiff", "jpeg"] = "png"
    """Format of the cameras' images."""


def synth(options: Synth) -> int:
    """Writes the runs."""
    check_counts(runs=options.runs, frames=options.frames, width=options.width)
    if options.seed < 0:
        raise RequestError(f"--seed must be at least 0, not {options.seed}")
    check_extra("grasp", "grasping")
    check_writable(options.out, "--out", folder=True)
    family = family_of(options, "grasping")
    check_devices()
    seeds = range(options.seed, options.seed + options.runs)
    write_synthetic(options.out, family, seeds, options.format, "all", "runs")
    return 0


def weights_of(weights: Path | None, loss: Literal["gan", "segmentation"]) -> tuple[Path, str]:
    """The file of what finds the pixels of stalks, and its name, which changes with what is in it.

    Args:
        weights: From ``grasp train``; those that are shipped if not given.
        loss: Which of those.

    Raises:
        RequestError: The weights cannot be read.
    """
    import hashlib

    from jaxrl_vis.grasping.masks.painter import SHIPPED, read_weights

    path = SHIPPED[loss] if weights is None else weights
    if weights is None and not path.exists():
        raise RequestError(
            "no weights of masks come with this version: make some with `jaxrl-vis grasp train`, and name them with --weights"
        )
    _, settings, _ = read_weights(path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    return path, f"{settings.loss} {digest}"


def painter_of(weights: Path | None, loss: Literal["gan", "segmentation"]) -> "tuple[Painter, str]":
    """What finds the pixels of stalks, and its name; see `weights_of`."""
    from jaxrl_vis.grasping.masks.painter import Painter, read_weights

    path, name = weights_of(weights, loss)
    params, settings, _ = read_weights(path)
    return Painter(params, settings), name
