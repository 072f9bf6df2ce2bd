"""``jaxrl-vis phenotype eval``."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Literal

from jaxrl_vis.cli.checks import check_counts, check_extra
from jaxrl_vis.cli.families import family_of
from jaxrl_vis.cli.phenotype_run import networks
from jaxrl_vis.devices import check_devices
from jaxrl_vis.errors import RequestError
from jaxrl_vis.report.outputs import check_writable


@dataclasses.dataclass(frozen=True)
class Eval:
    """Compare finds, counts and widths with the exact truth of synthetic plots, which are drawn for it."""

    weights: Path | None = None
    """Weights from `phenotype train`; those that are shipped if not given."""
    masks: Literal["network", "truth"] = "network"
    """What finds stalks: the networks, or the truth, to see what the rest makes of it."""
    family: Literal["training", "shifted"] | None = None
    """What plots are drawn from; shifted, if no --spec says otherwise."""
    shift: tuple[str, ...] = ()
    """Shift only these factors of the family: flash, lean, rig, noise, leaves, textures."""
    spec: Path | None = None
    """A JSON or TOML file with the values of a family of your own."""
    plots: int = 10
    """How many plots."""
    seed: int = 0
    """Seed of the first plot; the others have the numbers that follow."""
    frames: int | None = None
    """Pairs of a plot, in place of the family's 34."""
    width: int | None = None
    """Width of an image in pixels, in place of the family's 3376."""
    method: Literal["strip", "ellipse"] = "strip"
    """How widths are taken."""
    least_score: float = 0.5
    """What the networks are less sure of is no stalk, 0 to 1."""
    json: Path | None = None
    """A file for the figures of all plots together and of each; written after each plot."""


def evaluate(options: Eval) -> int:
    """Prints the figures."""
    check_counts(plots=options.plots, frames=options.frames, width=options.width)
    if options.seed < 0:
        raise RequestError(f"--seed must be at least 0, not {options.seed}")
    check_extra("phenotype", "phenotyping")
    if options.json is not None:
        check_writable(options.json, "--json")
    family = family_of(options, "phenotyping", "shifted")
    check_devices()
    from jaxrl_vis.files import write_atomically
    from jaxrl_vis.phenotyping.evaluate import score_plot, summary

    find, name = (None, "truth") if options.masks == "truth" else networks(options.weights, 0.05)
    scores = []
    for seed in range(options.seed, options.seed + options.plots):
        score = score_plot(family, seed, find, options.method, options.least_score)
        scores.append(score)
        one = summary([score], options.least_score)
        print(
            f"plot {seed}: {score.counted} of {score.true} stalks, "
            f"width error {one['width_mae_mm']:.2f} mm, F1 {one['f1']:.3f}",
            flush=True,
        )
        if options.json is not None:
            figures = summary(scores, options.least_score)
            each_plot = [{"seed": each.seed, "true": each.true, "counted": each.counted} for each in scores]
            about = {"synthetic": True, "family": family.name, "finder": name, "method": options.method}
            text = json.dumps({**about, **_finite(figures), "each": each_plot}, indent=2)
            write_atomically(options.json, text + "\n")
    figures = summary(scores, options.least_score)
    print(f"synthetic plots of family {family.name}, {name}, {options.method}:")
    for each, value in figures.items():
        print(f"  {each:24} {value if isinstance(value, int) else f'{value:.4f}'}")
    return 0


def _finite(figures: dict) -> dict:
    """What JSON can hold: None in place of what is not a number."""
    return {name: value if math.isfinite(value) else None for name, value in figures.items()}
