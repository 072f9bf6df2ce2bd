"""Figure 4.5: planned and actual path of the grip to a stalk, seen from above and as height and error over time."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from jaxrl_vis.report.plots import FAINT, INK
from jaxrl_vis.stalks.grasping.arm import control
from jaxrl_vis.stalks.grasping.arm.reach import ReachResult
from jaxrl_vis_envs.plants.stand import Stands
from jaxrl_vis_envs.tasks import stalk_arm

_HALF_WIDTH = 0.45  # m, half the length of the row that is shown
_PLANNED, _TAKEN, _HELD, _STALK = "#2b6cb0", "#dd6b20", "#2f855a", "#a0aec0"


def draw_path(path: Path, stands: Stands, targets: np.ndarray, result: ReachResult, index: int = 0) -> None:
    """Write the figure of one reach.

    Args:
        path: A .png, or any other format that matplotlib can write.
        stands: Stands of the reaches.
        targets: [B, 3], targets of the reaches, m in the plot's frame.
        result: Results of the reaches.
        index: Index of the reach to draw.

    Raises:
        OSError: The file cannot be written.
    """
    figure = Figure(figsize=(9.0, 5.4), dpi=150, facecolor="white")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.2, 1), hspace=0.35, wspace=0.25)
    grid.update(top=0.84, bottom=0.1, left=0.08, right=0.97)
    plane = figure.add_subplot(grid[:, 0])
    planned, taken = result.path[index], result.taken[index]
    origin, target = stands.origin[index], np.asarray(targets)[index]
    _draw_plane(plane, stands, result, index, target)
    seconds = result.interval * np.arange(1, len(planned) + 1)
    above = figure.add_subplot(grid[0, 1])
    above.plot(seconds, planned[:, 2], color=_PLANNED, linewidth=2.5, alpha=0.6)
    above.plot(seconds, taken[:, 2], color=_TAKEN, linewidth=1.2)
    above.set_ylabel("height, m")
    apart = figure.add_subplot(grid[1, 1])
    apart.plot(seconds, 1000 * np.linalg.norm(planned - taken, axis=-1), color=_TAKEN, linewidth=1.5)
    apart.set_ylabel("distance of the two, mm")
    apart.set_xlabel("time, s")
    for axes in (above, apart):
        axes.axvline(control.Timing().reach, color=FAINT, linewidth=0.8, linestyle=":")
        axes.grid(alpha=0.25)
    held = sorted(int(stalk) for stalk in stands.stalk[index][result.held[index]])
    holds = f"the jaws hold {', '.join(f'stalk {stalk}' for stalk in held) or 'nothing'}"
    figure.text(0.03, 0.955, "Planned path and path taken", fontsize=14, weight="bold", color=INK, va="center")
    error = (
        f"{1000 * result.error[index]:.1f} mm off when the jaws close" if result.reachable[index] else "out of reach: not sent"
    )
    figure.text(
        0.03, 0.905, f"Simulated. Mast {origin[0]:.2f} m along the row; {error}; {holds}.", fontsize=9, color=FAINT, va="center"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _draw_plane(axes: Axes, stands: Stands, result: ReachResult, index: int, target: np.ndarray) -> None:
    """Draw the view from above at the target's height: stalks, the arm at the end of the reach, and both paths."""
    origin = stands.origin[index]
    knee, top = stands.knee[index], stands.top[index]
    fraction = (target[2] - knee[:, 2]) / (top[:, 2] - knee[:, 2])
    places = knee + fraction[:, None] * (top - knee) + origin
    radii, is_present = stands.radius[index, :, 1], stands.is_present[index]
    for place, radius, is_held, is_there in zip(places, radii, result.held[index], is_present):
        if is_there:
            axes.add_patch(Circle(place[:2], radius, color=_HELD if is_held else _STALK))
    planned, taken = result.path[index], result.taken[index]
    axes.plot(planned[:, 0], planned[:, 1], color=_PLANNED, linewidth=3, alpha=0.5, label="planned")
    axes.plot(taken[:, 0], taken[:, 1], color=_TAKEN, linewidth=1.2, label="taken")
    shoulder = origin[:2] + stalk_arm.SHOULDER
    angles = result.poses[index, -1, 1:3]
    elbow = shoulder + stalk_arm.UPPER_ARM * np.array([-np.sin(angles[0]), np.cos(angles[0])])
    axes.plot(*np.stack([shoulder, elbow, taken[-1, :2]], axis=1), color=INK, linewidth=4, alpha=0.25, marker="o")
    axes.plot(*target[:2], "+", color=INK, markersize=9, label="target")
    axes.set_aspect("equal")
    axes.set_xlim(origin[0] - _HALF_WIDTH, origin[0] + _HALF_WIDTH)
    axes.set_xlabel("along the row, m")
    axes.set_ylabel("across the row, m")
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=9, loc="lower right")
