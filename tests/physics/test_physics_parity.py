"""Recordings of the original environments (tests/data), played through ours by benchmarks/parity.py."""

import functools
import pathlib

import jax
import numpy as np
import pytest

from benchmarks import parity
from benchmarks.tasks import environments, one_step

DATA = pathlib.Path(__file__).parents[1] / "data"
RECORDINGS = {
    "fetch_push": "FetchPush",
    "fetch_reach": "FetchReach",
    "fetch_reach_table": "FetchReach",  # benchmarks/record_originals.py FetchReach --seed 3 --lower .25
    "finger": "FingerTurn",
    "hand_reach": "HandReach",
    "reacher": "Reacher",
}
PUSHES = 16


def test_every_comparison_has_a_recording():
    assert sorted(parity.COMPARISONS) == sorted(set(RECORDINGS.values()))


@functools.cache
def compared(name: str) -> list[parity.Measure]:
    with np.load(DATA / f"{name}.npz") as recording:
        # What two substeps do has no bound, but another program to compile; a few of the many pushes are enough.
        parts = {key: recording[key][:PUSHES] if name == "fetch_push" else recording[key] for key in recording}
    return parity.compare(RECORDINGS[name], {key: part for key, part in parts.items() if not key.endswith("nsub2")})


@pytest.mark.parametrize("name", RECORDINGS)
def test_tasks_follow_the_recordings_of_their_originals(name):
    measures = compared(name)
    for measure in measures:
        print(measure)
    assert any(measure.bound is not None for measure in measures)
    assert not [measure for measure in measures if measure.is_broken]


@pytest.mark.parametrize("name", ["fetch_reach", "fetch_reach_table"])
def test_most_of_the_fetch_recordings_count(name):
    measures = {measure.name: measure.value for measure in compared(name)}
    assert measures["share of the recording that counts (near the start)"] > 0.5


def test_fetch_pushes_that_move_nothing_are_found_out():
    with np.load(DATA / "fetch_push.npz") as recording:
        still = {key: recording[key][:PUSHES] for key in ("actions", "observations")}
    still["observations"][:, :, 3:6] = still["observations"][:, :1, 3:6]
    still["actions"][:, :, 2] = 1.0  # the gripper rises and touches nothing
    measures = parity.compare("FetchPush", still)
    broken = [measure.name for measure in measures if measure.is_broken]
    assert "share of sequences in which the box moves less than 5 cm" in broken
    assert "box at the end: median error" not in broken


def test_a_step_of_the_push():
    """Nine tenths of the states match C MuJoCo less the weld's term; in the others, boxes touch with edges."""
    env = environments.make("FetchPush")
    states = one_step.push_states(env)
    theirs = one_step.mujoco_step(env.mj_model, states, weld_term=False)
    assert (theirs.contacts >= 8).sum() > 30
    multiples = one_step.relative_to_bound(one_step.our_step(env, states, "task"), theirs.qvel)
    assert np.median(multiples) < 0.1 and (multiples <= 1.0).mean() > 0.85


def test_a_box_that_fetch_pushes_off_the_table_lies_on_the_floor():
    env = environments.make("FetchPush")
    begin, _ = parity.push_programs(env)
    # On the table, half over its edge, mostly over it, beside it.
    state = jax.device_get(begin(np.array([[1.25, 0.6], [1.54, 0.75], [1.57, 0.75], [1.7, 0.75]], np.float32)))
    heights = []
    for _ in range(18):
        state = environments.advance(env, state, np.zeros((4, 4)))
        heights.append(state.achieved_state[:, 2])
    np.testing.assert_allclose(heights[-1][[0, 1, 3]], [0.4248, 0.4248, 0.0248], atol=2e-3)
    assert heights[-1][2] < 0.2  # it turns over the edge, and may still tumble
    np.testing.assert_array_equal(state.metrics["moved"], [0, 0, 1, 1])


def test_contacts_matter_to_the_hand():
    measures = {measure.name: measure.value for measure in compared("hand_reach")}
    for finger in ("ring finger", "little finger"):
        name = f"{finger}: 95th percentile of the error"
        assert measures[f"without contacts, {name}"] > max(3 * measures[name], 0.008)


def test_a_step_of_the_fetch_robot():
    """Steps are compared with C MuJoCo less a term of welds that MJX lacks, and with C MuJoCo as it is."""
    env = environments.make("FetchReach")
    states = one_step.fetch_states(env)
    less = one_step.mujoco_step(env.mj_model, states, weld_term=False)
    assert (less.contacts == 0).sum() > 100
    assert (less.contacts == 2).sum() > 30
    converged = one_step.our_step(env, states, "more")
    multiples = one_step.relative_to_bound(converged, less.qvel)
    assert multiples.max() <= 1.0, f"{np.sort(multiples)[-10:]}"
    # With the task's own four iterations, all but a few of the states in contact.
    assert (one_step.relative_to_bound(one_step.our_step(env, states, "task"), less.qvel) <= 1.0).mean() > 0.97
    # The term itself, as docs/tasks.md has it: some 1 % of the greatest velocity, and at most 5 %.
    as_it_is = one_step.relative_to_bound(converged, one_step.mujoco_step(env.mj_model, states, weld_term=True).qvel)
    assert 10 < np.median(as_it_is) < 130 and as_it_is.max() < 520


def test_a_step_of_the_reacher_is_that_of_mujoco():
    env = environments.make("Reacher")
    states = one_step.reacher_states(env)
    assert (np.abs(states.qpos[:, 1]) > 3.0).sum() > 30
    theirs = one_step.mujoco_step(env.mj_model, states, weld_term=True)
    multiples = one_step.relative_to_bound(one_step.our_step(env, states, "task"), theirs.qvel)
    assert multiples.max() <= 1.0, f"{np.sort(multiples)[-10:]}"


def test_a_drifting_reacher_is_found_out(tmp_path, capsys):
    recording = dict(np.load(DATA / "reacher.npz"))
    recording["qpos_rad"] = recording["qpos_rad"] + 0.011 * (np.arange(51) > 0)[:, None]
    np.savez(tmp_path / "drifting.npz", **recording)
    assert parity.main(["VisualReacher", str(tmp_path / "drifting.npz")]) == 1
    assert capsys.readouterr().out.count("BROKEN") == 1


def test_a_recording_that_is_not_a_number_breaks_its_bounds():
    assert parity.Measure("error", float("nan"), "m", 1.0).is_broken


def test_nothing_to_compare(tmp_path, capsys):
    np.savez(tmp_path / "empty.npz", actions=np.zeros((1, 2, 4)))
    np.savez(tmp_path / "short.npz", actions=np.zeros((1, 2, 4)), grip_pos_m=np.zeros((1, 2, 3)))
    for arguments, complaint in (
        (["FetchReach", str(tmp_path / "empty.npz")], "lacks grip_pos_m"),
        (["FetchReach", str(tmp_path / "short.npz")], "must begin with the shape"),
        (["Swimmer", str(tmp_path / "empty.npz")], "choose one of"),
        (["FetchReach", str(tmp_path / "missing.npz")], "No such file"),
    ):
        assert parity.main(arguments) == 2
        assert complaint in capsys.readouterr().err
