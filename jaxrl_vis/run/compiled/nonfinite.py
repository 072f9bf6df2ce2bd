"""A number that is not finite: how it is noticed, and what is kept for whoever looks for its cause."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.run.arrays import named_leaves, to_host
from jaxrl_vis.run.metrics import PerSeed
from jaxrl_vis.types import LoopState

_MAX_EPISODES = 64


def _checked(tree: Any) -> dict[str, Any]:
    return {name: leaf for name, leaf in named_leaves(tree).items() if jnp.issubdtype(leaf.dtype, jnp.floating)}


def broken_leaves(loop: LoopState) -> dict[str, jax.Array]:
    """Return which floating-point leaves hold a NaN or an infinity: name -> [] bool. Traceable; compiled before training."""
    return {name: ~jnp.isfinite(leaf).all() for name, leaf in _checked(loop).items()}


def _episodes(loop: LoopState, *names: str) -> dict[str, np.ndarray]:
    """Parts of all episodes of the replay, [S, N, T..., values] float32."""
    episodes = {name: np.asarray(getattr(loop.replay.episodes, name)) for name in names}
    # Where devices share a learner, episodes are numbered by rollout and environment (`sharding.Layout`).
    return {name: array.reshape(len(array), -1, *array.shape[-2:]) for name, array in episodes.items()}


def made_by_simulation(loop: LoopState, num_envs: int) -> str | None:
    """Describe the evidence that the simulation made a non-finite number; None where there is none.

    It did where such a number came before the first action that is not finite: what comes after that is the learner's fault.

    Args:
        loop: As of `dump`.
        num_envs: Environments of a seed.
    """
    names = ["states"]
    if jnp.issubdtype(loop.replay.episodes.observations.dtype, jnp.floating):
        names.append("observations")
    episodes = _episodes(loop, "actions", *names)
    is_bad = {name: np.asarray(~np.isfinite(array).all(-1)) for name, array in episodes.items()}
    horizon = is_bad["actions"].shape[-1]
    first_action = _first(is_bad["actions"])
    for name, quantity in (("states", "achieved_state"), ("observations", "observation")):
        if name not in is_bad:
            continue
        step, goal = _first(is_bad[name][..., : horizon + 1]), is_bad[name][..., horizon + 1]
        # An action leads from the state of its own number to the next one.
        seeds, slots = np.nonzero(goal | (step <= np.minimum(first_action, horizon)))
        if len(seeds):
            seed, slot = seeds[0], slots[0]
            where = "in its goal" if goal[seed, slot] else f"from step {step[seed, slot]} on"
            return f"{quantity} of environment {slot % num_envs} is not finite {where}, and all actions before it are"
    return None


def _first(is_bad: np.ndarray) -> np.ndarray:
    """Index of the first true value along the last axis; the axis' length where there is none."""
    return np.where(is_bad.any(-1), is_bad.argmax(-1), is_bad.shape[-1])


def dump(file: Path, loop: LoopState, values: PerSeed, leaves: list[str]) -> None:
    """Writes an .npz that shows where a non-finite number came from. Runs on the host alone: nothing is compiled here.

    ``train.*``: the learner. ``episodes.*``: states and actions of up to 64 replay episodes with a bad number in them, with
    their seed_index and slot. ``metrics.*``: losses and the like, [S]. ``key`` (words) and ``iteration``: what the next
    iteration would draw from. ``nonfinite_leaves``: the names in ``leaves``.

    Args:
        file: Path of the file; its folder is made.
        loop: The state: of the iteration that went wrong, or of the one that was dispatched before the host knew.
        values: Metrics of the iteration that went wrong.
        leaves: Names of the learner's leaves that are not finite.
    """
    found = {f"train.{name}": array for name, array in to_host(loop.train, copy=True).items()}
    episodes = _episodes(loop, "states", "actions")
    bad = ~(np.isfinite(episodes["states"]).all((-2, -1)) & np.isfinite(episodes["actions"]).all((-2, -1)))
    seeds, slots = (index[:_MAX_EPISODES] for index in np.nonzero(bad))
    found |= {"episodes.seed_index": seeds, "episodes.slot": slots}
    found |= {f"episodes.{name}": array[seeds, slots] for name, array in episodes.items()}
    found |= {f"metrics.{name}": np.asarray(row) for name, row in values.items()}
    found |= to_host({"key": loop.key, "iteration": loop.iteration}, copy=True)
    found["nonfinite_leaves"] = np.asarray(leaves, dtype=np.str_)
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(file, **found)  # pyright: ignore[reportArgumentType]
