"""Tests of the score of grasps: one target, one stalk."""

import math

import numpy as np
import pytest
from scipy.stats import binomtest

from jaxrl_vis.stalks.grasping.evaluation import grasp_score
from jaxrl_vis.stalks.grasping.evaluation.grasp_score import (
    Attempt,
    TrueStalk,
    match_grasps,
    score,
    thesis_ratio,
    wilson_interval,
)


def held(*stalks: int) -> frozenset[int]:
    return frozenset(stalks)


def stand(stalk: int, run: int = 0, reachable: bool = True, room: float = 0.02, neighbour: float = 0.06) -> TrueStalk:
    return TrueStalk(run, stalk, reachable, room, neighbour)


def test_wilson_is_that_of_scipy():
    for count, of in ((0, 1), (1, 1), (0, 20), (7, 20), (20, 20), (481, 500)):
        theirs = binomtest(count, of).proportion_ci(method="wilson")
        np.testing.assert_allclose(wilson_interval(count, of), (theirs.low, theirs.high), atol=1e-6)
    assert all(math.isnan(each) for each in wilson_interval(0, 0))
    with pytest.raises(ValueError, match="3 of 2"):
        wilson_interval(3, 2)


@pytest.mark.parametrize(
    ("attempt", "outcome"),
    [
        (Attempt(0, 3, held(3)), "success"),
        (Attempt(0, 3, held()), "miss"),
        (Attempt(0, 3, held(4)), "wrong stalk"),
        (Attempt(0, None, held(4)), "wrong stalk"),
        (Attempt(0, 3, held(3, 4)), "several"),
        (Attempt(0, 3, held(4, 5)), "several"),
        (Attempt(0, 3, held(), reachable=False), "unreachable"),
        (Attempt(0, 3, held(), refused=True), "refused"),
    ],
)
def test_only_the_target_alone_is_a_success(attempt: Attempt, outcome: str):
    assert attempt.outcome == outcome


def test_errors_that_cancel_in_the_count_are_counted_here():
    # One stalk missed, two held instead of one: the thesis's ratio is perfect.
    attempts = [Attempt(0, 0, held(0)), Attempt(0, 1, held()), Attempt(0, 2, held(2, 3))]
    found = score(attempts, [stand(index) for index in range(4)])
    assert thesis_ratio(attempts) == (1.0, 1) and found.thesis_ratio == 1.0
    assert (found.of_sent.count, found.of_sent.total) == (1, 3)
    assert (found.of_reachable.count, found.of_reachable.total) == (1, 4)
    outcomes = {each.name: each.count for each in found.outcomes}
    assert outcomes["attempts: miss"] == 1 and outcomes["attempts: several"] == 1
    stages = {each.name.removeprefix("reachable stalks: "): each.count for each in found.stages}
    assert stages == {
        "grasped": 1, "not detected": 1, "aimed beside": 0, "out of reach": 0, "refused": 0, "not held": 1,
        "several held": 1,
    }  # fmt: skip


def test_the_ratio_of_the_thesis_is_a_mean_over_runs():
    attempts = [
        Attempt(0, 0, held(0)),
        Attempt(0, 1, held()),
        Attempt(1, 0, held(0, 1)),
        Attempt(2, 0, held(), reachable=False),
    ]
    ratio, runs = thesis_ratio(attempts)
    assert runs == 2 and ratio == pytest.approx((0.5 + 0.0) / 2)
    assert math.isnan(thesis_ratio([])[0])


def test_crowded_stalks_have_their_own_row_and_are_in_the_total():
    stalks = [stand(0), stand(1, room=0.004), stand(2, room=-0.01), stand(3, room=math.inf), stand(4, reachable=False)]
    found = score([Attempt(0, 0, held(0)), Attempt(0, 2, held(2, 1))], stalks)
    assert (found.with_room.count, found.with_room.total) == (1, 2)
    assert (found.crowded.count, found.crowded.total) == (0, 2)
    assert (found.of_reachable.count, found.of_reachable.total) == (1, 4)
    assert (found.of_all.count, found.of_all.total) == (1, 5)


def test_the_failing_stage_is_the_first():
    attempts = [
        Attempt(0, 0, held(), aim_error=0.03),
        Attempt(0, 1, held(), reachable=False, aim_error=0.03),
        Attempt(0, 2, held(), aim_error=0.002),
        Attempt(0, 3, held(3), aim_error=0.03),
        Attempt(0, 5, held(), refused=True, aim_error=0.03),
    ]
    found = score(attempts, [stand(index) for index in range(6)])
    stages = {each.name.removeprefix("reachable stalks: "): each.count for each in found.stages}
    assert stages == {
        "grasped": 1, "not detected": 1, "aimed beside": 1, "out of reach": 1, "refused": 1, "not held": 1,
        "several held": 0,
    }  # fmt: skip
    assert sum(stages.values()) == 6
    np.testing.assert_allclose(found.aim_errors, [0.03, 0.03, 0.002, 0.03, 0.03])


def test_what_is_refused_fails_in_every_total_and_is_not_a_reach():
    attempts = [
        Attempt(0, 0, held(0)),
        Attempt(0, 1, held(), refused=True),
        Attempt(0, 2, held(2), collided=True, brushed=True),
    ]
    found = score(attempts, [stand(index) for index in range(3)])
    assert (found.of_reachable.count, found.of_reachable.total) == (2, 3) and (found.of_all.count, found.of_all.total) == (2, 3)
    assert (found.of_sent.count, found.of_sent.total) == (2, 2) and (found.touches.count, found.touches.total) == (1, 2)
    assert {each.name: each.count for each in found.outcomes}["attempts: refused"] == 1
    assert thesis_ratio(attempts) == (1.0, 1)


def test_collisions_and_false_targets_are_distinguished_from_success():
    attempts = [Attempt(0, 0, held(0), collided=True), Attempt(0, None, held()), Attempt(0, 1, held(1), brushed=True)]
    found = score(attempts, [stand(0), stand(1)])
    assert (found.collisions.count, found.collisions.total) == (1, 3)
    assert (found.brushes.count, found.false_targets.count) == (1, 1)
    assert found.of_sent.count == 2


def test_every_reachable_stalk_is_in_one_class_of_distances():
    distances = [0.0, 0.0299, 0.03, 0.064, 0.065, 0.5, math.inf]
    found = score([], [stand(index, neighbour=each) for index, each in enumerate(distances)])
    assert [each.total for each in found.by_neighbour] == [2, 1, 0, 1, 1, 2]
    assert found.of_reachable.total == 7


def test_matching_takes_one_each_and_the_least_distance():
    stalks = np.array([[0.0, 0.0], [0.05, 0.0], [1.0, 0.0]])
    np.testing.assert_array_equal(match_grasps([[0.02, 0.0], [0.03, 0.0], [0.5, 0.0]], stalks, 0.06), [0, 1, -1])
    # Two points beside one stalk: the nearer one has it.
    np.testing.assert_array_equal(match_grasps([[0.99, 0.01], [1.0, 0.001]], stalks, 0.03), [-1, 2])
    # As many pairs as there can be: the point between takes the far stalk so that the other has one, too.
    np.testing.assert_array_equal(match_grasps([[0.02, 0.0], [-0.02, 0.0]], stalks[:2], 0.04), [1, 0])
    assert (
        match_grasps(np.zeros((0, 2)), stalks, 0.1).shape == (0,)
        and (match_grasps([[0.0, 0.0]], np.zeros((0, 2)), 0.1) == -1).all()
    )


def test_matching_takes_the_height_of_each_grasp():
    # One leaning stalk, grasped at two heights.
    stalks = np.array([[[0.0, 0.0], [0.1, 0.0]], [[0.1, 0.0], [0.2, 0.0]]])
    np.testing.assert_array_equal(match_grasps([[0.0, 0.0], [0.2, 0.0]], stalks, 0.02), [0, 1])


def test_what_does_not_belong_together_is_refused():
    with pytest.raises(ValueError, match="more than once: stalk 1 of run 0"):
        score([Attempt(0, 1, held()), Attempt(0, 1, held())], [stand(1)])
    with pytest.raises(ValueError, match="listed more than once"):
        score([], [stand(1), stand(1)])
    with pytest.raises(ValueError, match="stalk 7 of run 0, which is not"):
        score([Attempt(0, 7, held())], [stand(1)])


def test_an_empty_row_says_none():
    found = score([], [])
    assert str(found.of_sent) == "attempts: exactly the target held: none" and found.runs == 0
    assert "50.0% (1 of 2; " in str(grasp_score.Proportion("x", 1, 2))
    assert len({each.name for each in found.proportions}) == len(found.proportions)
