"""Detection of non-finite numbers, and dump of the state that contains them."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.run.storage.arrays import named_leaves, to_host
from jaxrl_vis.run.storage.metrics import PerSeed
from jaxrl_vis.types import LoopState

_MAX_EPISODES = 64


def _floating_leaves(tree: Any) -> dict[str, Any]:
    return {name: leaf for name, leaf in named_leaves(tree).items() if jnp.issubdtype(leaf.dtype, jnp.floating)}


def nonfinite_leaves(loop: LoopState) -> dict[str, jax.Array]:
    """Return, by name of each floating-point leaf, True if it has a NaN or an infinity: [] bool. Traceable under jit."""
    return {name: ~jnp.isfinite(leaf).all() for name, leaf in _floating_leaves(loop).items()}


def _episodes(loop: LoopState, *names: str) -> dict[str, np.ndarray]:
    """Copy fields of all episodes in the replay to the host, by name: [S, N, steps, components] float32."""
    episodes = {name: np.asarray(getattr(loop.replay.episodes, name)) for name in names}
    # If devices share a learner, episodes are indexed by rollout and environment (`sharding.Layout`).
    return {name: array.reshape(len(array), -1, *array.shape[-2:]) for name, array in episodes.items()}


def nonfinite_simulation(loop: LoopState, num_envs: int) -> str | None:
    """Describe the evidence that the simulation produced the non-finite number; None if there is none.

    There is evidence if a non-finite state precedes the first non-finite action: later ones are due to the learner.

    Args:
        loop: As in `dump`.
        num_envs: Environments per seed.
    """
    names = ["states"]
    if jnp.issubdtype(loop.replay.episodes.observations.dtype, jnp.floating):
        names.append("observations")
    episodes = _episodes(loop, "actions", *names)
    is_bad = {name: np.asarray(~np.isfinite(array).all(-1)) for name, array in episodes.items()}
    horizon = is_bad["actions"].shape[-1]
    first_action = _first_true(is_bad["actions"])
    for name, quantity in (("states", "achieved_state"), ("observations", "observation")):
        if name not in is_bad:
            continue
        step, goal = _first_true(is_bad[name][..., : horizon + 1]), is_bad[name][..., horizon + 1]
        # Action t leads from state t to state t + 1.
        seeds, slots = np.nonzero(goal | (step <= np.minimum(first_action, horizon)))
        if len(seeds):
            seed, slot = seeds[0], slots[0]
            where = "in its goal" if goal[seed, slot] else f"from step {step[seed, slot]} on"
            return f"{quantity} of environment {slot % num_envs} is not finite {where}, and all actions before it are"
    return None


def _first_true(is_bad: np.ndarray) -> np.ndarray:
    """Return the index [...] of the first true value along the last axis of [..., N]; N if there is none."""
    return np.where(is_bad.any(-1), is_bad.argmax(-1), is_bad.shape[-1])


def dump(file: Path, loop: LoopState, values: PerSeed, leaves: list[str]) -> None:
    """Write an .npz for locating the source of a non-finite number. Runs on the host only, without compilation.

    ``train.*``: the learner. ``episodes.*``: states and actions of up to 64 replay episodes with a non-finite number, with
    their seed_index and slot. ``metrics.*``: losses etc., [S]. ``key`` (key data) and ``iteration``: the source of the
    next iteration's random numbers. ``nonfinite_leaves``: the names in ``leaves``.

    Args:
        file: Output file; its folder is created.
        loop: State of the failed iteration, or of the next one, dispatched before the host read them.
        values: Metrics of the failed iteration.
        leaves: Names of the learner's non-finite leaves.
    """
    arrays = {f"train.{name}": array for name, array in to_host(loop.train, copy=True).items()}
    episodes = _episodes(loop, "states", "actions")
    bad = ~(np.isfinite(episodes["states"]).all((-2, -1)) & np.isfinite(episodes["actions"]).all((-2, -1)))
    seeds, slots = (index[:_MAX_EPISODES] for index in np.nonzero(bad))
    arrays |= {"episodes.seed_index": seeds, "episodes.slot": slots}
    arrays |= {f"episodes.{name}": array[seeds, slots] for name, array in episodes.items()}
    arrays |= {f"metrics.{name}": np.asarray(row) for name, row in values.items()}
    arrays |= to_host({"key": loop.key, "iteration": loop.iteration}, copy=True)
    arrays["nonfinite_leaves"] = np.asarray(leaves, dtype=np.str_)
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]
