"""FetchReach stepped and rendered on the host by MuJoCo alone, learned with `jaxrl_vis.indicator`: no MJX, no ray caster.

    MUJOCO_GL=egl python -m benchmarks.tasks.host_fetch live [--steps 40000] [--noise 0] [--method ...] [--seed 100] [--json F]
    MUJOCO_GL=egl python -m benchmarks.tasks.host_fetch record [--episodes 1000] [--out recorded.npz]
    MUJOCO_GL=egl python -m benchmarks.tasks.host_fetch recorded [--recordings recorded.npz] [--algorithm ...] [--json F]

The robot is fetch_reach.xml, moved by its mocap body as in the task; images are 64x64 RGB from MuJoCo's OpenGL renderer, and
goal images show the arm after ten actions of a proportional controller. ``record`` uses a noisy policy: half of its actions go
towards the goal with noise, half are uniform. Success means a distance of at most 5 cm at the last step.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from jaxrl_vis import indicator
from jaxrl_vis_envs.physics.mjx_model import load_model
from jaxrl_vis_envs.tasks.pulled_arm import pull

HORIZON, SUBSTEPS, THRESHOLD, RANGE, SIZE = 50, 20, 0.05, 0.15, 64
_DOWN = np.array([1.0, 0.0, 1.0, 0.0])
_SETUP_OFFSET = np.array([-0.498, 0.005, -0.231])
_METHODS = {"exact": {}, "tolerance": {"tolerance": 0.0}, "contrastive": {"algorithm": "contrastive"}}
_CLONING = "benchmarks.tasks.behaviour_cloning:make"

Policy = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Function (image, goal image, true displacement [3] to the goal, m) -> action [4]; learners ignore the displacement."""


class HostFetch:
    """FetchReach with one robot on the host. Close it to free the GL context."""

    def __init__(self, noise: float, seed: int) -> None:
        """Settle the arm at its start; ``noise`` is the standard deviation of the camera noise, grey levels."""
        self._model, self._draw, self._noise = load_model("fetch_reach.xml"), np.random.default_rng(seed), noise
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        target = self._data.site("grip").xpos + _SETUP_OFFSET
        pull(self._model, self._data, target, _DOWN / np.linalg.norm(_DOWN), 200)
        self._start = self._data.qpos.copy(), self._data.qvel.copy()
        self._model.opt.timestep = 0.04 / SUBSTEPS
        self._fingers = [self._model.joint(name).qposadr[0] for name in ("right_finger", "left_finger")]
        self._renderer = mujoco.Renderer(self._model, SIZE, SIZE)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._renderer.scene.flags[flag] = False

    def _begin(self) -> None:
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:], self._data.qvel[:] = self._start
        mujoco.mj_forward(self._model, self._data)

    @property
    def grip(self) -> np.ndarray:
        """Position of the grip [3], m."""
        return self._data.site("grip").xpos.copy()

    def image(self) -> np.ndarray:
        """Render the camera image [64, 64, 3] uint8, with noise."""
        self._renderer.update_scene(self._data, "front")
        image = self._renderer.render().astype(np.float32)
        if self._noise:
            image += self._noise * self._draw.standard_normal(image.shape, np.float32)
        return np.clip(np.round(image), 0, 255).astype(np.uint8)

    def step(self, action: np.ndarray) -> None:
        """Take one control step of 40 ms."""
        hand = self._data.body("gripper")
        self._data.mocap_pos[0] = hand.xpos + 0.05 * np.clip(action[:3], -1.0, 1.0)
        self._data.mocap_quat[0] = hand.xquat + _DOWN
        for _ in range(SUBSTEPS):
            mujoco.mj_step(self._model, self._data)
        self._data.qpos[self._fingers] = 0.0
        mujoco.mj_forward(self._model, self._data)

    def episode(self, policy: Policy) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
        """Roll out an episode: return observations [T+1, ...], actions [T, 4], the goal image, and True on success."""
        self._begin()
        goal = self.grip + self._draw.uniform(-RANGE, RANGE, 3)
        for _ in range(10):
            self.step(np.clip(10.0 * (goal - self.grip), -1.0, 1.0))
        goal_image = self.image()
        self._begin()
        images, actions = [self.image()], []
        for _ in range(HORIZON):
            actions.append(np.append(policy(images[-1], goal_image, goal - self.grip)[:3], 0.0))
            self.step(actions[-1])
            images.append(self.image())
        is_reached = bool(np.linalg.norm(self.grip - goal) <= THRESHOLD)
        return np.stack(images), np.stack(actions).astype(np.float32), goal_image, is_reached

    def close(self) -> None:
        """Free the GL context."""
        self._renderer.close()


def _evaluate(learner: indicator.Learner, noise: float, episodes: int) -> float:
    """Return the success rate over a fixed set of goals."""
    robot = HostFetch(noise, seed=10_000)
    success = np.mean([robot.episode(lambda image, goal, _: learner.act(image, goal))[3] for _ in range(episodes)])
    robot.close()
    return float(success)


def _options(args: argparse.Namespace) -> dict[str, Any]:
    options: dict[str, Any] = {"preset": args.preset, "seed": args.seed, **_METHODS[args.method]}
    if args.method == "tolerance":
        options["tolerance"] = max(2.0, 3.0 * 2.0**0.5 * args.noise)
    return options | ({"algorithm": _CLONING} if args.cloning else {})


def live(args: argparse.Namespace) -> dict[str, Any]:
    """Learn online, with one gradient step per environment step; return the results."""
    learner = indicator.Learner((SIZE, SIZE, 3), 4, HORIZON, capacity=args.steps // HORIZON + 1, **_options(args))
    robot, draw = HostFetch(args.noise, args.seed), np.random.default_rng(args.seed)

    def explore(image: np.ndarray, goal: np.ndarray, _: np.ndarray) -> np.ndarray:
        if learner.episodes < 5 or draw.random() < 0.3:
            return draw.uniform(-1.0, 1.0, 4)
        return np.clip(learner.act(image, goal) + 0.2 * draw.standard_normal(4), -1.0, 1.0)

    rows, began = [], time.monotonic()
    for episode in range(1, args.steps // HORIZON + 1):
        learner.add(*robot.episode(explore)[:3])
        learner.update(HORIZON)
        if episode * HORIZON % args.interval == 0:
            rows.append({"env_steps": episode * HORIZON, "success": _evaluate(learner, args.noise, args.eval_episodes)})
            print(rows[-1], f"{time.monotonic() - began:.0f} s", flush=True)
    robot.close()
    return {"rows": rows, "seconds": time.monotonic() - began}


def record(args: argparse.Namespace) -> dict[str, Any]:
    """Record episodes of the noisy policy; return its success rate."""
    robot, draw = HostFetch(args.noise, args.seed), np.random.default_rng(args.seed)

    def behave(_: np.ndarray, __: np.ndarray, towards: np.ndarray) -> np.ndarray:
        if draw.random() < 0.5:
            return draw.uniform(-1.0, 1.0, 4)
        return np.clip(np.append(5.0 * towards, 0.0) + 0.5 * draw.standard_normal(4), -1.0, 1.0)

    played = [robot.episode(behave) for _ in range(args.episodes)]
    robot.close()
    observations, actions, goals, reached = (np.stack(parts) for parts in zip(*played, strict=True))
    np.savez(args.recordings, observations=observations, actions=actions, goals=goals)
    return {"success_of_behaviour": float(np.mean(reached)), "episodes": args.episodes}


def recorded(args: argparse.Namespace) -> dict[str, Any]:
    """Learn offline, from recordings alone; return the results."""
    began = time.monotonic()
    learner = indicator.learn(args.recordings, updates=args.updates, **_options(args))
    return {"success": _evaluate(learner, args.noise, args.eval_episodes), "seconds": time.monotonic() - began}


def main(words: list[str] | None = None) -> int:
    """Run one of the three modes, and print its result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", choices=("live", "record", "recorded"))
    parser.add_argument("--method", choices=tuple(_METHODS), default="exact")
    parser.add_argument("--cloning", action="store_true", help="behaviour cloning instead of DDPG")
    parser.add_argument("--recordings", type=Path, default=Path("recorded.npz"))
    parser.add_argument("--preset", default="cpu")
    for name, default in (("steps", 40_000), ("interval", 5000), ("episodes", 1000), ("updates", 20_000)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--eval-episodes", type=int, default=50)
    parser.add_argument("--noise", type=float, default=0.0, help="grey levels")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(words)
    result = {"live": live, "record": record, "recorded": recorded}[args.mode](args)
    asked = {name: str(value) if isinstance(value, Path) else value for name, value in vars(args).items() if name != "json"}
    text = json.dumps({"asked": asked, **result}, indent=2)
    print(text)
    if args.json is not None:
        args.json.write_text(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
