"""Audit of several rewards on one task: a record for each, shown as a table and a figure."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

import jaxrl_vis_envs
from jaxrl_vis.errors import RequestError
from jaxrl_vis.report.plots import FAINT, INK
from jaxrl_vis.studies.audit import measures
from jaxrl_vis.studies.audit.episodes import Pairs, Reward, make_pairs, play, search, with_noise
from jaxrl_vis_envs import task_modules
from jaxrl_vis_envs.base import GoalEnv

COLUMNS = {
    "false_positive": "false +",
    "false_negative": "false -",
    "order_distance": "order by distance",
    "order_time": "order by time",
    "calibration_error": "calibration error",
    "exploited": "exploited",
    "solved": "solved",
    "solvable": "solvable",
}
"""Keys of a record, and their headings; docs/indicator_rewards.md explains them."""
_BATCH = 512


def _with_errors_named(name: str, reward: Reward) -> Reward:
    """Wrap a reward so that its errors name it."""

    def call(images: jax.Array, goals: jax.Array) -> jax.Array:
        try:
            return reward(images, goals)
        except RequestError:
            raise
        except Exception as error:  # noqa: BLE001 - somebody else's code may raise anything
            file = getattr(getattr(reward, "__code__", None), "co_filename", None)
            raise RequestError(f"reward {name} cannot be computed: {task_modules.describe_error(error, file)}") from error

    return call


def _rewards(name: str, reward: Reward, images: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Compute the rewards [N] of pairs in batches.

    Raises:
        RequestError: The rewards are not one number between 0 and 1 for each pair.
    """
    compiled, rows = jaxrl_vis_envs.jit(_with_errors_named(name, reward)), []
    for first in range(0, len(images), _BATCH):
        indices = np.arange(first, first + _BATCH) % len(images)  # the last batch wraps around, so that all have the same size
        rows.append(np.asarray(compiled(images[indices], goals[indices]))[: len(images) - first])
        if rows[-1].shape != (min(_BATCH, len(images) - first),):
            raise RequestError(f"reward {name} has the shape {rows[-1].shape[1:]} for each image: it must be one number")
    values = np.concatenate(rows).astype(np.float64)
    if not np.all((values >= 0.0) & (values <= 1.0)):
        raise RequestError(f"reward {name} lies between {values.min():g} and {values.max():g}: it must lie between 0 and 1")
    return values


def audit(
    env: GoalEnv,
    rewards: Mapping[str, Reward],
    episodes: int = 64,
    goals: int = 32,
    sequences: int = 64,
    noise: float = 0.0,
    seed: int = 0,
) -> tuple[dict[str, dict[str, float]], Pairs, dict[str, np.ndarray]]:
    """Audit rewards of (images, goal images) on a task.

    Args:
        env: Environment of the task, with image observations.
        rewards: Reward functions by name, with values between 0 and 1.
        episodes: Number of episodes of random actions.
        goals, sequences: Number of goals of the search, and of random sequences of actions for each.
        noise: Standard deviation in grey levels of camera noise on all images. The search has none.
        seed: Seed of all random numbers.

    Returns:
        Records by reward, with the keys of `COLUMNS`; the pairs; and the rewards [N] of the pairs by reward.

    Raises:
        RequestError: A reward has the wrong shape or range, or the task shows states.
    """
    if len(env.observation_spec.shape) != 3:
        raise RequestError("rewards are audited on images, and this task shows states: name its Visual variant")
    pairs = with_noise(make_pairs(env, play(env, episodes, seed), seed), noise, seed)
    is_reached = pairs.distance <= env.threshold
    # Pairs of images with the end of their own episode are the first part of all pairs.
    own = np.arange(episodes * env.horizon).reshape(episodes, env.horizon)
    time = np.arange(env.horizon)
    records, values = {}, {}
    for name, reward in rewards.items():
        predicted = values[name] = _rewards(name, reward, pairs.images, pairs.goals)
        false_positive, false_negative = measures.error_shares(predicted, is_reached)
        by_distance = [measures.rank_correlation(predicted[rows], -pairs.distance[rows]) for rows in own]
        by_time = [measures.rank_correlation(predicted[rows], time) for rows in own]
        best = search(env, reward, goals, sequences, seed)
        claimed = best.reward >= 0.5
        records[name] = {
            "false_positive": false_positive,
            "false_negative": false_negative,
            "order_distance": float(np.mean(by_distance)),
            "order_time": float(np.mean(by_time)),
            "calibration_error": measures.calibration_error(predicted, is_reached),
            "exploited": float(np.mean(claimed & ~best.is_reached)),
            "solved": float(np.mean(best.is_reached)),
            "solvable": float(np.mean(best.is_reachable)),
        }
    return records, pairs, values


def table(records: Mapping[str, Mapping[str, float]]) -> str:
    """Format records as a Markdown table."""
    rows = [["reward", *COLUMNS.values()], ["---"] * (len(COLUMNS) + 1)]
    rows += [[name, *(f"{record[key]:.3f}" for key in COLUMNS)] for name, record in records.items()]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def draw(pairs: Pairs, values: Mapping[str, np.ndarray], threshold: float, unit: str, out: Path) -> None:
    """Write a figure of rewards against true distances (quartiles in bins of the distance) and of their calibration.

    Args:
        pairs: Pairs of images and goals.
        values: Rewards [N] of the pairs, by name of the reward.
        threshold: Distance up to which a goal counts as reached.
        unit: Unit of the distances.
        out: File of the figure; its suffix determines the format.
    """
    names: Sequence[Any] = list(values)
    figure = Figure(figsize=(3.1 * max(2, len(names)), 5.6), layout="constrained")
    axes = figure.subplots(2, max(2, len(names)), squeeze=False)
    edges = np.quantile(pairs.distance, np.linspace(0.0, 1.0, 21))
    place = np.clip(np.searchsorted(edges, pairs.distance, side="right") - 1, 0, 19)
    is_reached = pairs.distance <= threshold
    for column, name in enumerate(names):
        above, below, reward = axes[0, column], axes[1, column], values[name]
        some = [number for number in range(20) if np.any(place == number)]
        middle = [np.mean(pairs.distance[place == number]) for number in some]
        low, median, high = np.array([np.quantile(reward[place == number], [0.25, 0.5, 0.75]) for number in some]).T
        above.fill_between(middle, low, high, color="#0f7b6c", alpha=0.2, linewidth=0)
        above.plot(middle, median, color="#0f7b6c")
        above.axvline(threshold, color=FAINT, linewidth=0.8)
        above.set_title(name, color=INK, fontsize=10)
        above.set_xlabel(f"true distance, {unit}")
        mean, frequency, _ = measures.calibration(reward, is_reached)
        below.plot([0, 1], [0, 1], color=FAINT, linewidth=0.8)
        below.plot(mean, frequency, "o", color="#b4531f", markersize=4)
        below.set_xlabel("reward")
        for panel, label in ((above, "reward"), (below, "share that reaches")):
            panel.set_ylim(-0.05, 1.05)
            if column == 0:
                panel.set_ylabel(label)
    for column in range(len(names), axes.shape[1]):
        for row in axes:
            row[column].set_axis_off()
    figure.savefig(out, dpi=120)


def device_kind() -> str:
    """Return the kind of device on which audits run, for records."""
    return jax.devices()[0].device_kind
