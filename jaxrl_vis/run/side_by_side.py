"""Rollouts in parts, which threads play side by side, and what is learned from them: how a run on one device trains.

Each thread waits for the end of what it calls. Without, XLA would take one call after the other. A rollout that is one part is
called and not waited for, so that a GPU's host is ahead of it.
"""

import concurrent.futures
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxrl_vis.learner.evaluate import metrics_of, num_recorded, recording_of
from jaxrl_vis.learner.parts import Parts, Played, joined
from jaxrl_vis.learner.rollout import NO_EXPLORATION, Exploration
from jaxrl_vis.run.signals import shield_this_thread
from jaxrl_vis.types import Episodes, LoopState, Metrics, TrainState
from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.cores import num_cores


class SideBySide:
    """Training and evaluation by the programs of `Parts`, the latter where they play any environments.

    Args:
        env: The environment.
        parts: What is compiled.
        compiled: Name of an attribute of ``parts`` -> the compiled program.
    """

    def __init__(self, env: GoalEnv, parts: Parts, compiled: Callable[[str], Any]):
        self._env, self._parts, self._compiled = env, parts, compiled
        self._pool = concurrent.futures.ThreadPoolExecutor(num_cores(), initializer=shield_this_thread)

    def play(
        self, train: TrainState, keys: jax.Array, count: int, exploration: Exploration, num_kept: int | None = None
    ) -> list[tuple[Episodes | None, Metrics]]:
        """Plays ``count`` episodes, rounded up to whole parts.

        Args:
            train: The learners, [S, ...].
            keys: [S] typed keys.
            count: Episodes of each learner.
            exploration: The noise.
            num_kept: How many episodes to keep (the first ones, rounded up to whole parts); None: all.

        Returns:
            Each part's episodes (None where they are not kept) and outcome.
        """
        program, size = self._compiled("play"), self._parts.size
        noise: Any = Exploration(*map(np.float32, exploration))  # type: ignore[arg-type]
        if count <= size:
            return [program(train, keys, np.int32(0), noise)]

        def play(first: int) -> tuple[Episodes | None, Metrics]:
            episodes, outcome = jax.block_until_ready(program(train, keys, np.int32(first), noise))
            return episodes if num_kept is None or first < num_kept else None, outcome

        return list(self._pool.map(play, range(0, count, size)))

    def rollout(self, train: TrainState, keys: jax.Array) -> Played:
        """As `TrainStep.rollout`: all parts of one rollout of training, put together."""
        total = self._parts.total
        played = self.play(train, keys, total, self._parts.exploration)
        episodes, outcome = jax.tree.map(lambda *leaves: joined(leaves, total), *played)
        return episodes, outcome

    def train_iteration(self, loop: LoopState) -> tuple[LoopState, Metrics]:
        """As `TrainStep.train_iteration`."""
        keys = self._compiled("keys")(loop.key, loop.iteration)
        return self._compiled("learn")(loop, self.play(loop.train, keys, self._parts.total, self._parts.exploration))

    def evaluate(self, train: TrainState, keys: jax.Array, count: int) -> tuple[Metrics, dict[str, Any]]:
        """As `TrainStep.evaluate`, with the key of each seed, [S]; what is returned are NumPy's arrays."""
        kept = num_recorded(count)
        played = jax.device_get(self.play(train, keys, count, NO_EXPLORATION, num_kept=kept))
        outcome = {name: joined([part[name] for _, part in played], count, np) for name in ("success", "goal_distance")}
        observations = joined([episodes.observations for episodes, _ in played if episodes is not None], kept, np)
        return metrics_of(outcome, np), recording_of(observations, outcome["success"], self._env.frame_stack)
