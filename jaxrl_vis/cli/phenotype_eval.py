"""``jaxrl-vis phenotype eval``."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any, Literal

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
    thesis: bool = False
    """Also what the thesis's ways (ellipses, semi-global matching, stalks per metre of image) make of the same finds."""
    each_factor: bool = False
    """A table: the training family, each factor of the world shifted alone, and all of them; --plots of each."""
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
    if options.each_factor and (options.family or options.shift or options.spec or options.json):
        raise RequestError("--each-factor goes through the families by itself: leave out --family, --shift, --spec and --json")
    family = family_of(options, "phenotyping", "shifted")
    check_devices()
    find, name = (None, "truth") if options.masks == "truth" else networks(options.weights, 0.05)
    if options.each_factor:
        return _factor_table(options, find, name)
    figures = _score(options, family, find, name)
    print(f"synthetic plots of family {family.name}, {name}, {options.method}:")
    for each, value in figures.items():
        print(f"  {each:24} {value if isinstance(value, int) else f'{value:.4f}'}")
    return 0


_COLUMNS = ("count_r2", "count_mae", "count_bias", "width_mae_mm", "width_bias_mm", "ap50", "f1")


def _factor_table(options: Eval, find: Any, name: str) -> int:
    """Prints a line of Markdown for each factor that is shifted alone."""
    from jaxrl_vis_envs.plants import SHIFTS

    alone = [(factor, dataclasses.replace(options, family="training", shift=(factor,))) for factor in SHIFTS]
    none, all_of_them = (dataclasses.replace(options, family=name) for name in ("training", "shifted"))
    lines = []
    for factor, drawn in [("none", none), *alone, ("all", all_of_them)]:
        family = family_of(drawn, "phenotyping")
        figures = _score(options, family, find, name)
        lines.append(f"| {factor} | " + " | ".join(f"{figures[column]:.3f}" for column in _COLUMNS) + " |")
    print(f"\nsynthetic plots, {options.plots} each, {name}, {options.method}\n")
    print("| shifted | " + " | ".join(_COLUMNS) + " |")
    print("|---|" + "---|" * len(_COLUMNS))
    print("\n".join(lines))
    return 0


def _score(options: Eval, family: Any, find: Any, name: str) -> dict[str, Any]:
    """Figures of all plots of a family together; says something of each plot, and writes the file that was asked for."""
    from jaxrl_vis import __version__
    from jaxrl_vis.files import write_atomically
    from jaxrl_vis.phenotyping.evaluate import score_plot, summary
    from jaxrl_vis.provenance import device_name

    scores = []
    for seed in range(options.seed, options.seed + options.plots):
        score = score_plot(family, seed, find, options.method, options.least_score, options.thesis)
        scores.append(score)
        one = summary([score], options.least_score)
        print(
            f"plot {seed}: {score.counted} of {score.true} stalks, "
            f"width error {one['width_mae_mm']:.2f} mm, F1 {one['f1']:.3f}",
            flush=True,
        )
        if options.json is not None:
            figures = summary(scores, options.least_score)
            each_plot = [
                {
                    "seed": each.seed,
                    "true": each.true,
                    "counted": each.counted,
                    "widths_mm": each.widths.round(4).tolist(),
                    "seconds_per_pair": None if math.isnan(each.seconds) else round(each.seconds, 4),
                    "pairs": family.rig.frames,
                }
                for each in scores
            ]
            about = {
                "synthetic": True,
                "device": device_name(),
                "version": __version__,
                "family": family.name,
                "finder": name,
                "method": options.method,
            }
            text = json.dumps({**about, **_finite(figures), "each": each_plot}, indent=2)
            write_atomically(options.json, text + "\n")
    return summary(scores, options.least_score)


def _finite(figures: dict) -> dict:
    """What JSON can hold: None in place of what is not a number."""
    return {name: value if math.isfinite(value) else None for name, value in figures.items()}
