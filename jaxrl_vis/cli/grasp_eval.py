"""``jaxrl-vis grasp eval``."""

import dataclasses
import functools
import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from jaxrl_vis import __version__
from jaxrl_vis.cli.checks import check_counts, check_extra, check_run, may_run_code
from jaxrl_vis.cli.families import family_of
from jaxrl_vis.cli.grasp import weights_of
from jaxrl_vis.devices import check_devices, enable_compilation_cache
from jaxrl_vis.errors import RequestError
from jaxrl_vis.evaluation_pool import Record, RecordFile, code_digest, evaluate_all, share_accelerator
from jaxrl_vis.report.outputs import check_writable

if TYPE_CHECKING:
    from jaxrl_vis.run.policy import Policy

_MOST_WIND = 100.0  # mm
_LOOPS: tuple[Literal["open", "again", "policy"], ...] = ("again",)


# What trains networks and draws figures and videos.
_CHANGES_NO_RECORD = ("examples.py", "loop.py", "variation.py", "figure.py", "reach_figures.py", "video.py")


@dataclasses.dataclass(frozen=True)
class Eval:
    """Compare masks, stitches and grasp points with the exact truth of synthetic runs, which are drawn for it."""

    weights: Path | None = None
    """Weights from `grasp train`; those that are shipped if not given."""
    masks: Literal["gan", "segmentation", "truth"] = "segmentation"
    """What finds the pixels of stalks: one of the networks that are shipped, or the truth, to see what the rest makes of it."""
    thesis: bool = False
    """Stitch and find grasp points as the thesis describes it: --stitch thesis --points thesis."""
    stitch: Literal["default", "thesis"] | None = None
    """How clouds are stitched; default if not given."""
    points: Literal["default", "thesis"] | None = None
    """How grasp points are found; default if not given."""
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
    wind: tuple[float, ...] = ()
    """With --reach: how far stalks sway in the wind, mm; 0 if not given. Several, such as 0 10 20, share what was seen."""
    loops: tuple[Literal["open", "again", "policy"], ...] = _LOOPS
    """With --reach: whether the arm goes to where a stalk was seen (open), finds it again on the way (again), or is brought
    there by a policy of VisualStalkReach (policy). With policy, all loops are compared on scenes like those of its task."""
    policy: Path | None = None
    """The run folder of that policy."""
    trust: bool = False
    """Run that run's own code without a question, where its task is module:Name and somebody else trained it."""
    policy_seed: int | None = None
    """Which of the run's seeds; the first if not given."""
    workers: int = 1
    """How many processes look at runs side by side; they share GPUs and cores, so that a pair takes longer."""
    json: Path | None = None
    """A file for the figures of all runs together and of each, written after each run. If it is there already, and about the
    same, the runs that it holds are not evaluated again."""


def evaluate(options: Eval) -> int:
    """Prints the figures."""
    check_counts(runs=options.runs, frames=options.frames, width=options.width, workers=options.workers)
    if options.seed < 0:
        raise RequestError(f"--seed must be at least 0, not {options.seed}")
    if options.masks == "truth" and options.weights is not None:
        raise RequestError("--masks truth uses no weights: leave out --weights")
    for wind in options.wind:
        if not 0 <= wind <= _MOST_WIND:
            raise RequestError(f"--wind must be from 0 to {_MOST_WIND:g} mm, not {wind:g}")
    if not options.reach and (options.wind or options.policy is not None):
        raise RequestError(f"--{'wind' if options.wind else 'policy'} goes with --reach")
    if not options.reach and options.policy is None and options.loops != _LOOPS:
        raise RequestError("--loops goes with --reach")
    for name, way in (("stitch", options.stitch), ("points", options.points)):
        if options.thesis and way == "default":
            raise RequestError(f"--thesis is --stitch thesis --points thesis: leave out --thesis or --{name} default")
    if not options.loops or len(set(options.loops)) < len(options.loops):
        raise RequestError("--loops must name each of some of open, again and policy once")
    if ("policy" in options.loops) != (options.policy is not None):
        raise RequestError("--loops policy goes with --policy RUN, a run of VisualStalkReach")
    if options.policy is not None:
        check_run(options.policy)
        may_run_code(options.policy, options.trust)
    check_extra("grasp", "grasping")
    if options.json is not None:
        check_writable(options.json, "--json")
    family = family_of(options, "grasping")
    if options.workers > 1:
        share_accelerator()
    check_devices()
    enable_compilation_cache()
    import jaxrl_vis.grasping
    import jaxrl_vis_envs.plants
    from jaxrl_vis.grasping import records
    from jaxrl_vis.grasping.perceive import Ways

    weights, name = (None, "truth") if options.masks == "truth" else weights_of(options.weights, options.masks)
    ways = Ways(*(options.thesis or each == "thesis" for each in (options.stitch, options.points)))
    about = {
        "synthetic": True,
        "version": __version__,
        "schema": records.SCHEMA,
        "code": code_digest(jaxrl_vis_envs.plants, jaxrl_vis.grasping, leave_out=_CHANGES_NO_RECORD),
        "family": family.name,
        "family_digest": hashlib.sha256(repr(family).encode()).hexdigest()[:12],
        "masks": name,
        "method": str(ways),
    }
    kept = RecordFile(options.json, about, records.summary_of)
    numbers = range(options.seed, options.seed + options.runs)

    def done(number: int, record: Record) -> None:
        kept.add(number, record)
        _print_run(number, kept.records[number])

    conditions = records.Conditions(family, weights, ways, options.workers)
    missing = [number for number in numbers if number not in kept]
    if len(missing) < len(numbers):
        print(f"evaluated before: {len(numbers) - len(missing)} of {len(numbers)} runs, in {options.json}")
    evaluate_all(functools.partial(records.evaluate_run, conditions), missing, options.workers, done)
    asked = [kept.records[number] for number in numbers]
    print(f"simulated runs of family {family.name}, masks: {name}, {ways}:")
    for each, value in records.summary_of([{**record, "reaches": {}} for record in asked]).items():
        print(f"  {each:20} {f'{value:.4f}' if isinstance(value, float) else value}")
    if options.reach:
        _reach(options, kept, numbers)
    return 0


def _reach(options: Eval, kept: RecordFile, numbers: range) -> None:
    """Sends the arm, and prints what came of it."""
    from jaxrl_vis.grasping import records

    policy, name = _policy(options)
    loops, winds = options.loops, options.wind or (0.0,)
    asked = [records.Reaches(loop, wind, "policy" in loops, policy, name) for loop in loops for wind in winds]
    scores = []
    for each in asked:
        records.reach_all(kept, numbers, each)
        scores.append(records.grasp_score([kept.records[number] for number in numbers], str(each)))
        print(f"the arm, {each}:")
        for share in scores[-1].shares:
            print(f"  {share}")
        print(f"  the thesis's ratio: {scores[-1].thesis_ratio:.4f}", flush=True)
    if len(asked) > 1:
        width = max(len(str(each)) for each in asked)
        print(f"{'':{width}}  with room  crowded  reachable  touched another")
        for each, score in zip(asked, scores):
            shares = (score.with_room, score.crowded, score.of_reachable, score.touches)
            print(
                f"{str(each):{width}}  " + "  ".join(f"{share.share:9.1%}" if share.of else f"{'none':>9}" for share in shares)
            )


def _policy(options: Eval) -> "tuple[Policy | None, str]":
    """The policy of the loop that has one, and its name."""
    if options.policy is None:
        return None, ""
    from jaxrl_vis.grasping.policy_loop import check_policy
    from jaxrl_vis.run.policy import load_policy

    policy = load_policy(options.policy, options.policy_seed)
    check_policy(policy)
    return policy, f"{options.policy.resolve().name} seed {policy.seed} iteration {policy.iteration}"


def _print_run(number: int, record: Record) -> None:
    """A line for one run."""
    from jaxrl_vis.grasping import records
    from jaxrl_vis.grasping.evaluate import summary

    score = records.score_of(record)
    one = summary([score])
    print(
        f"run {number}: {len(score.errors)} of {score.true} stalks, {score.found - len(score.errors)} false, "
        f"grasp points {one['point_median_mm']:.1f} mm, stitches {one['stitch_median_mm']:.1f} mm"
        + "".join(f"; {note}" for note in score.notes),
        flush=True,
    )
