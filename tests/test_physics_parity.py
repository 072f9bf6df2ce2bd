"""Recordings of the original environments (tests/data), played through ours by benchmarks/parity.py."""

import functools
import pathlib

import jax
import numpy as np
import one_step
import pytest

from benchmarks import parity, worlds

DATA = pathlib.Path(__file__).parent / "data"
RECORDINGS = {
    "fetch_reach": "FetchReach",
    "fetch_reach_table": "FetchReach",  # benchmarks/record_originals.py FetchReach --seed 3 --lower .25
    "finger": "FingerTurn",
    "hand_reach": "HandReach",
    "reacher": "Reacher",
}


def test_every_comparison_has_a_recording():
    assert sorted(parity.COMPARISONS) == sorted(set(RECORDINGS.values()))


@functools.cache
def compared(name: str) -> list[parity.Figure]:
    with np.load(DATA / f"{name}.npz") as recording:
        # What two substeps do has no bound, but another program to compile.
        return parity.compare(RECORDINGS[name], {key: recording[key] for key in recording if not key.endswith("nsub2")})


@pytest.mark.parametrize("name", RECORDINGS)
def test_tasks_follow_the_recordings_of_their_originals(name):
    figures = compared(name)
    for figure in figures:
        print(figure)
    assert any(figure.bound is not None for figure in figures)
    assert not [figure for figure in figures if figure.is_broken]


@pytest.mark.parametrize("name", ["fetch_reach", "fetch_reach_table"])
def test_most_of_the_fetch_recordings_count(name):
    figures = {figure.name: figure.value for figure in compared(name)}
    assert figures["share of the recording that counts (near the start)"] > 0.5


def test_contacts_matter_to_the_hand():
    figures = {figure.name: figure.value for figure in compared("hand_reach")}
    for finger in ("ring finger", "little finger"):
        name = f"{finger}: 95th percentile of the error"
        assert figures[f"without contacts, {name}"] > max(3 * figures[name], 0.008)


def test_mjx_steps_the_fetch_robot_as_mujoco_does():
    """Half of the targets are in the air, half press the fingers on the table."""
    env = worlds.make("FetchReach")
    start = env.sample_start(jax.random.key(0))
    rng = np.random.default_rng(0)
    targets = np.asarray(start.xpos[env._gripper]) + rng.uniform(-0.15, 0.15, (24, 10, 3))
    targets[12:, :, 2] -= 0.15
    starts = np.tile(np.asarray(start.qpos, np.float64), (24, 1))
    states = one_step.visited_states(env.mj_model, starts, np.zeros((24, 10, 0)), every=13, mocap=targets)
    excess, contacts = one_step.velocity_difference(env.mj_model, states)
    assert (contacts == 0).sum() > 100
    assert (contacts == 2).sum() > 30
    assert excess.max() <= 1.0, f"{np.sort(excess)[-10:]}"


def test_mjx_steps_the_reacher_as_mujoco_does():
    """Half of the starts are near the limit of the elbow, the only constraint, on either side of it."""
    env = worlds.make("Reacher")
    rng = np.random.default_rng(0)
    near_limit = rng.choice([-1.0, 1.0], 32) * rng.uniform(2.9, 3.1, 32)
    starts = np.stack([rng.uniform(-6, 6, 64), np.concatenate([rng.uniform(-3, 3, 32), near_limit])], axis=1)
    states = one_step.visited_states(env.mj_model, starts, rng.uniform(-1, 1, (64, 4, 2)), every=3)
    assert (np.abs(states.qpos[:, 1]) > 3.0).sum() > 30
    excess, _ = one_step.velocity_difference(env.mj_model, states)
    assert excess.max() <= 1.0, f"{np.sort(excess)[-10:]}"


def test_a_drifting_reacher_is_found_out(tmp_path, capsys):
    recording = dict(np.load(DATA / "reacher.npz"))
    recording["qpos_rad"] = recording["qpos_rad"] + 0.011 * (np.arange(51) > 0)[:, None]
    np.savez(tmp_path / "drifting.npz", **recording)
    assert parity.main(["VisualReacher", str(tmp_path / "drifting.npz")]) == 1
    assert capsys.readouterr().out.count("BROKEN") == 1


def test_a_recording_that_is_not_a_number_breaks_its_bounds():
    assert parity.Figure("error", float("nan"), "m", 1.0).is_broken


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
