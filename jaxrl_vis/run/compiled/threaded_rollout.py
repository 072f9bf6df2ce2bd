"""Rollouts and evaluations in parts, which threads of a CPU run in parallel with the same program.

Each thread waits for the result of its call; otherwise XLA would execute the calls sequentially. A rollout of a single part is
dispatched asynchronously, so that the host runs ahead of a GPU.
"""

import concurrent.futures
from collections.abc import Callable

import jax
import numpy as np

from jaxrl_vis.learner.acting.evaluate import Evaluation, num_recorded, summarize
from jaxrl_vis.learner.acting.rollout import NO_EXPLORATION, Exploration
from jaxrl_vis.learner.acting.rollout_parts import PartResult, join_parts
from jaxrl_vis.run.signals import shield_this_thread
from jaxrl_vis.types import Episodes, Metrics, TrainState
from jaxrl_vis_envs.cores import num_cores


class ThreadedRollout:
    """Thread pool for rollouts and evaluations of any number of episodes, in parts of equal size by the same program.

    Args:
        size: P, number of environments per part.
    """

    def __init__(self, size: int):
        self._size = size
        self._pool = concurrent.futures.ThreadPoolExecutor(num_cores(), initializer=shield_this_thread)

    def play(
        self,
        program: Callable[..., PartResult],
        train: TrainState,
        keys: jax.Array,
        count: int,
        exploration: Exploration,
        num_kept: int | None = None,
    ) -> list[tuple[Episodes | None, Metrics]]:
        """Roll out ``count`` episodes, rounded up to whole parts.

        Args:
            program: `TrainStep.play`, compiled.
            train: The learners, [S, ...].
            keys: [S] typed keys.
            count: Number of episodes per learner.
            exploration: The noise.
            num_kept: Number of episodes to keep (the first ones, rounded up to whole parts); None for all.

        Returns:
            Each part's episodes (None if not kept) and outcome.
        """
        noise = Exploration(*map(np.float32, exploration))  # type: ignore[arg-type]
        if count <= self._size:
            return [program(train, keys, np.int32(0), noise)]

        def play(first: int) -> tuple[Episodes | None, Metrics]:
            episodes, outcome = jax.block_until_ready(program(train, keys, np.int32(first), noise))
            return episodes if num_kept is None or first < num_kept else None, outcome

        return list(self._pool.map(play, range(0, count, self._size)))

    def evaluate(
        self, program: Callable[..., PartResult], train: TrainState, keys: jax.Array, count: int, frame_stack: int
    ) -> Evaluation:
        """Evaluate like `TrainStep.evaluate`, with ``program`` and typed keys [S]; return NumPy arrays. See `play`."""
        num_kept = num_recorded(count)
        played = jax.device_get(self.play(program, train, keys, count, NO_EXPLORATION, num_kept=num_kept))
        outcome = {name: join_parts([part[name] for _, part in played], count, np, axis=1) for name in sorted(played[0][1])}
        recorded = [episodes.observations for episodes, _ in played if episodes is not None]
        return summarize(outcome, join_parts(recorded, num_kept, np, axis=1), outcome["success"], frame_stack, np)
