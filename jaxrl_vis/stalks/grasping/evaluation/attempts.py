"""From grasp points to attempts: planning of stops and approaches, their simulation, and the results.

The robot stops where it took its pairs, and its stitches give these positions. `choice` chooses the stop and approach for
each grasp point. The ground truth is used only to score what the jaws hold, and what they could have held.

open    open loop: the arm moves to the grasp point as perceived, without looking again
again   every 0.1 s the pair at the stop detects the stalk again, and the arm follows its predicted position
policy  a policy of VisualStalkReach moves the arm, by images from over its shoulder (`policy_loop`)
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Literal

import jax
import numpy as np

from jaxrl_vis.run.trained.policy import Policy
from jaxrl_vis.stalks.grasping.arm import approach
from jaxrl_vis.stalks.grasping.arm.choice import Choice, choose_approaches, choose_nearest, stalk_radii
from jaxrl_vis.stalks.grasping.arm.policy_loop import HEIGHTS as POLICY_HEIGHTS
from jaxrl_vis.stalks.grasping.arm.policy_loop import STALKS as POLICY_STALKS
from jaxrl_vis.stalks.grasping.arm.policy_loop import reach_by_policy
from jaxrl_vis.stalks.grasping.arm.reach import ArmView, ReachResult, reach
from jaxrl_vis.stalks.grasping.evaluation.grasp_score import Attempt, TrueStalk, match_grasps
from jaxrl_vis.stalks.grasping.evaluation.scoring import RADIUS, Scene, driven_stretch
from jaxrl_vis.stalks.grasping.perception.lines import PREFERRED, GraspPoint
from jaxrl_vis.stalks.grasping.perception.perceive import Perception
from jaxrl_vis.stalks.grasping.perception.stalk_segments import StalkSegments, extract_stalk_segments
from jaxrl_vis.stalks.grasping.perception.stitch import Motion
from jaxrl_vis_envs.plants import Plot
from jaxrl_vis_envs.plants.stand import (
    MAST_DISTANCE,
    STALKS,
    Stands,
    concatenate_stands,
    stand_of_lines,
    stand_origin,
    stands_at,
)

Loop = Literal["open", "again", "policy"]

_MAX_ARMS = 1024  # arms per call of a compiled program
_HALF_RANGE = (
    0.1  # m: range above and below the grasp in which a pair detects the stalk again, short enough for a straight line
)
_MAX_OFFSET = 0.015  # m: segments farther than this from the line belong to another stalk
_MIN_SEGMENTS = 5  # minimum number of segments
_HORIZON = 1.5  # looks: horizon of the linear extrapolation of a stalk's motion


@dataclasses.dataclass(frozen=True)
class Plan:
    """Planned attempts of one run.

    Attributes:
        run: Number of the run.
        targets: [B, 3] float64, where the jaws should close, m in the plot's frame.
        stalks: [B] int, index of the stalk that each target is matched with; -1 for none.
        errors: [B] float64, horizontal distance of the target from that stalk, m; NaN for none.
        sides: [B] float64, 1 or -1: solution of the inverse kinematics.
        refused: [B] bool, True if the arm is not sent because other stalks are in its path.
        redetection_errors: [B, 2] float64, error of the stalk's position as detected by the pair at the stop alone, along and
            across the row, m; NaN where the pair does not show the stalk.
        stands: True stalks around the arm at the stop of each attempt.
        standing: True stalks of the stretch that the run passes.
        detected: Detected stalks around the arm, laid out like `stands`; None unless planned for a policy, or without targets.
    """

    run: int
    targets: np.ndarray
    stalks: np.ndarray
    errors: np.ndarray
    sides: np.ndarray
    refused: np.ndarray
    redetection_errors: np.ndarray
    stands: Stands
    standing: tuple[TrueStalk, ...]
    detected: Stands | None = None


def plan(scene: Scene, perception: Perception, number: int, for_policy: bool = False) -> Plan:
    """Plan the attempts of a run.

    Args:
        scene: Images and ground truth of the run.
        perception: Perception of the run.
        number: Number of the run.
        for_policy: Plan as in the task that policies are trained on: from the stop nearest to the stalk, within the task's
            range of heights, among its number of stalks, and without refusals.

    Returns:
        The attempts at targets that are matched with a stalk of the stretch, or with none and within the stretch.
    """
    plot, poses = scene.plot, scene.drive.poses
    low, high = driven_stretch(plot)
    masts, points = mast_positions(perception), perception.points
    chosen = choose_nearest(points, masts, POLICY_HEIGHTS) if for_policy else choose_approaches(points, masts)
    targets = np.array([_to_plot_frame(choice, scene, perception) for choice in chosen]).reshape(-1, 3)
    places = np.array([[stalk.at_height(target[2])[0][:2] for stalk in plot.measured] for target in targets])
    places = places.reshape(len(targets), len(plot.measured), 2)
    stalks = match_grasps(targets[:, :2], places, RADIUS)
    origins = np.array([stand_origin(pose.position[0]) for pose in poses])
    standing = _true_stalks(plot, origins, number)
    known = {stalk.stalk for stalk in standing}
    scored = [
        place
        for place, (target, stalk) in enumerate(zip(targets, stalks))
        if (stalk in known if stalk >= 0 else low <= target[0] <= high)
    ]
    off = np.array([_offset_from_stalk(targets[place], places[place], stalks[place]) for place in scored]).reshape(-1, 2)
    segments = {
        stop: extract_stalk_segments(perception.clouds[stop], scene.drive.stated, scene.mount, stop)
        for stop in range(len(poses))
    }
    again = [
        off[index] + _offset_at_stop(chosen[place], points[place], perception, segments) for index, place in enumerate(scored)
    ]
    at = origins[[chosen[place].stop for place in scored], 0]
    detected = [_detections_around(chosen[place], x, targets[place], scene, perception) for x, place in zip(at, scored)]
    return Plan(
        run=number,
        targets=targets[scored],
        stalks=stalks[scored],
        errors=np.linalg.norm(off, axis=-1),
        sides=np.array([chosen[place].side for place in scored], float),
        refused=np.array([chosen[place].is_blocked and not for_policy for place in scored], bool),
        redetection_errors=np.array(again, float).reshape(-1, 2),
        stands=stands_at(plot, at, targets[scored], POLICY_STALKS if for_policy else STALKS),
        standing=standing,
        detected=concatenate_stands(detected) if for_policy and detected else None,
    )


def mast_positions(perception: Perception) -> np.ndarray:
    """Return the `Stands.origin` [S, 3] of each stop as estimated by the stitches, m in the robot frame of the last pair."""
    return np.array([motion(np.array([0.0, MAST_DISTANCE, 0.0])) for motion in perception.to_last]) * [1.0, 1.0, 0.0]


def _to_plot_frame(choice: Choice, scene: Scene, perception: Perception, points: np.ndarray | None = None) -> np.ndarray:
    """Map the chosen point, or ``points`` [..., 3], to the plot's frame by the stitches and the true pose at the stop.

    Points are in the robot frame of the last pair, m. The result [..., 3] contains the errors of the stitches.
    """
    from_there = perception.to_last[choice.stop].inverse()(choice.point if points is None else points)
    return scene.drive.poses[choice.stop].to_world(scene.mount.pose.to_camera(from_there))


def _detections_around(choice: Choice, x: float, target: np.ndarray, scene: Scene, perception: Perception) -> Stands:
    """Return the detected stalks around an arm with its mast ``x`` m along the row, for a target [3] in the plot's frame."""
    height = float(choice.point[2])
    ends = np.array([point.at_height(np.array([height, height + _HALF_RANGE])) for point in perception.points])
    ends = _to_plot_frame(choice, scene, perception, ends)
    return stand_of_lines(ends[:, 0], ends[:, 1] - ends[:, 0], stalk_radii(perception.points, height), x, target, POLICY_STALKS)


def _offset_from_stalk(target: np.ndarray, positions: np.ndarray, stalk: int) -> np.ndarray:
    """Return the horizontal offset [2] of a target from its stalk, m; NaN without one."""
    return target[:2] - positions[stalk] if stalk >= 0 else np.full(2, np.nan)


def _offset_at_stop(
    choice: Choice, point: GraspPoint, perception: Perception, segments: dict[int, StalkSegments]
) -> np.ndarray:
    """Return the horizontal offset [2] m between the stalk as detected by the pair at the stop alone and by all pairs.

    NaN if there is no stop or its pair does not show the stalk. Axes are those of the robot at the last pair, which differ
    little from those at other stops and of the plot.
    """
    if choice.stop < 0:
        return np.full(2, np.nan)
    motion: Motion = perception.to_last[choice.stop]
    middles_here = motion(segments[choice.stop].middle)
    offsets = (middles_here - point.at_height(middles_here[:, 2]))[:, :2]
    near = (np.abs(middles_here[:, 2] - choice.point[2]) < _HALF_RANGE) & (np.linalg.norm(offsets, axis=1) < _MAX_OFFSET)
    return np.median(offsets[near], axis=0) if near.sum() >= _MIN_SEGMENTS else np.full(2, np.nan)


def reachable_from_any_stop(points: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Return True for points that are within the arm's reach from any of the stops.

    Args:
        points: [B, 3], m in the robot frame of one pair.
        stops: [S, 3], origins of the robot frames of all pairs in that frame, m.

    Returns:
        [B] bool.
    """
    masts = (stops + [0.0, MAST_DISTANCE, 0.0]) * [1.0, 1.0, 0.0]
    return np.asarray(approach.is_within_reach(masts[:, None], points[None]).any(axis=0))


def _true_stalks(plot: Plot, origins: np.ndarray, number: int) -> tuple[TrueStalk, ...]:
    """Return the true stalks of the stretch that the run passes, with their reachability and room at the preferred height.

    Args:
        plot: The plot.
        origins: [S, 3] float64, `Stands.origin` of the arm at each stop, m in the plot's frame.
        number: Number of the run.
    """
    low, high = driven_stretch(plot)
    middles = np.array([stalk.at_height(PREFERRED)[0] for stalk in plot.measured]).reshape(-1, 3)
    radii = np.array([0.5 * stalk.diameter(PREFERRED) for stalk in plot.measured])
    standing = []
    for index, middle in enumerate(middles):
        if not low <= middle[0] <= high:
            continue
        others = np.arange(len(middles)) != index
        best = approach.best_approach(origins, middle, middles[others, :2], radii[others], enough=np.inf)
        distances = np.linalg.norm(middles[others, :2] - middle[:2], axis=1)
        standing.append(TrueStalk(number, index, best.stop >= 0, best.room, float(distances.min(initial=np.inf))))
    return tuple(standing)


def execute_plans(
    plans: Iterable[Plan], wind_mm: float, loop: Loop = "open", policy: Policy | None = None, seed: int = 0
) -> list[Attempt]:
    """Simulate an arm for each target of all runs, in batches.

    Args:
        plans: One plan for each run; for the loop ``policy``, made with ``for_policy``.
        wind_mm: Amplitude of the stalks' sway, mm. The wind around an arm depends neither on other runs nor on the loop.
        loop: Control loop of the arm: open, with repeated detection, or a policy.
        policy: Policy of the loop ``policy``; None for the others.
        seed: Seed of the wind.

    Returns:
        One attempt for each target, in the order of the plans; refused ones hold and touch nothing.

    Raises:
        RequestError: The policy is not one of VisualStalkReach, or does not observe single images.
    """
    attempts: list[Attempt] = []
    for block in _blocks(list(plans)):
        numbers = np.repeat([plan.run for plan in block], [len(plan.targets) for plan in block])
        places = np.concatenate([np.arange(len(plan.targets)) for plan in block])
        targets, stalks, errors, sides, refused, again = (
            np.concatenate([getattr(plan, name) for plan in block])
            for name in ("targets", "stalks", "errors", "sides", "refused", "redetection_errors")
        )
        stands = concatenate_stands([plan.stands for plan in block])
        keys = wind_keys(numbers, places, seed)
        if loop == "policy":
            detected = [plan.detected for plan in block if plan.detected is not None]
            assert policy is not None and len(detected) == len(block)
            result = reach_by_policy(stands, concatenate_stands(detected), targets, policy, keys, wind_mm)
        else:
            look = redetecting_observer(stands, stalks, again) if loop == "again" else None
            result = reach(stands, targets, keys, wind_mm, sides=sides, observer=look)
        attempts += to_attempts(stands, result, numbers, stalks, errors, refused)
    return attempts


def wind_keys(runs: np.ndarray, indices: np.ndarray, seed: int = 0) -> jax.Array:
    """Return typed keys [B] for sampling the wind, derived from each attempt's run, its index within the run, and the seed.

    Args:
        runs: [B] int, numbers of the runs.
        indices: [B] int, indices of the attempts within their runs.
        seed: Seed of the wind.
    """
    of_runs = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(seed), runs)
    return jax.vmap(jax.random.fold_in)(of_runs, indices)


def to_attempts(
    stands: Stands, result: ReachResult, runs: np.ndarray, stalks: np.ndarray, errors: np.ndarray, refused: np.ndarray
) -> list[Attempt]:
    """Convert the results of B reaches to attempts for the score.

    Args:
        stands: True stalks around each arm.
        result: Results of the reaches.
        runs, stalks, errors, refused: [B] each, see `Plan`.
    """
    attempts = []
    for index in range(len(stands)):
        sent = not refused[index]
        others = (stands.stalk[index] != stalks[index]) & sent
        attempts.append(
            Attempt(
                run=int(runs[index]),
                stalk=int(stalks[index]) if stalks[index] >= 0 else None,
                held=frozenset(stands.stalk[index][result.held[index] & sent].tolist()),
                reachable=bool(result.reachable[index]),
                refused=bool(refused[index]),
                collided=bool((result.arm_contact[index] & others).any()),
                brushed=bool((result.gripper_contact[index] & others).any()),
                aim_error=float(errors[index]),
            )
        )
    return attempts


def redetecting_observer(stands: Stands, stalks: np.ndarray, redetected: np.ndarray) -> Callable[[ArmView], np.ndarray]:
    """Return an ``observer`` for `reach` that simulates detecting the targets [B, 3] again on the way.

    The pair at the stop does not move. It detects the stalk at its true position plus the error that the pair alone makes with
    this stalk at rest; stalks that it does not show at rest are not detected. A detection is available one call later, and the
    position is extrapolated linearly from the last two, so that the first two calls return NaN. Occlusion by the arm itself is
    not modelled. The function keeps the history of one batch of reaches: do not reuse it for another.

    Args:
        stands: True stalks around each arm.
        stalks: [B] int, index of the stalk that each arm reaches for; -1 for none.
        redetected: [B, 2], m, see `Plan.redetection_errors`.
    """
    known = (stands.stalk == stalks[:, None]) & (stalks >= 0)[:, None]
    slot = known.argmax(axis=1)
    error = np.where(known.any(axis=1)[:, None], redetected, np.nan)
    places: list[np.ndarray] = []

    def look(sight: ArmView) -> np.ndarray:
        place = sight.stalks[np.arange(len(slot)), slot]
        place[:, :2] += error
        places.append(place)
        if len(places) < 3:
            return np.full_like(place, np.nan)
        before, last = places[-3:-1]
        ahead = _HORIZON * (last - before)
        ahead[:, 2] = 0.0  # keep the chosen height of the grasp
        return last + ahead

    return look


def _blocks(plans: list[Plan]) -> Iterator[list[Plan]]:
    """Yield batches of consecutive plans with at most `_MAX_ARMS` targets in total, or single larger ones; skip empty plans."""
    block: list[Plan] = []
    for plan in plans:
        if not len(plan.targets):
            continue
        if block and sum(len(other.targets) for other in block) + len(plan.targets) > _MAX_ARMS:
            yield block
            block = []
        block.append(plan)
    if block:
        yield block
