"""``jaxrl-vis grasp eval``: score grasp perception and simulated grasps against ground truth."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from jaxrl_vis.cli.checks import check_counts, check_run, may_run_code
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices, enable_compilation_cache
from jaxrl_vis.host.worker_pool import Record, RecordFile, share_accelerator
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.stalks.cli.options import EvaluationOptions, check_extra, check_masks

if TYPE_CHECKING:
    from jaxrl_vis.run.trained.policy import Policy

_MAX_WIND = 100.0  # mm
_LOOPS: tuple[Literal["open", "again", "policy"], ...] = ("again",)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Eval(EvaluationOptions):
    """Compare masks, stitched clouds and grasp points with the exact ground truth of synthetic runs, rendered on the fly."""

    masks: Literal["gan", "segmentation", "truth"] = "segmentation"
    """Source of masks: the shipped segmentation, a GAN that you have trained (--weights), or the ground truth, to evaluate
    everything downstream of the masks."""
    thesis: bool = False
    """Use the thesis's stitching and grasp point detection: --stitch thesis --points thesis."""
    stitch: Literal["default", "thesis"] | None = None
    """Method of stitching clouds; default if not given."""
    points: Literal["default", "thesis"] | None = None
    """Method of detecting grasp points; default if not given."""
    runs: int = 10
    """Number of runs."""
    reach: bool = False
    """Also move the simulated arm to every grasp point, and score its grasps."""
    wind: tuple[float, ...] = ()
    """With --reach: amplitude of the stalks' sway in the wind, mm; 0 if not given. Perception runs only once for several
    amplitudes, such as 0 10 20."""
    loops: tuple[Literal["open", "again", "policy"], ...] = _LOOPS
    """With --reach: control loops of the arm: move to where the stalk was seen (open), detect it again on the way (again), or
    follow a policy of VisualStalkReach (policy). With policy, all loops are compared on scenes like those of its task."""
    policy: Path | None = None
    """Run folder of the policy, for --loops policy."""
    trust: bool = False
    """With --policy: run the code of its run without asking, if its task is module:Name and was trained by somebody else."""
    policy_seed: int | None = None
    """With --policy: seed of the policy within its run; the first if not given."""


def check_wind(wind: float) -> None:
    """Check an amplitude of the stalks' sway in the wind, mm.

    Raises:
        RequestError: It is not from 0 to 100 mm.
    """
    if not 0 <= wind <= _MAX_WIND:
        raise RequestError(f"--wind must be from 0 to {_MAX_WIND:g} mm, not {wind:g}")


def _check(options: Eval) -> None:
    """Raise a `RequestError` if an option is invalid or options contradict each other."""
    check_counts(runs=options.runs)
    options.check()
    check_masks(options.masks, options.weights)
    for wind in options.wind:
        check_wind(wind)
    if not options.reach and (options.wind or options.policy is not None):
        raise RequestError(f"--{'wind' if options.wind else 'policy'} goes with --reach")
    if not options.reach and options.policy is None and options.loops != _LOOPS:
        raise RequestError("--loops goes with --reach")
    for name, method in (("stitch", options.stitch), ("points", options.points)):
        if options.thesis and method == "default":
            raise RequestError(f"--thesis is --stitch thesis --points thesis: leave out --thesis or --{name} default")
    if not options.loops or len(set(options.loops)) < len(options.loops):
        raise RequestError("--loops must name each of some of open, again and policy once")
    if ("policy" in options.loops) != (options.policy is not None):
        raise RequestError("--loops policy goes with --policy RUN, a run of VisualStalkReach")


def evaluate(options: Eval) -> int:
    """Evaluate the runs, print their scores, and return the exit status.

    Raises:
        RequestError: An option, the weights or the policy is invalid, a package is missing, or no device works.
    """
    _check(options)
    if options.policy is not None:
        check_run(options.policy)
        may_run_code(options.policy, options.trust)
    check_extra("grasping")
    if options.json is not None:
        check_writable(options.json, "--json")
    family = options.read_family("grasping")
    if options.workers > 1:
        share_accelerator()
    check_devices()
    enable_compilation_cache()
    from jaxrl_vis.stalks.grasping.evaluation import records
    from jaxrl_vis.stalks.grasping.masks.loading import resolve_weights
    from jaxrl_vis.stalks.grasping.perception.perceive import Variant

    weights, name = (None, "truth") if options.masks == "truth" else resolve_weights(options.weights, options.masks)
    variant = Variant(*(options.thesis or method == "thesis" for method in (options.stitch, options.points)))
    conditions = records.Conditions(family, weights, name, variant, options.workers)
    numbers = range(options.seed, options.seed + options.runs)

    def started(count: int) -> None:
        if count:
            print(f"evaluated before: {count} of {len(numbers)} runs, in {options.json}")

    table = records.evaluate_runs(conditions, numbers, options.json, started, _print_run)
    print(f"simulated runs of family {family.name}, masks: {name}, {variant}:")
    perceived = [{**table.records[number], "reaches": {}} for number in numbers]
    for figure, value in records.summarize(perceived).items():
        print(f"  {figure:20} {f'{value:.4f}' if isinstance(value, float) else value}")
    if options.reach:
        _reach_all(options, table, numbers)
    return 0


def _reach_all(options: Eval, table: RecordFile, numbers: range) -> None:
    """Run the simulated arm for each loop and wind, add its reaches to ``table``, and print the scores of its grasps."""
    from jaxrl_vis.stalks.grasping.evaluation import records

    policy, name = _load_policy(options)
    loops, winds = options.loops, options.wind or (0.0,)
    kinds = [records.Reaches(loop, wind, "policy" in loops, policy, name) for loop in loops for wind in winds]
    scores = {}
    for reaches in kinds:
        records.reach_all(table, numbers, reaches)
        score = records.grasp_score([table.records[number] for number in numbers], str(reaches))
        scores[str(reaches)] = score
        print(f"the arm, {reaches}:")
        for proportion in score.proportions:
            print(f"  {proportion}")
        print(f"  the thesis's ratio: {score.thesis_ratio:.4f}", flush=True)
    if len(scores) > 1:
        width = max(map(len, scores))
        print(f"{'':{width}}  with room  crowded  reachable  touched another")
        for kind, score in scores.items():
            proportions = (score.with_room, score.crowded, score.of_reachable, score.touches)
            print(
                f"{kind:{width}}  "
                + "  ".join(f"{proportion.value:9.1%}" if proportion.total else f"{'none':>9}" for proportion in proportions)
            )


def _load_policy(options: Eval) -> "tuple[Policy | None, str]":
    """Load the policy for the loop ``policy``, and return it with a name that identifies it; None and "" without one."""
    if options.policy is None:
        return None, ""
    from jaxrl_vis.run.trained.policy import load_policy
    from jaxrl_vis.stalks.grasping.arm.policy_loop import check_policy

    policy = load_policy(options.policy, options.policy_seed)
    check_policy(policy)
    return policy, f"{options.policy.resolve().name} seed {policy.seed} iteration {policy.iteration}"


def _print_run(number: int, record: Record) -> None:
    """Print one line with the scores of a run."""
    from jaxrl_vis.stalks.grasping.evaluation import records
    from jaxrl_vis.stalks.grasping.evaluation.scoring import summarize_scores

    score = records.read_score(record)
    one = summarize_scores([score])
    print(
        f"run {number}: {len(score.errors)} of {score.true} stalks, {score.detected - len(score.errors)} false, "
        f"grasp points {one['point_median_mm']:.1f} mm, stitches {one['stitch_median_mm']:.1f} mm"
        + "".join(f"; {note}" for note in score.notes),
        flush=True,
    )
