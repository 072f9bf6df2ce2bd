"""From grasp points to attempts: where the robot stops for each, which way the arm goes, and what comes of it.

The robot stops where it took its pairs, and knows these places by its stitches. `choice` says from which of them, and how, it
tries each grasp point. The truth is used only to see what the jaws hold, and what they could have held.

open    the arm goes to where the grasp point was seen, and does not look again
again   every tenth of a second the pair at the stop finds the stalk anew; the arm follows to where it will be
policy  a policy of VisualStalkReach brings it there, by images from over the arm's shoulder (`policy_loop`)
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Literal

import jax
import numpy as np

from jaxrl_vis.run.trained.policy import Policy
from jaxrl_vis.stalks.grasping.arm import approach
from jaxrl_vis.stalks.grasping.arm.choice import Choice, choose, choose_nearest, stalk_radii
from jaxrl_vis.stalks.grasping.arm.policy_loop import HEIGHTS as POLICY_HEIGHTS
from jaxrl_vis.stalks.grasping.arm.policy_loop import STALKS as POLICY_STALKS
from jaxrl_vis.stalks.grasping.arm.policy_loop import reach_by_policy
from jaxrl_vis.stalks.grasping.arm.reach import ArmView, ReachResult, reach
from jaxrl_vis.stalks.grasping.evaluation.grasp_score import Attempt, Standing, match
from jaxrl_vis.stalks.grasping.evaluation.scoring import RADIUS, Scene, driven_stretch
from jaxrl_vis.stalks.grasping.perception.lines import PREFERRED, GraspPoint
from jaxrl_vis.stalks.grasping.perception.perceive import Perception
from jaxrl_vis.stalks.grasping.perception.stalk_segments import StalkSegments, stalk_segments
from jaxrl_vis.stalks.grasping.perception.stitch import Motion
from jaxrl_vis_envs.plants import Plot
from jaxrl_vis_envs.plants.stand import MAST_DISTANCE, STALKS, Stands, concatenated, stand_of_lines, stand_origin, stands_at

Loop = Literal["open", "again", "policy"]

_MAX_ARMS = 1024  # arms in a program
_AROUND = 0.1  # m: above and below the grasp a pair is asked for the stalk again; so far a line is as good as straight
_BESIDE = 0.015  # m: what it shows further away from the line is another stalk
_MIN_SEGMENTS = 5  # chords
_AHEAD = 1.5  # looks: a stalk is expected to go on as it did for so long after it was seen


@dataclasses.dataclass(frozen=True)
class Plan:
    """The attempts of one run, before the arm moves.

    Attributes:
        run: Its number.
        targets: [B, 3] float64, m in the plot's frame.
        stalks: [B] int, the stalk that each is matched with; -1 for none.
        errors: [B] float64, horizontal distance from that stalk, m; nan for none.
        sides: [B] float64, 1 or -1: which solution the arm takes.
        refused: [B] bool, whether other stalks are in the way of the arm, so that it is not sent.
        again: [B, 2] float64, by how much the pair at the stop alone is wrong about where the stalk is, along and across the
            row, m; nan where it does not show it.
        stands: The true stalks around the arm, from where it tries each.
        standing: The stalks of the stretch.
        seen: The stalks that were found around the arm, as `stands` without truth; None where nothing asks for them.
    """

    run: int
    targets: np.ndarray
    stalks: np.ndarray
    errors: np.ndarray
    sides: np.ndarray
    refused: np.ndarray
    again: np.ndarray
    stands: Stands
    standing: tuple[Standing, ...]
    detected: Stands | None = None


def plan(scene: Scene, perception: Perception, number: int, for_policy: bool = False) -> Plan:
    """Plan the attempts of a run.

    Args:
        scene: The run.
        perception: Its perception.
        number: Number of the run.
        for_policy: As the task that a policy has learned: from the stop that is nearest to the stalk, at one of its heights,
            among as many stalks; and nothing is refused.
    """
    plot, poses = scene.plot, scene.drive.poses
    low, high = driven_stretch(plot)
    masts, points = mast_positions(perception), perception.points
    chosen = choose_nearest(points, masts, POLICY_HEIGHTS) if for_policy else choose(points, masts)
    targets = np.array([_from_stop(choice, scene, perception) for choice in chosen]).reshape(-1, 3)
    places = np.array([[stalk.at_height(target[2])[0][:2] for stalk in plot.measured] for target in targets])
    places = places.reshape(len(targets), len(plot.measured), 2)
    stalks = match(targets[:, :2], places, RADIUS)
    origins = np.array([stand_origin(pose.position[0]) for pose in poses])
    standing = _standing(plot, origins, number)
    known = {stalk.stalk for stalk in standing}
    scored = [
        place
        for place, (target, stalk) in enumerate(zip(targets, stalks))
        if (stalk in known if stalk >= 0 else low <= target[0] <= high)
    ]
    off = np.array([_off(targets[place], places[place], stalks[place]) for place in scored]).reshape(-1, 2)
    chords = {
        stop: stalk_segments(perception.clouds[stop], scene.drive.stated, scene.mount, stop) for stop in range(len(poses))
    }
    again = [
        off[index] + _offset_at_stop(chosen[place], points[place], perception, chords) for index, place in enumerate(scored)
    ]
    at = origins[[chosen[place].stop for place in scored], 0]
    detected = [_detected_around(chosen[place], x, targets[place], scene, perception) for x, place in zip(at, scored)]
    return Plan(
        run=number,
        targets=targets[scored],
        stalks=stalks[scored],
        errors=np.linalg.norm(off, axis=-1),
        sides=np.array([chosen[place].side for place in scored], float),
        refused=np.array([chosen[place].is_blocked and not for_policy for place in scored], bool),
        again=np.array(again, float).reshape(-1, 2),
        stands=stands_at(plot, at, targets[scored], POLICY_STALKS if for_policy else STALKS),
        standing=standing,
        detected=concatenated(detected) if for_policy and detected else None,
    )


def mast_positions(perception: Perception) -> np.ndarray:
    """[S, 3], `Stands.origin` of the places where the pairs were taken, as the stitches say, in the last one's frame, m."""
    return np.array([motion(np.array([0.0, MAST_DISTANCE, 0.0])) for motion in perception.to_last]) * [1.0, 1.0, 0.0]


def _from_stop(choice: Choice, scene: Scene, perception: Perception, points: np.ndarray | None = None) -> np.ndarray:
    """Return the chosen point, or others [..., 3], as the robot at the stop knows them: [..., 3], m in the plot's frame."""
    from_there = perception.to_last[choice.stop].inverse()(choice.point if points is None else points)
    return scene.drive.poses[choice.stop].to_world(scene.mount.pose.to_camera(from_there))


def _detected_around(choice: Choice, x: float, target: np.ndarray, scene: Scene, perception: Perception) -> Stands:
    """The stalks that were found around an arm with its mast ``x`` m along the row, for a target [3] in the plot's frame."""
    height = float(choice.point[2])
    ends = np.array([point.at_height(np.array([height, height + _AROUND])) for point in perception.points])
    ends = _from_stop(choice, scene, perception, ends)
    return stand_of_lines(ends[:, 0], ends[:, 1] - ends[:, 0], stalk_radii(perception.points, height), x, target, POLICY_STALKS)


def _off(target: np.ndarray, places: np.ndarray, stalk: int) -> np.ndarray:
    """By how much [2] m a target is beside its stalk; nan without one."""
    return target[:2] - places[stalk] if stalk >= 0 else np.full(2, np.nan)


def _offset_at_stop(choice: Choice, point: GraspPoint, perception: Perception, chords: dict[int, StalkSegments]) -> np.ndarray:
    """By how much [2] m the pair at the stop alone shows the stalk beside where all pairs do; nan where it does not show it.

    Axes are those of the robot at the last pair, from which those at other stops and of the plot differ by little.
    """
    if choice.stop < 0:
        return np.full(2, np.nan)
    motion: Motion = perception.to_last[choice.stop]
    middles_here = motion(chords[choice.stop].middle)
    beside = (middles_here - point.at_height(middles_here[:, 2]))[:, :2]
    near = (np.abs(middles_here[:, 2] - choice.point[2]) < _AROUND) & (np.linalg.norm(beside, axis=1) < _BESIDE)
    return np.median(beside[near], axis=0) if near.sum() >= _MIN_SEGMENTS else np.full(2, np.nan)


def from_any_stop(points: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Return True for the points that the arm's geometry lets it reach from any of the places where the left camera was.

    Args:
        points: [B, 3], m in the robot frame of one pair.
        stops: [S, 3], where the robot frames of all pairs begin in that frame, m.

    Returns:
        [B] bool.
    """
    masts = (stops + [0.0, MAST_DISTANCE, 0.0]) * [1.0, 1.0, 0.0]
    return np.asarray(approach.reachable(masts[:, None], points[None]).any(axis=0))


def _standing(plot: Plot, origins: np.ndarray, number: int) -> tuple[Standing, ...]:
    """The true stalks of the stretch, and whether and how freely they could be reached at the preferred height."""
    low, high = driven_stretch(plot)
    middles = np.array([stalk.at_height(PREFERRED)[0] for stalk in plot.measured]).reshape(-1, 3)
    radii = np.array([0.5 * stalk.diameter(PREFERRED) for stalk in plot.measured])
    standing = []
    for index, middle in enumerate(middles):
        if not low <= middle[0] <= high:
            continue
        others = np.arange(len(middles)) != index
        best = approach.best_approach(origins, middle, middles[others, :2], radii[others], enough=np.inf)
        beside = np.linalg.norm(middles[others, :2] - middle[:2], axis=1)
        standing.append(Standing(number, index, best.stop >= 0, best.room, float(beside.min(initial=np.inf))))
    return tuple(standing)


def carry_out(
    plans: Iterable[Plan], wind_mm: float, loop: Loop = "open", policy: Policy | None = None, seed: int = 0
) -> list[Attempt]:
    """Send an arm to each target of all runs that is not refused, side by side.

    Args:
        plans: One for each run.
        wind_mm: Amplitude of the stalks' sway, mm. The wind around an arm depends neither on other runs nor on the loop.
        loop: Loop of the arm: with or without a second look, or a policy.
        policy: For that loop, and plans that were made for it.
        seed: Seed of the wind.
    """
    attempts: list[Attempt] = []
    for block in _blocks(list(plans)):
        numbers = np.repeat([plan.run for plan in block], [len(plan.targets) for plan in block])
        places = np.concatenate([np.arange(len(plan.targets)) for plan in block])
        targets, stalks, errors, sides, refused, again = (
            np.concatenate([getattr(plan, name) for plan in block])
            for name in ("targets", "stalks", "errors", "sides", "refused", "again")
        )
        stands = concatenated([plan.stands for plan in block])
        keys = wind_keys(numbers, places, seed)
        if loop == "policy":
            detected = [plan.detected for plan in block if plan.detected is not None]
            assert policy is not None and len(detected) == len(block)
            result = reach_by_policy(stands, concatenated(detected), targets, policy, keys, wind_mm)
        else:
            look = follow(stands, stalks, again) if loop == "again" else None
            result = reach(stands, targets, keys, wind_mm, sides=sides, look=look)
        attempts += to_attempts(stands, result, numbers, stalks, errors, refused)
    return attempts


def wind_keys(runs: np.ndarray, places: np.ndarray, seed: int = 0) -> jax.Array:
    """Keys [B] of the winds over the attempts in some ``places`` of some ``runs``, both [B] int."""
    of_runs = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(seed), runs)
    return jax.vmap(jax.random.fold_in)(of_runs, places)


def to_attempts(
    stands: Stands, result: ReachResult, runs: np.ndarray, stalks: np.ndarray, errors: np.ndarray, refused: np.ndarray
) -> list[Attempt]:
    """Convert the results of B reaches to attempts, for the score.

    Args:
        stands: The stalks around each arm.
        result: Their results.
        runs, stalks, errors, refused: [B], see `Plan`.
    """
    attempts = []
    for place in range(len(stands)):
        sent = not refused[place]
        others = (stands.stalk[place] != stalks[place]) & sent
        attempts.append(
            Attempt(
                run=int(runs[place]),
                stalk=int(stalks[place]) if stalks[place] >= 0 else None,
                held=frozenset(stands.stalk[place][result.held[place] & sent].tolist()),
                reachable=bool(result.reachable[place]),
                refused=bool(refused[place]),
                collided=bool((result.touched[place] & others).any()),
                brushed=bool((result.brushed[place] & others).any()),
                aim_error=float(errors[place]),
            )
        )
    return attempts


def follow(stands: Stands, stalks: np.ndarray, again: np.ndarray) -> Callable[[ArmView], np.ndarray]:
    """Return a function that finds the targets [B, 3] again from the view on the way, for `reach`.

    The pair at the stop stands still. What it finds is where the stalk is, plus the error that it alone made with this stalk
    at rest; what it did not show at rest it does not find again. A result is there one look later, and the stalk is expected
    to go on as it did between the last two. That the arm itself may hide the stalk is left out.

    Args:
        stands: The stalks around each arm.
        stalks: [B] int, which one each is for.
        again: [B, 2], see `Plan`.
    """
    known = (stands.stalk == stalks[:, None]) & (stalks >= 0)[:, None]
    slot = known.argmax(axis=1)
    error = np.where(known.any(axis=1)[:, None], again, np.nan)
    places: list[np.ndarray] = []

    def look(sight: ArmView) -> np.ndarray:
        place = sight.stalks[np.arange(len(slot)), slot]
        place[:, :2] += error
        places.append(place)
        if len(places) < 3:
            return np.full_like(place, np.nan)
        before, last = places[-3:-1]
        ahead = _AHEAD * (last - before)
        ahead[:, 2] = 0.0  # the height of the grasp stays what it was chosen to be
        return last + ahead

    return look


def _blocks(plans: list[Plan]) -> Iterator[list[Plan]]:
    """Plans that are carried out together: as many as have at most `_MAX_ARMS` targets, but at least one."""
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
