"""``jaxrl-vis grasp eval``."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Literal

from jaxrl_vis.cli.checks import check_counts, check_extra
from jaxrl_vis.cli.families import family_of
from jaxrl_vis.cli.grasp import painter_of
from jaxrl_vis.devices import check_devices
from jaxrl_vis.errors import RequestError
from jaxrl_vis.report.outputs import check_writable


@dataclasses.dataclass(frozen=True)
class Eval:
    """Compare masks, stitches and grasp points with the exact truth of synthetic runs, which are drawn for it."""

    weights: Path | None = None
    """Weights from `grasp train`; those that are shipped if not given."""
    masks: Literal["gan", "segmentation", "truth"] = "segmentation"
    """What finds the pixels of stalks: one of the networks that are shipped, or the truth, to see what the rest makes of it."""
    thesis: bool = False
    """Stitch and find grasp points as the thesis describes it: --stitch thesis --points thesis."""
    stitch: Literal["default", "thesis"] = "default"
    """How clouds are stitched."""
    points: Literal["default", "thesis"] = "default"
    """How grasp points are found."""
    family: Literal["training", "shifted"] | None = None
    """What rows are drawn from; training, if no --spec says otherwise."""
    shift: tuple[str, ...] = ()
    """Shift only these factors of the family: flash, lean, rig, noise, leaves, textures."""
    spec: Path | None = None
    """A JSON or TOML file with the values of a family of your own."""
    runs: int = 10
    """How many runs."""
    seed: int = 0
    """Seed of the first run; the others have the numbers that follow."""
    frames: int | None = None
    """Pairs of a run, in place of the family's 5."""
    width: int | None = None
    """Width of an image in pixels, in place of the family's 1024."""
    reach: bool = False
    """Send the simulated arm to every grasp point, too, and say what its jaws hold."""
    wind: float = 0.0
    """With --reach: how far stalks sway in the wind, mm."""
    json: Path | None = None
    """A file for the figures of all runs together and of each; written after each run."""


def evaluate(options: Eval) -> int:
    """Prints the figures."""
    check_counts(runs=options.runs, frames=options.frames, width=options.width)
    if options.seed < 0:
        raise RequestError(f"--seed must be at least 0, not {options.seed}")
    if options.masks == "truth" and options.weights is not None:
        raise RequestError("--masks truth uses no weights: leave out --weights")
    if options.wind < 0 or (options.wind and not options.reach):
        raise RequestError(f"--wind must be at least 0, and goes with --reach, not {options.wind:g}")
    check_extra("grasp", "grasping")
    if options.json is not None:
        check_writable(options.json, "--json")
    family = family_of(options, "grasping")
    check_devices()
    from jaxrl_vis.files import write_atomically
    from jaxrl_vis.grasping.attempts import carry_out, plan
    from jaxrl_vis.grasping.evaluate import draw_scene, score_scene, summary
    from jaxrl_vis.grasping.metric import score as score_grasps
    from jaxrl_vis.grasping.perceive import Ways

    painter, name = (None, "truth") if options.masks == "truth" else painter_of(options.weights, options.masks)
    mask = None if painter is None else lambda image, number: painter(image)
    ways = Ways(*(options.thesis or each == "thesis" for each in (options.stitch, options.points)))
    scores, plans = [], []
    for seed in range(options.seed, options.seed + options.runs):
        scene = draw_scene(family, seed)
        score, perception = score_scene(scene, mask, ways)
        scores.append(score)
        if options.reach:
            plans.append(plan(scene, perception, len(plans)))
        one = summary([score])
        print(
            f"run {seed}: {len(score.errors)} of {score.true} stalks, {score.found - len(score.errors)} false, "
            f"grasp points {one['point_median_mm']:.1f} mm, stitches {one['stitch_median_mm']:.1f} mm"
            + "".join(f"; {note}" for note in score.notes),
            flush=True,
        )
        if options.json is not None:
            about = {"synthetic": True, "family": family.name, "masks": name, "method": str(ways)}
            each_run = [
                {"seed": each.seed, "stalks": each.true, "grasp_points": each.found, "hits": len(each.errors)}
                for each in scores
            ]
            text = json.dumps({**about, **_finite(summary(scores)), "each": each_run}, indent=2)
            write_atomically(options.json, text + "\n")
    print(f"simulated runs of family {family.name}, masks: {name}, {ways}:")
    for each, value in summary(scores).items():
        print(f"  {each:20} {value if isinstance(value, int) else f'{value:.4f}'}")
    if options.reach:
        grasps = score_grasps(carry_out(plans, options.wind), [each for one in plans for each in one.standing])
        print(f"the arm, with {options.wind:g} mm of wind:")
        for share in grasps.shares:
            print(f"  {share}")
        print(f"  the thesis's ratio: {grasps.thesis_ratio:.4f}")
        if options.json is not None:
            record = json.loads(options.json.read_text(encoding="utf-8"))
            shares = {each.name: {"count": each.count, "of": each.of, "interval": each.interval} for each in grasps.shares}
            record["reach"] = {"wind_mm": options.wind, **_finite({"thesis_ratio": grasps.thesis_ratio}), "shares": shares}
            write_atomically(options.json, json.dumps(record, indent=2).replace("NaN", "null") + "\n")
    return 0


def _finite(figures: dict) -> dict:
    """What JSON can hold: None in place of what is not a number."""
    return {name: value if math.isfinite(value) else None for name, value in figures.items()}
