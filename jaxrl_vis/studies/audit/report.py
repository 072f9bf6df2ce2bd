"""Audit of several rewards on one task: a record for each, shown as a table and a figure."""

import textwrap
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

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
_REWARD, _FREQUENCY = "#0f7b6c", "#b4531f"


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


def _check(name: str, reward: Reward, shape: tuple[int, ...]) -> None:
    """Check, without computing anything, that a reward can be computed from images of ``shape``, as one number for each.

    Raises:
        RequestError: It cannot.
    """
    images = jax.ShapeDtypeStruct((_BATCH, *shape), np.uint8)
    rewards = jax.eval_shape(_with_errors_named(name, reward), images, images)
    if not isinstance(rewards, jax.ShapeDtypeStruct) or rewards.shape != (_BATCH,):
        returned = ", ".join(str(leaf.shape) for leaf in jax.tree.leaves(rewards)) or "nothing"
        raise RequestError(
            f"reward {name} returns {returned} for {_BATCH} images: it must return ({_BATCH},), one number for each"
        )


def _rewards(name: str, reward: Reward, images: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Compute the rewards [N] of pairs in batches.

    Raises:
        RequestError: The rewards do not lie between 0 and 1.
    """
    compiled, rows = jaxrl_vis_envs.jit(_with_errors_named(name, reward)), []
    for first in range(0, len(images), _BATCH):
        indices = np.arange(first, first + _BATCH) % len(images)  # the last batch wraps around, so that all have the same size
        rows.append(np.asarray(compiled(images[indices], goals[indices]))[: len(images) - first])
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
    for name, reward in rewards.items():
        _check(name, reward, env.observation_spec.shape)
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
    """Format records as a Markdown table with aligned columns."""
    rows = [["reward", *COLUMNS.values()]]
    rows += [[name, *(f"{record[key]:.3f}" for key in COLUMNS)] for name, record in records.items()]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    rows.insert(1, ["-" * width for width in widths])
    padded = ([cell.ljust(width) for cell, width in zip(row, widths, strict=True)] for row in rows)
    return "\n".join(f"| {' | '.join(row)} |" for row in padded)


def draw(pairs: Pairs, values: Mapping[str, np.ndarray], threshold: float, unit: str, out: Path) -> None:
    """Write a figure with a column for each reward: rewards against true distances above, calibration below.

    Args:
        pairs: Pairs of images and goals.
        values: Rewards [N] of the pairs, by name of the reward.
        threshold: Distance up to which a goal counts as reached.
        unit: Unit of the distances.
        out: File of the figure; its suffix determines the format.
    """
    is_reached = pairs.distance <= threshold
    figure = Figure(figsize=(3.4 * len(values), 6.2), layout="constrained")
    axes = figure.subplots(2, len(values), squeeze=False, sharey=True)
    for (above, below), (name, reward) in zip(axes.T, values.items(), strict=True):
        above.set_title("\n".join(textwrap.wrap(name, 34)), color=INK, fontsize=10)
        _draw_distances(above, pairs.distance, reward, threshold, unit)
        below.set_title(f"calibration error {measures.calibration_error(reward, is_reached):.3f}", color=INK, fontsize=9)
        _draw_calibration(below, reward, is_reached)
    for panel, label in ((axes[0, 0], "reward"), (axes[1, 0], "fraction that truly reaches")):
        panel.set_ylim(-0.05, 1.05)
        panel.set_ylabel(label)
        panel.legend(fontsize=7, labelcolor=INK)
    figure.savefig(out, dpi=120)


def _draw_distances(axes: Axes, distance: np.ndarray, reward: np.ndarray, threshold: float, unit: str) -> None:
    """Draw mean and quartiles of rewards [N] against distances [N].

    Pairs at distance zero, those up to the threshold and those beyond have separate bins: few pairs reach their goal, and would
    share their bins with pairs that miss. For the same reason the axis is linear up to the threshold, and logarithmic beyond.
    """
    is_reached = distance <= threshold
    bins = []
    for rows, count in ((distance == 0.0, 1), (is_reached & (distance > 0.0), 5), (~is_reached, 15)):
        order = np.flatnonzero(rows)[np.argsort(distance[rows])]
        bins += [part for part in np.array_split(order, count) if part.size]
    middle = [np.mean(distance[part]) for part in bins]
    low, high = np.array([np.quantile(reward[part], [0.25, 0.75]) for part in bins]).T
    axes.axvline(threshold, color=FAINT, linewidth=0.8, linestyle="--", label=f"threshold, {threshold:g} {unit}")
    axes.fill_between(middle, low, high, color=_REWARD, alpha=0.2, linewidth=0, label="middle half of pairs")
    axes.plot(middle, [np.mean(reward[part]) for part in bins], "o-", color=_REWARD, markersize=3, label="mean")
    axes.set_xscale("symlog", linthresh=threshold)
    steps = np.outer(10.0 ** np.arange(-6, 7), [1, 2, 5]).ravel()
    axes.set_xticks([0.0, *steps[(steps >= threshold) & (steps <= distance.max())]])
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.tick_params(axis="x", labelsize=8)
    axes.set_xlim(left=-0.1 * threshold)
    axes.set_xlabel(f"true distance, {unit}")


def _draw_calibration(axes: Axes, reward: np.ndarray, is_reached: np.ndarray) -> None:
    """Draw the fraction of reached pairs against the mean reward; the area of a bin's dot grows with its number of pairs."""
    mean, frequency, count = measures.calibration(reward, is_reached)
    axes.plot([0, 1], [0, 1], color=FAINT, linewidth=0.8, label="calibrated")
    label = f"bin of pairs; the largest has {np.max(count):,}"
    axes.scatter(mean, frequency, 14 + 86 * count / np.max(count), color=_FREQUENCY, linewidths=0, label=label)
    axes.set_xlabel("reward")
