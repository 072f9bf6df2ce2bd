"""Score of grasps: one target, one stalk between the jaws. NumPy and SciPy only.

The thesis counts stalks: 1 - |grasped - attempted| / attempted, averaged over runs, where misses and double grasps cancel.
Here an attempt succeeds if exactly its target stalk is between the jaws at closure. Failures are counted by kind, and the
thesis's ratio is computed as well.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

MIN_JAW_ROOM = 0.005
"""Minimum room beside the open jaws, m, below which a stalk is crowded: the jaws cannot take it alone."""
NEIGHBOUR_BIN_EDGES = (0.0, 0.03, 0.04, 0.05, 0.065, 0.1, math.inf)
"""Bin edges of distances to the nearest neighbour, m, centre to centre."""
OUTCOMES = ("success", "miss", "wrong stalk", "several", "unreachable", "refused")
STAGES = ("grasped", "not detected", "aimed beside", "out of reach", "refused", "not held", "several held")


@dataclasses.dataclass(frozen=True)
class Attempt:
    """Attempt at one grasp point, and its result.

    Attributes:
        run: Number of the run.
        stalk: Index of the stalk that the grasp point is matched with (`match_grasps`); None if there is none.
        held: Indices of the stalks between the closed jaws.
        reachable: True if the grasp point is within the arm's reach; if not, nothing is held.
        refused: True if the arm was not sent because detected stalks were in its path; if so, nothing is held.
        collided: True if upper arm or forearm touched a stalk other than the target.
        brushed: True if the gripper touched such a stalk before the jaws began to close.
        aim_error: Horizontal distance of the grasp point from the centre of the stalk, m; NaN without one.
    """

    run: int
    stalk: int | None
    held: frozenset[int]
    reachable: bool = True
    refused: bool = False
    collided: bool = False
    brushed: bool = False
    aim_error: float = math.nan

    @property
    def sent(self) -> bool:
        """True if the arm moved."""
        return self.reachable and not self.refused

    @property
    def outcome(self) -> str:
        """Outcome, one of `OUTCOMES`."""
        if not self.reachable:
            return "unreachable"
        if self.refused:
            return "refused"
        if len(self.held) > 1:
            return "several"
        if not self.held:
            return "miss"
        return "success" if self.held == {self.stalk} else "wrong stalk"


@dataclasses.dataclass(frozen=True)
class TrueStalk:
    """Ground truth of one stalk of the stretch that a run passes.

    Attributes:
        run: Number of the run.
        stalk: Index of the stalk.
        reachable: True if the stalk is within the arm's reach from any stop of the run.
        room: Clearance between the open gripper and other stalks on the best path, m; -inf if unreachable; see
            `approach.clearance`.
        neighbour: Distance to the nearest other stalk at the height of the grasp, centre to centre, m; inf if there is none.
    """

    run: int
    stalk: int
    reachable: bool
    room: float
    neighbour: float

    @property
    def crowded(self) -> bool:
        """True if the jaws cannot take the stalk alone: its `room` is less than `MIN_JAW_ROOM`."""
        return self.room < MIN_JAW_ROOM


@dataclasses.dataclass(frozen=True)
class Proportion:
    """Proportion with its Wilson interval of 95 %; NaN if the total is 0.

    Attributes:
        name: Name of the proportion.
        count: Number of hits.
        total: Total number.
    """

    name: str
    count: int
    total: int

    @property
    def value(self) -> float:
        """Proportion, 0 to 1."""
        return self.count / self.total if self.total else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper bound of the Wilson interval."""
        return wilson_interval(self.count, self.total)

    def __str__(self) -> str:
        if not self.total:
            return f"{self.name}: none"
        low, high = self.interval
        return f"{self.name}: {self.value:.1%} ({self.count} of {self.total}; {low:.1%} to {high:.1%})"


@dataclasses.dataclass(frozen=True)
class Score:
    """Score of all runs.

    Attributes:
        of_sent: Successes among the attempts that were sent.
        with_room: Stalks grasped alone among the reachable ones that are not crowded.
        crowded: Stalks grasped alone among the reachable ones that are crowded.
        of_reachable: Stalks grasped alone among all reachable ones.
        of_all: Stalks grasped alone among all stalks of the stretches: the end-to-end success rate.
        outcomes: Attempts with each of `OUTCOMES` among all attempts.
        stages: Reachable stalks by the stage that they reached, one entry for each of `STAGES`.
        false_targets: Attempts without a matched stalk among all attempts.
        collisions: Attempts whose links touched another stalk, among those sent.
        brushes: Attempts whose open gripper touched another stalk, among those sent.
        touches: Attempts with a collision or a brush, among those sent.
        by_neighbour: Stalks grasped alone among the reachable ones in each bin of `NEIGHBOUR_BIN_EDGES`.
        thesis_ratio: The thesis's metric, mean over runs with attempts sent; NaN if there are none.
        runs: Number of runs with attempts sent.
        aim_errors: [A] float64, `Attempt.aim_error` of the attempts with a matched stalk, m.
    """

    of_sent: Proportion
    with_room: Proportion
    crowded: Proportion
    of_reachable: Proportion
    of_all: Proportion
    outcomes: tuple[Proportion, ...]
    stages: tuple[Proportion, ...]
    false_targets: Proportion
    collisions: Proportion
    brushes: Proportion
    touches: Proportion
    by_neighbour: tuple[Proportion, ...]
    thesis_ratio: float
    runs: int
    aim_errors: np.ndarray

    @property
    def proportions(self) -> tuple[Proportion, ...]:
        """All proportions, in the order of a table's rows."""
        first = (self.of_sent, self.with_room, self.crowded, self.of_reachable, self.of_all)
        return (
            *first,
            *self.outcomes,
            self.false_targets,
            self.collisions,
            self.brushes,
            self.touches,
            *self.stages,
            *self.by_neighbour,
        )


def wilson_interval(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a proportion ``count / total``; (NaN, NaN) if ``total`` is 0.

    Args:
        count: Number of hits.
        total: Total number.

    Raises:
        ValueError: ``count`` is not from 0 to ``total``.
    """
    if not 0 <= count <= total:
        raise ValueError(f"a count must be from 0 to what it is of, got {count} of {total}")
    if not total:
        return math.nan, math.nan
    z = 1.959964  # quantile of the standard normal distribution
    value, square = count / total, z * z / total
    middle = (value + square / 2) / (1 + square)
    half = z / (1 + square) * math.sqrt(value * (1 - value) / total + square / (4 * total))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def match_grasps(points: np.ndarray, stalks: np.ndarray, gate: float) -> np.ndarray:
    """Match grasp points with stalks one to one: as many pairs as possible, with minimum total distance.

    Args:
        points: [P, 2], grasp points, m.
        stalks: [S, 2], centres of the stalks at the height of the grasps, m; or [P, S, 2] if heights differ.
        gate: Maximum distance of a pair, m.

    Returns:
        [P] int: index of the stalk, -1 for none.
    """
    points, stalks = np.asarray(points, float).reshape(-1, 2), np.asarray(stalks, float)
    if stalks.ndim == 2:
        stalks = np.broadcast_to(stalks, (len(points), *stalks.shape))
    matched = np.full(len(points), -1)
    if not points.size or not stalks.size:
        return matched
    distance = np.linalg.norm(points[:, None] - stalks, axis=-1)
    # A pair beyond the gate costs more than any number of pairs within it.
    cost = np.where(distance <= gate, distance, gate * (min(distance.shape) + 1.0))
    for point, stalk in zip(*linear_sum_assignment(cost)):
        if distance[point, stalk] <= gate:
            matched[point] = stalk
    return matched


def score(attempts: Iterable[Attempt], stalks: Iterable[TrueStalk], tolerance: float = 0.015) -> Score:
    """Score attempts against the ground truth.

    Args:
        attempts: Attempts of all runs, at most one for each stalk.
        stalks: All stalks of the stretches that the runs pass.
        tolerance: Aim error above which a failed attempt that was sent counts as aimed beside its stalk, m.

    Raises:
        ValueError: Two attempts of a run are for one stalk, a stalk is listed twice, or an attempt is for an unknown stalk.
    """
    attempts, stalks = list(attempts), list(stalks)
    known = Counter((stalk.run, stalk.stalk) for stalk in stalks)
    tried = Counter((attempt.run, attempt.stalk) for attempt in attempts if attempt.stalk is not None)
    for what, counted in (("stalk is listed", known), ("stalk has an attempt", tried)):
        twice = [place for place, count in counted.items() if count > 1]
        if twice:
            raise ValueError(f"a {what} more than once: stalk {twice[0][1]} of run {twice[0][0]}")
    strange = sorted(set(tried) - set(known))
    if strange:
        raise ValueError(f"an attempt is for stalk {strange[0][1]} of run {strange[0][0]}, which is not among the stalks")
    by_place = {(attempt.run, attempt.stalk): attempt for attempt in attempts if attempt.stalk is not None}
    stage_of = [_stage(by_place.get((stalk.run, stalk.stalk)), tolerance) for stalk in stalks]
    reachable = [(stalk, stage) for stalk, stage in zip(stalks, stage_of) if stalk.reachable]
    sent = [attempt for attempt in attempts if attempt.sent]

    def grasped(name: str, subset: Sequence[str]) -> Proportion:
        return Proportion(name, sum(stage == "grasped" for stage in subset), len(subset))

    outcomes = Counter(attempt.outcome for attempt in attempts)
    stages = Counter(stage for _, stage in reachable)
    ratio, runs = thesis_ratio(attempts)
    return Score(
        of_sent=Proportion("attempts: exactly the target held", outcomes["success"], len(sent)),
        with_room=grasped("reachable stalks with room", [stage for stalk, stage in reachable if not stalk.crowded]),
        crowded=grasped("reachable stalks, crowded", [stage for stalk, stage in reachable if stalk.crowded]),
        of_reachable=grasped("all reachable stalks", [stage for _, stage in reachable]),
        of_all=grasped("all stalks", stage_of),
        outcomes=tuple(Proportion(f"attempts: {name}", outcomes[name], len(attempts)) for name in OUTCOMES),
        stages=tuple(Proportion(f"reachable stalks: {name}", stages[name], len(reachable)) for name in STAGES),
        false_targets=Proportion("attempts: no stalk there", sum(attempt.stalk is None for attempt in attempts), len(attempts)),
        collisions=Proportion("attempts: links touched another stalk", sum(attempt.collided for attempt in sent), len(sent)),
        brushes=Proportion("attempts: jaws touched another stalk", sum(attempt.brushed for attempt in sent), len(sent)),
        touches=Proportion(
            "attempts: links or jaws did", sum(attempt.collided or attempt.brushed for attempt in sent), len(sent)
        ),
        by_neighbour=tuple(
            grasped(
                _class_name(low, high),
                [
                    stage
                    for stalk, stage in reachable
                    if low <= stalk.neighbour and (stalk.neighbour < high or math.isinf(high))
                ],
            )
            for low, high in zip(NEIGHBOUR_BIN_EDGES, NEIGHBOUR_BIN_EDGES[1:])
        ),
        thesis_ratio=ratio,
        runs=runs,
        aim_errors=np.array([attempt.aim_error for attempt in attempts if attempt.stalk is not None], float),
    )


def thesis_ratio(attempts: Iterable[Attempt]) -> tuple[float, int]:
    """Return the thesis's metric 1 - |grasped - attempted| / attempted, averaged over runs, and the number of runs.

    Only runs in which the arm was sent count; the metric is NaN if there are none.
    """
    sent: Counter[int] = Counter()
    held: Counter[int] = Counter()
    for attempt in attempts:
        if attempt.sent:
            sent[attempt.run] += 1
            held[attempt.run] += len(attempt.held)
    ratios = [1 - abs(held[run] - count) / count for run, count in sent.items()]
    return (float(np.mean(ratios)) if ratios else math.nan), len(ratios)


def _stage(attempt: Attempt | None, tolerance: float) -> str:
    """Return the stage, one of `STAGES`, that a stalk reached; ``attempt`` is None if the stalk was not detected."""
    if attempt is None:
        return "not detected"
    if attempt.outcome == "success":
        return "grasped"
    if not attempt.reachable:
        return "out of reach"
    if attempt.refused:
        return "refused"
    if attempt.aim_error > tolerance:
        return "aimed beside"
    return "several held" if attempt.outcome == "several" else "not held"


def _class_name(low: float, high: float) -> str:
    if math.isinf(high):
        return f"neighbour from {1000 * low:g} mm"
    return f"neighbour {1000 * low:g} to {1000 * high:g} mm"
