"""Quadratic example of OL-AUX (Lin et al., 2019): adaptive weights of three losses of a point in the plane.

    main        x^2 + y^2
    shifted     (x - 1/2)^2 + (y - 1/2)^2, helpful far from the main minimum and misleading near it
    opposed     minus the main loss, always misleading

Weights start at 1 and follow the authors' rule for this example after every step, on the losses themselves: w_i <- w_i + beta
<w_i g_i, g_main>, unbounded. With constant weights of 1, main and opposed cancel, and every path ends in the minimum of the
shifted loss.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxrl_vis.report.plots import FAINT, INK
from jaxrl_vis.weighting import MAIN, Weighting, make_weighting, weighted_grad

STARTS = ((-0.8, -1.6), (1.8, 1.0), (-1.8, 1.0), (1.0, -1.0))
STEPS = 1000
STEP_SIZE = 0.01  # alpha and beta
AUXILIARY = ("shifted", "opposed")

_COLOURS = ("#0f7b6c", "#b4531f", "#3b5bdb", "#a61e8c")  # one per start
_STYLES = {"shifted": "-", "opposed": (0, (4, 3))}


class Paths(NamedTuple):
    """Paths of gradient descent from all starts.

    Attributes:
        points: [4, STEPS + 1, 2] float32, x and y.
        weights: name -> [4, STEPS + 1] float32.
    """

    points: np.ndarray
    weights: dict[str, np.ndarray]


def losses(point: jax.Array) -> dict[str, jax.Array]:
    """Compute the three losses of a point [2]."""
    main = jnp.sum(jnp.square(point))
    return {MAIN: main, "shifted": jnp.sum(jnp.square(point - 0.5)), "opposed": -main}


def authors_rule() -> Weighting:
    """Build the authors' weighting for this example: OL-AUX-1 on the losses themselves, multiplicative and unbounded."""
    return make_weighting("ol_aux", interval=1, learning_rate=1.0, beta=STEP_SIZE, log=False, minimum=None, multiplicative=True)


def descend(weighting: Weighting) -> Paths:
    """Run gradient descent from all `STARTS` in parallel, with `STEPS` steps; return the paths."""
    gradient = weighted_grad(losses, weighting)
    names = (MAIN, *AUXILIARY)

    def path(start: jax.Array):
        def step(carry, _):
            point, state = carry
            result = gradient(point, state)
            return (point - STEP_SIZE * result.gradient, result.state), carry

        first = (start, weighting.init(names, start))
        last, rest = jax.lax.scan(step, first, length=STEPS)
        points, state = jax.tree.map(lambda steps, end: jnp.concatenate([steps, end[None]]), rest, last)
        return points, {name: state.weights[name] for name in AUXILIARY}

    points, weights = jax.jit(jax.vmap(path))(jnp.array(STARTS))
    return Paths(np.asarray(points), {name: np.asarray(weights[name]) for name in AUXILIARY})


def draw(path: Path) -> None:
    """Write a figure of the paths with fixed and adaptive weights, and of the weights.

    Args:
        path: Path of the file, .png or any other format that Matplotlib can write.
    """
    fixed, adaptive = descend(make_weighting("sum")), descend(authors_rule())
    figure = Figure(figsize=(13.5, 4.9), dpi=110, facecolor="white")
    left, middle, right = figure.subplots(1, 3, width_ratios=[1, 1, 1.1])
    _draw_paths(left, fixed, "Weights stay at 1")
    _draw_paths(middle, adaptive, "Weights adapt")
    _draw_weights(right, adaptive)
    figure.text(0.045, 0.95, "Gradient descent on three losses", fontsize=14, weight="bold", color=INK, va="center")
    subtitle = "main $x^2 + y^2$ (contours), the same shifted to (½, ½), and its opposite; OL-AUX on the losses as they are"
    figure.text(0.045, 0.89, subtitle, fontsize=10, color=FAINT, va="center")
    figure.subplots_adjust(left=0.045, right=0.985, bottom=0.11, top=0.79, wspace=0.17)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _style(axes: Axes, title: str) -> None:
    axes.set_title(title, loc="left", fontsize=11, color=INK, pad=8)
    axes.tick_params(colors=FAINT, labelcolor=INK, length=0, labelsize=9)
    for side in axes.spines.values():
        side.set_color("#c9cdd3")


def _draw_paths(axes: Axes, paths: Paths, title: str) -> None:
    _style(axes, title)
    grid = np.linspace(-2.1, 2.1, 200)
    x, y = np.meshgrid(grid, grid)
    axes.contour(x, y, x**2 + y**2, levels=np.arange(0.25, 9, 0.75), colors="#d5d9de", linewidths=0.8)
    for points, colour in zip(paths.points, _COLOURS, strict=True):
        axes.plot(*points.T, color=colour, linewidth=2)
        axes.plot(*points[0], "o", color=colour, markersize=6)
        axes.plot(*points[-1], "D", color=colour, markersize=6, markeredgecolor="white")
    axes.plot(0, 0, "*", color=INK, markersize=11, zorder=0)
    axes.annotate("main", (0, 0), (-6, -11), textcoords="offset points", ha="right", fontsize=9, color=INK)
    axes.plot(0.5, 0.5, "*", color=FAINT, markersize=11, zorder=0)
    axes.annotate("shifted", (0.5, 0.5), (10, -5), textcoords="offset points", fontsize=9, color=FAINT)
    axes.set(xlim=(-2.1, 2.1), ylim=(-2.1, 2.1), aspect="equal")


def _draw_weights(axes: Axes, paths: Paths) -> None:
    _style(axes, "The weights that adapt")
    for name, values in paths.weights.items():
        for series, colour in zip(values, _COLOURS, strict=True):
            axes.plot(series, color=colour, linewidth=1.8, linestyle=_STYLES[name])
        axes.plot([], [], color=INK, linewidth=1.8, linestyle=_STYLES[name], label=name)
    axes.legend(frameon=False, fontsize=9.5)
    axes.grid(axis="y", color="#e6e8eb", linewidth=0.8)
    axes.set(xlim=(0, STEPS), ylim=(0, None))
    axes.set_xlabel("step", fontsize=9.5, color=INK)
