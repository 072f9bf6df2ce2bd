"""Record trajectories of the original environments, for comparison by benchmarks/parity.py.

    python benchmarks/record_originals.py ENV FILE.npz [--sequences 24] [--seed 0] [--lower 0] [--control]

ENV is FetchPush, FetchReach, HandReach, Reacher (Gymnasium) or FingerTurn (dm_control). Needs a virtual environment of its own,
with the MuJoCo release of the originals: later ones treat the weld that moves FetchReach's gripper differently.

    pip install gymnasium-robotics==1.4.2 dm_control==1.0.27 mujoco==3.2.7

Sequences cycle through three kinds of actions: independent, held for ten steps, and autocorrelated. ``--lower`` is subtracted
from the third component of each: .25 moves FetchReach's gripper to the table. FetchPush's actions are those of a scripted
pusher that observes the object or, with ``--control``, of one that passes over it.
"""

import argparse
import sys
from collections.abc import Callable

import mujoco
import numpy as np

STEPS = 50
LIFTED = 0.5  # height of the grip at which the fingers pass over the object, m
PUSH_OFFSET = 0.065  # distance of the grip from the middle of the object before it pushes, m
MIN_PUSH = 0.08  # m
MAX_OBLIQUITY = 0.1  # standard deviation of the direction of a push from a face's normal, rad


def sample_actions(rng: np.random.Generator, sequences: int, size: int, lower: float) -> np.ndarray:
    """Sample actions [``sequences``, 50, ``size``] float32 in [-1, 1].

    Sequences alternate between independent uniform actions, uniform actions held for ten steps, and autoregressive actions.

    Args:
        rng: Source of the actions.
        sequences: Number of sequences.
        size: Size of an action.
        lower: Value subtracted from the third component, so that the gripper tends downwards.
    """
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
    """Step through sequences and read the state at their T + 1 time steps: [N, T + 1, ...] float32."""
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
    """Return the recorder of a Gymnasium environment; ``read`` maps the environment to the recorded arrays."""
    import gymnasium  # pyright: ignore[reportMissingImports]
    import gymnasium_robotics  # pyright: ignore[reportMissingImports]

    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make(identifier).unwrapped
    return lambda actions: play(env, actions, lambda: {key: np.array(value) for key, value in read(env).items()})


def fetch_reach() -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    """Return a recorder of the grip: [N, T + 1, 3] m."""
    return gymnasium_task("FetchReach-v4", lambda env: {"grip_pos_m": env._get_obs()["achieved_goal"]})


def hand_reach() -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    """Return a recorder of the fingertips, [N, T + 1, 15] m, and the joints, [N, T + 1, 24] rad."""
    return gymnasium_task("HandReach-v3", lambda env: {"tip_pos_m": env._get_obs()["achieved_goal"], "qpos": env.data.qpos})


def reacher() -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    """Return a recorder of the two joints, [N, T + 1, 2] rad and rad/s, and the fingertip, [N, T + 1, 3] m."""

    def read(env) -> dict[str, np.ndarray]:
        joints = {"qpos_rad": env.data.qpos[:2], "qvel_rad_s": env.data.qvel[:2]}
        return joints | {"fingertip_pos_m": env.get_body_com("fingertip")}

    return gymnasium_task("Reacher-v5", read)


def finger_turn() -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    """Return a recorder from random configurations without contact, with 21 and with 2 physics steps per action."""
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


class Pusher:
    """Scripted pusher: above the object, down behind it, and along the table to a target position."""

    def __init__(self, rng: np.random.Generator, middle: np.ndarray, object_position: np.ndarray, control: bool) -> None:
        """Sample a target for ``object_position`` [2] (m), within 15 cm of ``middle`` [2] on each axis.

        If ``control`` is true, the pusher passes over the object.
        """
        self.rng, self.control, self.is_down = rng, control, False
        self.height, self.speed = rng.uniform((0.418, 0.3), (0.44, 1.0))
        self.place = object_position
        while not np.linalg.norm(self.place - object_position) > MIN_PUSH or np.abs(self.place - middle).max() > 0.15:
            # Against one of the four faces, because a push against a corner can turn the box either way.
            angle = 0.5 * np.pi * rng.integers(4) + rng.normal(0.0, MAX_OBLIQUITY)
            self.place = object_position + rng.uniform(MIN_PUSH, 0.3) * np.array([np.cos(angle), np.sin(angle)])

    def act(self, grip: np.ndarray, object_position: np.ndarray) -> np.ndarray:
        """Return the action [4] for the positions of the grip [3] and the object [3], m."""
        way = self.place - object_position[:2]
        left = np.linalg.norm(way)
        way = way / max(left, 1e-6)
        behind = object_position[:2] - PUSH_OFFSET * way
        aside = np.linalg.norm(behind - grip[:2])
        self.is_down |= not self.control and grip[2] < self.height + 0.01 and aside < 0.03
        action = np.zeros(4)
        if self.is_down:
            across = (object_position[:2] - grip[:2]) - ((object_position[:2] - grip[:2]) @ way) * way
            action[:2] = 10.0 * across + (min(self.speed, 8.0 * left) if left > 0.01 else 0.0) * way
            action[2] = 20.0 * (self.height - grip[2])
        else:
            is_high = grip[2] > LIFTED - 0.02
            goes_down = not self.control and aside < 0.02
            action[:2] = 20.0 * (behind - grip[:2]) if is_high or aside < 0.03 else 0.0
            action[2] = 20.0 * ((self.height if goes_down else LIFTED) - grip[2])
        # In steps of 1/128, so that a recording is small.
        return (np.round(128.0 * np.clip(action + self.rng.normal(0, 0.1, 4), -1, 1)) / 128.0).astype(np.float32)


def record_pushes(rng: np.random.Generator, sequences: int, control: bool) -> dict[str, np.ndarray]:
    """Record N pushes of FetchPush's object.

    Args:
        rng: Source of starts and pushes.
        sequences: N.
        control: Whether the pusher passes over the object without touching it, as a control experiment.

    Returns:
        ``actions`` [N, T, 4]; ``observations`` [N, T + 1, 25] float32, rounded to 5 decimals; and ``touches`` [N, T + 1] bool,
        True if a finger touches the object.
    """
    import gymnasium  # pyright: ignore[reportMissingImports]
    import gymnasium_robotics  # pyright: ignore[reportMissingImports]

    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make("FetchPush-v4").unwrapped
    model, data = env.model, env.data
    fingers = {model.geom(f"robot0:{side}_gripper_finger_link").id for side in "lr"}
    object_position = model.geom("object0").id

    def read() -> dict[str, np.ndarray]:
        touches = any(object_position in contact.geom and fingers & set(contact.geom) for contact in data.contact[: data.ncon])
        return {"observations": env._get_obs()["observation"], "touches": np.array(touches)}

    episodes = []
    for number in range(sequences):
        env.reset(seed=number)
        instants, actions = [read()], []
        grip, start = np.split(instants[0]["observations"][:6], 2)
        pusher = Pusher(rng, grip[:2], start[:2], control)
        for _ in range(STEPS):
            actions.append(pusher.act(*np.split(instants[-1]["observations"][:6], 2)))
            env.step(actions[-1])
            instants.append(read())
        episode = {key: np.stack([instant[key] for instant in instants]) for key in instants[0]}
        episodes.append({"actions": np.stack(actions), **episode})
    recording = {key: np.stack([episode[key] for episode in episodes]) for key in episodes[0]}
    return recording | {"observations": recording["observations"].round(5).astype(np.float32)}


RECORDERS = {
    "FetchReach": (fetch_reach, 4),
    "HandReach": (hand_reach, 20),
    "Reacher": (reacher, 2),
    "FingerTurn": (finger_turn, 2),
}


def main() -> int:
    """Record the sequences, write them to the file, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env", choices=[*RECORDERS, "FetchPush"])
    parser.add_argument("file")
    parser.add_argument("--sequences", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lower", type=float, default=0.0)
    parser.add_argument("--control", action="store_true")
    options = parser.parse_args()
    if options.env == "FetchPush":
        rng = np.random.default_rng(options.seed)
        np.savez_compressed(options.file, **record_pushes(rng, options.sequences, options.control))
        return 0
    make_recorder, size = RECORDERS[options.env]
    actions = sample_actions(np.random.default_rng(options.seed), options.sequences, size, options.lower)
    np.savez_compressed(options.file, actions=actions, **make_recorder()(actions))
    return 0


if __name__ == "__main__":
    sys.exit(main())
