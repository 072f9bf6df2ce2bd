"""Paths of gradient descent on two losses whose Pareto front is known, by several weightings.

    a    (x + 1)^2 + 2 y^2
    b    4 ((x - 1)^2 + 2 y^2), with larger gradients

The Pareto front, where neither loss can decrease without an increase of the other and their gradients are opposed, is the
segment from (-1, 0) to (1, 0). The learning rate decays, because the steps of some methods do not shrink near the front.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxrl_vis.report.plots import FAINT, INK
from jaxrl_vis.weighting import Weighting, make_weighting, weighted_grad

STARTS = ((-1.6, 1.7), (0.2, 1.8), (1.8, 1.2), (-0.4, -1.8), (1.2, -1.5))
STEPS = 400
STEP_SIZE = 0.03  # initial; decays as 1 / (1 + t / 40)
NAMES = ("a", "b")
DRAWN = (
    "sum",
    "random",
    "famo",
    "gradnorm",
    "pcgrad",
    "cagrad",
    "mgda",
    "imtl_g",
    "nash_mtl",
    "aligned_mtl",
    "config",
    "upgrad",
)

_COLOURS = ("#0f7b6c", "#b4531f", "#3b5bdb", "#a61e8c", "#c28f00")  # one per start


class Paths(NamedTuple):
    """Paths from all starts.

    Attributes:
        points: [5, STEPS + 1, 2] float32, x and y.
        losses: [5, STEPS + 1, 2] float32, losses a and b.
    """

    points: np.ndarray
    losses: np.ndarray


def losses(point: jax.Array) -> dict[str, jax.Array]:
    """Compute both losses of a point [2]."""
    x, y = point[0], point[1]
    return {"a": (x + 1.0) ** 2 + 2.0 * y**2, "b": 4.0 * ((x - 1.0) ** 2 + 2.0 * y**2)}


def descend(weighting: Weighting) -> Paths:
    """Run gradient descent from all `STARTS` in parallel, with `STEPS` steps; return the paths."""
    gradient = weighted_grad(losses, weighting)

    def path(start: jax.Array):
        def step(carry, count):
            point, state = carry
            result = gradient(point, state)
            size = STEP_SIZE / (1.0 + count / 40.0)
            return (point - size * result.gradient, result.state), point

        (last, _), points = jax.lax.scan(step, (start, weighting.init(NAMES, start)), jnp.arange(STEPS))
        points = jnp.concatenate([points, last[None]])
        values = jax.vmap(losses)(points)
        return points, jnp.stack([values[name] for name in NAMES], axis=-1)

    return Paths(*map(np.asarray, jax.jit(jax.vmap(path))(jnp.array(STARTS))))


def draw(path: Path) -> None:
    """Write a figure of the paths of the weightings in `DRAWN`.

    Args:
        path: Path of the file, .png or any other format that Matplotlib can write.
    """
    figure = Figure(figsize=(12.5, 9.4), dpi=100, facecolor="white")
    for index, (axes, name) in enumerate(zip(figure.subplots(3, 4).flat, DRAWN, strict=True)):
        _draw_paths(axes, descend(make_weighting(name)), name, has_labels=index == 0)
    figure.text(0.03, 0.965, "Gradient descent on two losses", fontsize=14, weight="bold", color=INK, va="center")
    subtitle = "minima at the stars, the second loss's gradients four times as long; the line between them is the Pareto front"
    figure.text(0.03, 0.935, subtitle, fontsize=10, color=FAINT, va="center")
    figure.subplots_adjust(left=0.03, right=0.985, bottom=0.03, top=0.89, wspace=0.12, hspace=0.2)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _draw_paths(axes: Axes, paths: Paths, name: str, has_labels: bool) -> None:
    axes.set_title(name, loc="left", fontsize=11, color=INK, pad=6)
    axes.tick_params(colors=FAINT, labelcolor=INK, length=0, labelsize=8)
    for side in axes.spines.values():
        side.set_color("#c9cdd3")
    axes.plot([-1, 1], [0, 0], color="#c9cdd3", linewidth=5, solid_capstyle="round", zorder=0)
    for points, colour in zip(paths.points, _COLOURS, strict=True):
        axes.plot(*points.T, color=colour, linewidth=1.6)
        axes.plot(*points[0], "o", color=colour, markersize=5)
        axes.plot(*points[-1], "D", color=colour, markersize=5, markeredgecolor="white")
    for x, label in ((-1, "a"), (1, "b")):
        axes.plot(x, 0, "*", color=INK, markersize=10, zorder=3)
        if has_labels:
            axes.annotate(label, (x, 0), (0, -14), textcoords="offset points", ha="center", fontsize=9, color=INK)
    axes.set(xlim=(-2.1, 2.1), ylim=(-2.1, 2.1), aspect="equal")
