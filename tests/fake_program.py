"""Fake program with the interface of `train_step.TrainStep` that compiles quickly: it "learns" from random numbers.

As a script (`python fake_program.py RUN_DIR KIND`), it trains until it is stopped; the tests send it signals.
"""

import collections
import dataclasses
import functools
import math
import signal
import sys
import time
import types
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.config import Config
from jaxrl_vis.errors import Terminated
from jaxrl_vis.learner.acting.evaluate import Evaluation
from jaxrl_vis.learner.acting.rollout import Exploration
from jaxrl_vis.learner.acting.rollout_parts import part_result_spec
from jaxrl_vis.learner.iteration import Learned
from jaxrl_vis.learner.memory.replay import make_replay
from jaxrl_vis.learner.parallel.sharding import ONE_DEVICE
from jaxrl_vis.run.storage import metrics
from jaxrl_vis.run.storage.checkpoint import Checkpoints
from jaxrl_vis.run.storage.folder import read_run_id
from jaxrl_vis.run.trainer import Trainer
from jaxrl_vis.types import Episodes, LoopState, NormalizerState, ReplayState, TrainState

HORIZON, SIZE = 5, 16
_SEED_AXES = LoopState(train=0, replay=0, key=0, iteration=None)


def small_config(**changes) -> Config:
    config = Config().replace(
        preset="debug", num_envs=2, env_steps=80, replay_transitions=30, image_size=SIZE, pixels="depth", seeds=2
    )
    looking = {"eval_interval": 2, "eval_episodes": 4, "checkpoint_interval": 2, "full_checkpoint_interval": 2}
    return config.replace(**(looking | changes))


@dataclasses.dataclass(frozen=True)
class _Sizes:
    """Values that the jitted functions of a `FakeProgram` depend on."""

    image: int
    num_envs: int
    seeds: int
    episodes: int
    nan_at: int | None
    break_state: bool
    filtered_share: float


_TRACES: collections.Counter[_Sizes] = collections.Counter()


def _make_env(image_size: int) -> types.SimpleNamespace:
    return types.SimpleNamespace(
        distance_unit="m",
        threshold=0.05,
        control_period=0.04,
        horizon=HORIZON,
        frame_stack=1,
        observation_spec=jax.ShapeDtypeStruct((1, image_size, image_size), jnp.uint8),
        goal_state_size=3,
        action_size=4,
        metric_names=("success", "goal_distance"),
    )


class FakeProgram:
    """Fake program, see the module. Programs of equal `_Sizes` share jitted functions, traced once per process."""

    def __init__(self, config: Config, nan_at: int | None = None, break_state: bool = False, filtered_share: float = 0.1):
        size, num_envs = config.environment.image_size, config.run.num_envs
        self.config, self.layout, self.env = config, ONE_DEVICE, _make_env(size)
        self.plays_parts, self.part_size, self.exploration = False, num_envs, Exploration()
        self.parts_spec = [part_result_spec(self.env, num_envs, config.run.seeds)]
        self.steps_per_iteration = num_envs * HORIZON
        self.updates_per_iteration = 3
        self.num_iterations = math.ceil(config.run.env_steps / self.steps_per_iteration)
        episodes = math.ceil(config.run.replay_transitions / self.steps_per_iteration) * num_envs
        self.replay = make_replay(config.run.replay_transitions, num_envs, HORIZON)
        self.replay_bytes = episodes * ((HORIZON + 2) * (size * size + 3 * 4) + HORIZON * 4 * 4) + 4
        self._sizes = _Sizes(size, num_envs, config.run.seeds, episodes, nan_at, break_state, filtered_share)
        vars(self).update(_jitted(self._sizes))

    @property
    def traces(self) -> int:
        """Number of times that this process has traced `learn` with these sizes."""
        return _TRACES[self._sizes]


@functools.cache
def _jitted(sizes: _Sizes) -> dict[str, Any]:
    """Return the jitted functions `init`, `keys`, `play`, `learn` and `evaluate`, by name."""
    size, episodes = sizes.image, sizes.episodes
    played = part_result_spec(_make_env(size), sizes.num_envs, sizes.seeds)

    def init_one(key):
        parameters = {"layer": {"kernel": jax.random.uniform(key, (4, 3)) - 0.5, "bias": jnp.zeros(3)}}
        agent = {
            "actor": parameters,
            "critic": parameters,
            "optimizers": ((jnp.zeros((), jnp.int32), parameters), ()),
            "updates": jnp.zeros((), jnp.int32),
        }
        train = TrainState(agent, NormalizerState(jnp.zeros(()), jnp.zeros((1, size, size)), jnp.ones((1, size, size))))
        replay = Episodes(
            observations=jnp.zeros((episodes, HORIZON + 2, 1, size, size), jnp.uint8),
            states=jnp.zeros((episodes, HORIZON + 2, 3)),
            actions=jnp.zeros((episodes, HORIZON, 4)),
        )
        return LoopState(train, ReplayState(replay, jnp.zeros((), jnp.int32)), key, jnp.zeros((), jnp.int32))

    def noise_of(key):
        # One draw, spread out by arithmetic that compiles faster than many draws.
        return jax.random.uniform(key, ())

    def play_one(train, key):
        def spread(like):
            count = jnp.arange(sizes.num_envs * math.prod(like.shape[1:]), dtype=jnp.uint32)
            words = (count * jnp.uint32(2654435761)) ^ (noise_of(key) * 2.0**24).astype(jnp.uint32)
            values = ((words ^ (words >> 15)) >> 8).reshape((sizes.num_envs, *like.shape[1:]))
            return values.astype(like.dtype) if like.dtype == jnp.uint8 else values.astype(jnp.float32) / 2.0**24 - 0.5

        episodes, outcome = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), played)
        return jax.tree.map(spread, episodes), {name: jnp.zeros(leaf.shape) for name, leaf in outcome.items()}

    def learn_one(loop, parts):
        _TRACES[sizes] += 1
        noise = noise_of(jax.random.fold_in(loop.key, loop.iteration))
        ((new, _),) = parts
        old = loop.replay.episodes
        start = (loop.iteration * sizes.num_envs) % episodes
        bad = loop.iteration == (-1 if sizes.nan_at is None else sizes.nan_at)
        if sizes.break_state:
            new = new.replace(states=jnp.where(bad, jnp.nan, new.states))
        replay = jax.tree.map(lambda whole, part: jax.lax.dynamic_update_slice_in_dim(whole, part, start, 0), old, new)
        step = 0.1 * (noise - 0.5) + 1e-3 * replay.states.mean() + 1e-4 * replay.observations.mean()
        agent = loop.train.agent
        actor = {"layer": agent["actor"]["layer"] | {"kernel": agent["actor"]["layer"]["kernel"] + step}}
        loss = jnp.where(bad, jnp.nan, step**2)
        critic = jax.tree.map(lambda leaf: leaf + 0.0 * loss, agent["critic"])
        train = loop.train.replace(agent=agent | {"actor": actor, "critic": critic, "updates": agent["updates"] + 3})
        memory = ReplayState(replay, jnp.minimum(loop.replay.size + sizes.num_envs, episodes))
        metrics = {
            "train/critic_loss": loss,
            "train/success": jax.nn.sigmoid(loop.iteration / 3.0 - 1.0),
            "train/goal_distance": 0.2 / (1.0 + loop.iteration),
            "train/filtered_share": jnp.float32(sizes.filtered_share),
            "guard/nonfinite": jnp.sum(~jnp.isfinite(loss)).astype(jnp.float32),
        }
        return Learned(LoopState(train, memory, loop.key, loop.iteration + 1), metrics)

    def evaluate_one(train, key):
        kernel, updates = train.agent["actor"]["layer"]["kernel"], train.agent["updates"]
        score = jax.nn.sigmoid(updates / 9.0 - 1.0 + 0.1 * kernel.sum())
        y, x = jnp.mgrid[0:size, 0:size]
        t = jnp.arange(HORIZON + 1)[:, None, None]
        ball = ((y - 3 - t) ** 2 + (x - 4 - t) ** 2 < 9) * 120
        frames = jnp.broadcast_to((200 - ball).astype(jnp.uint8)[None, :, None], (3, HORIZON + 1, 1, size, size))
        images = {"frames": frames, "goals": frames[:, -1], "success": jnp.array([1.0, 0.0, 1.0])}
        return Evaluation({"eval/success": score, "eval/goal_distance": 0.2 * (1.0 - score)}, images)

    play_seeds = jax.vmap(play_one)
    return {
        "init": jax.jit(jax.vmap(init_one, out_axes=_SEED_AXES)),
        "keys": jax.jit(jax.vmap(jax.random.fold_in, in_axes=(0, None))),
        "play": jax.jit(lambda train, keys, first, exploration: play_seeds(train, keys)),
        "learn": jax.jit(jax.vmap(learn_one, (_SEED_AXES, 0), Learned(_SEED_AXES, 0)), donate_argnums=0),
        "evaluate": jax.jit(jax.vmap(evaluate_one, in_axes=(0, None))),
    }


def make_fake_trainer(
    config: Config, run_dir: Path, resume: bool = False, overwrite: bool = False, log: tuple[str, ...] | None = None, **program
) -> Trainer:
    return Trainer(config, FakeProgram(config, **program), run_dir, resume=resume, overwrite=overwrite, log=log)


def run_until_sigterm(trainer: Trainer, iteration: int) -> None:
    """Run a trainer, send SIGTERM after ``iteration``, and return once it has stopped; fail if it does not."""
    try:
        for report in trainer.run():
            if report.iteration == iteration:
                signal.raise_signal(signal.SIGTERM)
    except Terminated:
        return
    raise AssertionError("the run did not end")


def rows_without_time(path: Path) -> list[dict]:
    return [
        {name: row[name] for name in row if not name.startswith("time/") and name != metrics.RUN_ID}
        for row in metrics.read_rows(path / "metrics.jsonl")
    ]


def final_state(path: Path, shapes) -> list[np.ndarray]:
    checkpoints = Checkpoints(path / "checkpoints", read_only=True, run_id=read_run_id(path))
    return as_plain(checkpoints.restore_for_resume(shapes).loop)


def as_plain(tree) -> list[np.ndarray]:
    """Return all leaves as NumPy arrays, typed keys as their uint32 data."""

    def plain(leaf):
        return np.array(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)

    return [plain(leaf) for leaf in jax.tree.leaves(tree)]


def main() -> None:
    run_dir, kind = Path(sys.argv[1]), sys.argv[2]
    # "signal": small and slow, saved only when interrupted. "kill": saves a large replay at every iteration.
    config = small_config(env_steps=100_000, full_checkpoint_interval=0, checkpoint_interval=1000, eval_interval=50)
    if kind == "kill":
        config = config.replace(replay_transitions=50_000, num_envs=1000, env_steps=10**7, full_checkpoint_interval=1)
    for report in make_fake_trainer(config, run_dir, resume=run_dir.exists()).run():
        print(f"report {report.iteration}", flush=True)
        time.sleep(0.05 if kind == "signal" else 0.0)


if __name__ == "__main__":
    main()
