"""Recorder of the original environments, for the comparison by benchmarks/parity.py.

    python benchmarks/record_originals.py ENV FILE.npz [--sequences 24] [--seed 0] [--lower 0]

ENV is FetchReach, HandReach, Reacher (Gymnasium) or FingerTurn (dm_control). Needs an environment of its own, with the MuJoCo
that the originals were published for: later ones treat the weld that pulls FetchReach's gripper differently.

    pip install gymnasium-robotics==1.4.2 dm_control==1.0.27 mujoco==3.2.7

Actions are of three kinds in turn: independent, held for ten steps, and wandering. ``--lower`` is taken off the third component
of each: .25 takes FetchReach's gripper to the table.
"""

import argparse
import sys
from collections.abc import Callable

import mujoco
import numpy as np

STEPS = 50


def sample_actions(rng: np.random.Generator, sequences: int, size: int, lower: float) -> np.ndarray:
    """Actions [N, 50, ``size``] float32 in [-1, 1]."""
    actions = np.empty((sequences, STEPS, size))
    for number, sequence in enumerate(actions):
        if number % 3 == 0:
            sequence[:] = rng.uniform(-1, 1, (STEPS, size))
        elif number % 3 == 1:
            sequence[:] = np.repeat(rng.uniform(-1, 1, (STEPS // 10, size)), 10, axis=0)
        else:
            sequence[0] = rng.uniform(-1, 1, size)
            for time in range(1, STEPS):
                sequence[time] = np.clip(0.8 * sequence[time - 1] + rng.normal(0, 0.4, size), -1, 1)
    if lower:
        actions[:, :, 2] = np.clip(actions[:, :, 2] - lower, -1, 1)
    return actions.astype(np.float32)


def play(env, actions: np.ndarray, read: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Play sequences and read the state at their T + 1 instants: [N, T + 1, ...] float32."""
    sequences = []
    for number, sequence in enumerate(actions):
        env.reset(seed=number)
        instants = [read()]
        for action in sequence:
            env.step(action)
            instants.append(read())
        sequences.append({key: np.stack([instant[key] for instant in instants]) for key in instants[0]})
    return {key: np.stack([sequence[key] for sequence in sequences]).astype(np.float32) for key in sequences[0]}


def gymnasium_task(identifier: str, read: Callable) -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    """A recorder of an environment of Gymnasium; ``read`` takes the environment."""
    import gymnasium  # pyright: ignore[reportMissingImports]
    import gymnasium_robotics  # pyright: ignore[reportMissingImports]

    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make(identifier).unwrapped
    return lambda actions: play(env, actions, lambda: {key: np.array(value) for key, value in read(env).items()})


def fetch_reach() -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    """A recorder of the grip: [N, T + 1, 3] m."""
    return gymnasium_task("FetchReach-v4", lambda env: {"grip_pos_m": env._get_obs()["achieved_goal"]})


def hand_reach() -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    """A recorder of the fingertips, [N, T + 1, 15] m, and the joints, [N, T + 1, 24] rad."""
    return gymnasium_task("HandReach-v3", lambda env: {"tip_pos_m": env._get_obs()["achieved_goal"], "qpos": env.data.qpos})


def reacher() -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    """A recorder of the two joints, [N, T + 1, 2] rad and rad/s, and the fingertip, [N, T + 1, 3] m."""

    def read(env) -> dict[str, np.ndarray]:
        joints = {"qpos_rad": env.data.qpos[:2], "qvel_rad_s": env.data.qvel[:2]}
        return joints | {"fingertip_pos_m": env.get_body_com("fingertip")}

    return gymnasium_task("Reacher-v5", read)


def finger_turn() -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    """From random configurations without contact, with 21 and with 2 physics steps for each action."""
    from dm_control.suite import finger  # pyright: ignore[reportMissingImports]

    model = mujoco.MjModel.from_xml_string(*finger.get_model_and_assets())
    data = mujoco.MjData(model)

    def free_configuration(rng: np.random.Generator) -> np.ndarray:
        while True:
            data.qpos[:] = rng.uniform((-1.5, -1.9, -np.pi), (1.5, 1.9, np.pi))
            mujoco.mj_forward(model, data)
            if data.ncon == 0:
                return data.qpos.copy()

    def record(actions: np.ndarray) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(0)
        starts = [free_configuration(rng) for _ in actions]
        recording = {}
        for substeps in (21, 2):
            path = np.empty((2, len(actions), STEPS + 1, 3), np.float32)
            for number, (start, sequence) in enumerate(zip(starts, actions)):
                mujoco.mj_resetData(model, data)
                data.qpos[:] = start
                path[:, number, 0] = data.qpos, data.qvel
                for time, action in enumerate(sequence):
                    data.ctrl[:] = action
                    mujoco.mj_step(model, data, substeps)
                    path[:, number, time + 1] = data.qpos, data.qvel
            recording |= {f"qpos_rad_nsub{substeps}": path[0], f"qvel_rad_s_nsub{substeps}": path[1]}
        return recording

    return record


RECORDERS = {
    "FetchReach": (fetch_reach, 4),
    "HandReach": (hand_reach, 20),
    "Reacher": (reacher, 2),
    "FingerTurn": (finger_turn, 2),
}


def main() -> int:
    """Write the recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env", choices=RECORDERS)
    parser.add_argument("file")
    parser.add_argument("--sequences", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lower", type=float, default=0.0)
    options = parser.parse_args()
    make_recorder, size = RECORDERS[options.env]
    actions = sample_actions(np.random.default_rng(options.seed), options.sequences, size, options.lower)
    np.savez_compressed(options.file, actions=actions, **make_recorder()(actions))
    return 0


if __name__ == "__main__":
    sys.exit(main())
