"""Drive our tasks with recorded actions of the originals, and report the deviations.

    python benchmarks/parity.py ENV FILE.npz        e.g. FetchReach tests/data/fetch_reach.npz

A recording holds N sequences of T actions in [-1, 1], and the states at their T + 1 time steps:

    FetchPush    actions [N, T, 4], observations [N, T + 1, 25]; Gymnasium-Robotics
    FetchReach   actions [N, T, 4], grip_pos_m [N, T + 1, 3]; Gymnasium-Robotics
    FingerTurn   actions [N, T, 2], qpos_rad_nsubK and qvel_rad_s_nsubK [N, T + 1, 3] for K = 21, 2 or both; dm_control
    HandReach    actions [N, T, 20], qpos [N, T + 1, 24] (rad), tip_pos_m [N, T + 1, 15]; Gymnasium-Robotics
    Reacher      actions [N, T, 2], qpos_rad and qvel_rad_s [N, T + 1, 2], fingertip_pos_m [N, T + 1, 3]; Gymnasium (torque)

Prints one line for each error, with its bound if there is one. Exit status: 0 all errors are within their bounds; 1 a bound is
violated; 2 there is nothing to compare (no such task or file, or a key is missing).
"""

import argparse
import functools
import sys
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxrl_vis_envs
from benchmarks.tasks import environments
from jaxrl_vis_envs import registry
from jaxrl_vis_envs.base import State

Recording = Mapping[str, np.ndarray]


class Measure(NamedTuple):
    """Measure of the agreement with a recording; ``bound`` is its maximum permitted value, None if it is only informative."""

    name: str
    value: float
    unit: str
    bound: float | None = None

    @property
    def is_broken(self) -> bool:
        return self.bound is not None and not self.value <= self.bound

    def __str__(self) -> str:
        bound = "" if self.bound is None else f"   bound {self.bound:g}   {'BROKEN' if self.is_broken else 'kept'}"
        return f"{self.name:<60} {self.value:10.5f} {self.unit:<5}{bound}"


class NothingToCompareError(ValueError):
    """Error of a recording that lacks an array or has wrong shapes, or of a task without known recordings."""


def play(env: Any, state: State, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Step N episodes with T actions each.

    Returns:
        qpos [N, T, nq] and the achieved states [N, T, G] after each action.
    """
    qpos, achieved = [], []
    for time in range(actions.shape[1]):
        state = environments.advance(env, state, actions[:, time])
        qpos.append(state.data.qpos)
        achieved.append(state.achieved_state)
    return np.stack(qpos, axis=1), np.stack(achieved, axis=1)


def distance_measures(name: str, error: np.ndarray, median: float | None, high: float | None, percentile: int) -> list[Measure]:
    """Return the median and a percentile of ``error`` [...], with their bounds ``median`` and ``high``, None for none; m."""
    return [
        Measure(f"{name}: median error", float(np.median(error)), "m", median),
        Measure(f"{name}: {percentile}th percentile of the error", float(np.percentile(error, percentile)), "m", high),
    ]


def fetch_reach(recording: Recording) -> list[Measure]:
    """Compare grip positions, until the recorded one leaves the neighbourhood of its start."""
    env = environments.make("FetchReach")
    actions, recorded = _take(recording, "actions", "grip_pos_m")
    start, _ = environments.reset(env, jax.random.split(jax.random.key(0), len(actions)))
    _, grip = play(env, start, actions)
    # Only until the grip leaves the box around its start (goals lie within .15 m): farther out the arm stretches or swings
    # through the table's edge or its own base, which is irrelevant to the task.
    is_outside = (np.abs(recorded - recorded[:, :1]) > 0.25).any(axis=-1)
    is_inside = np.cumsum(is_outside, axis=1) == 0
    error = np.linalg.norm(grip - recorded[:, 1:], axis=-1)[is_inside[:, 1:]]
    return [
        Measure("share of the recording that counts (near the start)", float(is_inside.mean()), ""),
        *distance_measures("grip", error, 0.005, 0.015, 99),
    ]


def fetch_push(recording: Recording) -> list[Measure]:
    """Compare the grip until the box first moves, the time of that move, and the box's final position; check that it moves."""
    env = environments.make("FetchPush")
    actions, recorded = _take(recording, "actions", "observations")
    ours = play_push(env, actions, recorded[:, 0, 3:5])
    our_start, start = (_first_move(path) for path in (ours, recorded))
    is_before = np.arange(recorded.shape[1]) < np.minimum(our_start, start)[:, None]
    grip_error, box_error = (np.linalg.norm((ours - recorded)[..., part], axis=-1) for part in (slice(3), slice(3, 6)))
    moved = np.linalg.norm(recorded[:, -1, 3:6] - recorded[:, 0, 3:6], axis=-1)
    return [
        Measure("share of sequences in which the box moves less than 5 cm", float((moved < 0.05).mean()), "", 0.2),
        Measure("grip until the box moves: median error", float(np.median(grip_error[is_before])), "m"),
        Measure("grip until the box moves: greatest error", float(grip_error[is_before].max()), "m", 0.002),
        Measure("first move of the box: greatest error", float(np.abs(our_start - start).max()), "steps", 1.0),
        *distance_measures("box at the end", box_error[:, -1], 0.01, None, 95),
    ]


def play_push(env: Any, actions: np.ndarray, box_positions: np.ndarray) -> np.ndarray:
    """Return observations [N, T + 1, 25] of FetchPush for actions [N, T, 4] and initial ``box_positions`` [N, 2] (m)."""
    begin, see = push_programs(env)
    state = jax.device_get(begin(box_positions))
    observations = [see(state.data)]
    for time in range(actions.shape[1]):
        state = environments.advance(env, state, actions[:, time])
        observations.append(see(state.data))
    return np.stack(observations, axis=1)


@functools.cache
def push_programs(env: Any) -> tuple[Callable, Callable]:
    """Return two jitted functions: position of the box [N, 2] (m) -> State, and physics data -> observations [N, 25]."""
    begin = jax.vmap(lambda place: env.state_at(env.start_with_box(place), jnp.zeros(3)))
    return jaxrl_vis_envs.jit(begin), jaxrl_vis_envs.jit(jax.vmap(env.observe_state))


def _first_move(observations: np.ndarray) -> np.ndarray:
    """Return the first time step [N] at which the box is 1 mm from its start, or T + 1, from observations [N, T + 1, 25]."""
    has_moved = np.linalg.norm(observations[..., 3:6] - observations[:, :1, 3:6], axis=-1) > 0.001
    return np.where(has_moved.any(axis=1), has_moved.argmax(axis=1), observations.shape[1])


def finger_turn(recording: Recording) -> list[Measure]:
    """Compare final joint angles with K physics steps per control step, for each recorded K; only the task's 21 is bounded."""
    measures = []
    for substeps in (21, 2):
        keys = (f"qpos_rad_nsub{substeps}", f"qvel_rad_s_nsub{substeps}")
        if substeps == 2 and not any(key in recording for key in keys):
            continue
        env = environments.make("FingerTurn", substeps=substeps)
        actions, qpos, qvel = _take(recording, "actions", *keys)
        ours, _ = play(env, environments.start_at(env, qpos[:, 0], qvel[:, 0]), actions)
        error = np.abs(ours[:, -1] - qpos[:, -1]).max(axis=-1)
        name = f"{substeps} substeps, joint and spinner angles at the end: "
        measures += [
            Measure(name + "greatest error", float(error.max()), "rad", 0.01 if substeps == 21 else None),
            Measure(name + "median error", float(np.median(error)), "rad"),
            Measure(f"{substeps} substeps, sequences that move the spinner > 0.3 rad", _share_moving(qpos), ""),
        ]
    return measures


def _share_moving(qpos: np.ndarray) -> float:
    """Return the fraction of sequences in which the spinner moves by contact; below 0.5 the recording is hardly informative."""
    return float((np.ptp(qpos[:, :, 2], axis=1) > 0.3).mean())


def hand_reach(recording: Recording) -> list[Measure]:
    """Compare fingertips with contacts and, to show that the bounds are sensitive to these, without."""
    actions, qpos, tips = _take(recording, "actions", "qpos", "tip_pos_m")
    measures = []
    for contacts in (True, False):
        env = environments.make("HandReach", contacts=contacts)
        _, ours = play(env, environments.start_at(env, qpos[:, 0], np.zeros_like(qpos[:, 0])), actions)
        error = np.linalg.norm((ours - tips[:, 1:]).reshape(*ours.shape[:2], 5, 3), axis=-1)
        for number, finger in enumerate(("first finger", "middle finger", "ring finger", "little finger", "thumb")):
            name = finger if contacts else f"without contacts, {finger}"
            bounds = (0.002, 0.008) if contacts else (None, None)
            measures += distance_measures(name, error[..., number], *bounds, 95)
    return measures


def reacher(recording: Recording) -> list[Measure]:
    """Compare joint angles and the fingertip under torque control."""
    env = environments.make("Reacher", control="torque")
    actions, qpos, qvel, fingertip = _take(recording, "actions", "qpos_rad", "qvel_rad_s", "fingertip_pos_m")
    our_qpos, our_fingertip = play(env, environments.start_at(env, qpos[:, 0], qvel[:, 0]), actions)
    error = np.abs(our_qpos - qpos[:, 1:])
    tip_error = np.linalg.norm(our_fingertip - fingertip[:, 1:, :2], axis=-1)
    return [
        Measure("joint angles: median error", float(np.median(error)), "rad", 0.01),
        Measure("joint angles: 99th percentile of the error", float(np.percentile(error, 99)), "rad"),
        *distance_measures("fingertip", tip_error, 0.001, None, 99),
    ]


COMPARISONS: dict[str, Callable[[Recording], list[Measure]]] = {
    "FetchPush": fetch_push,
    "FetchReach": fetch_reach,
    "FingerTurn": finger_turn,
    "HandReach": hand_reach,
    "Reacher": reacher,
}


def compare(name: str, recording: Recording) -> list[Measure]:
    """Compare an environment with a recording; image variants are compared through their state variants.

    Raises:
        NothingToCompareError: The task has no known recordings, or this one lacks a key or has a wrong shape.
    """
    task = registry.state_variant(name) if name in registry.list_envs() else None
    if task not in COMPARISONS:
        raise NothingToCompareError(f"no recordings of {name!r} are known; choose one of {', '.join(COMPARISONS)}")
    return COMPARISONS[task](recording)


def _take(recording: Recording, *keys: str) -> list[np.ndarray]:
    """Return the arrays under ``keys``: actions [N, T, ...] first, then states [N, T + 1, ...].

    Raises:
        NothingToCompareError: An array is missing or has another shape.
    """
    missing = [key for key in keys if key not in recording]
    if missing:
        raise NothingToCompareError(f"the recording lacks {', '.join(missing)}; it holds {', '.join(recording)}")
    arrays = [np.asarray(recording[key]) for key in keys]
    count, length = arrays[0].shape[:2]
    for key, array in zip(keys[1:], arrays[1:]):
        if array.shape[:2] != (count, length + 1):
            raise NothingToCompareError(f"{key} must begin with the shape {(count, length + 1)}, and has {array.shape}")
    return arrays


def main(arguments: list[str] | None = None) -> int:
    """Print the deviations; return 0 if all are within bounds, 1 if not, 2 for an invalid request."""
    parser = argparse.ArgumentParser(description="Compares a task with a recording of its original.")
    parser.add_argument("env", help=f"one of {', '.join(COMPARISONS)}")
    parser.add_argument("file", help="the recording, .npz")
    options = parser.parse_args(arguments)
    try:
        with np.load(options.file) as recording:
            measures = compare(options.env, recording)
    except (OSError, NothingToCompareError) as error:
        print(f"parity: {error}", file=sys.stderr)
        return 2
    for measure in measures:
        print(measure)
    return 1 if any(measure.is_broken for measure in measures) else 0


if __name__ == "__main__":
    sys.exit(main())
