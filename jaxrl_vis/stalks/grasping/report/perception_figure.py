"""Figure 4.4 of the thesis for a synthetic run: painted image, point cloud, heat map of a slice, and grasp points."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxrl_vis.stalks.grasping.evaluation.scoring import Scene, draw_scene, driven_stretch
from jaxrl_vis.stalks.grasping.perception.lines import PREFERRED
from jaxrl_vis.stalks.grasping.perception.perceive import Mask, Perception, perceive
from jaxrl_vis.stalks.grasping.perception.slices import CELL, THICKNESS, slice_at
from jaxrl_vis_envs.plants import Family

_MAX_POINTS = 20_000  # points plotted per cloud
_LOW, _HIGH = (-0.95, 0.3, 0.2), (0.55, 0.95, 1.4)  # m: corners of the plotted box
_INK = "#333333"


def draw_figure(out: Path, family: Family, seed: int, mask: Mask | None, name: str) -> Perception:
    """Render and perceive a synthetic run, and write the figure.

    Args:
        out: Path of the figure, .png, .pdf or .svg.
        family: Family that the row is sampled from.
        seed: Seed of the row.
        mask: Function that returns the mask of an image; None for true masks.
        name: Name of the masks, for the title.

    Returns:
        The perception of the run.

    Raises:
        OSError: The file cannot be written.
    """
    scene = draw_scene(family, seed)
    find = mask or (lambda image, number: scene.masks[number])
    perception = perceive(scene.views, find, scene.drive.stated, scene.mount)
    figure = Figure(figsize=(13.0, 8.6), facecolor="white", layout="constrained")
    figure.suptitle(f"From a stereo pair to grasp points (simulated; family {family.name}, seed {seed}, masks: {name})")
    # The constrained layout ignores the labels of 3D axes, so ``wspace`` leaves room for them.
    grid = figure.add_gridspec(2, 3, width_ratios=(1.0, 1.0, 1.25), wspace=0.1)
    _draw_image(figure.add_subplot(grid[0, 0]), scene, perception)
    points = np.concatenate([motion(cloud.all_points()) for motion, cloud in zip(perception.to_last, perception.clouds)])
    red = perception.stalk_points()
    _draw_cloud(figure.add_subplot(grid[0, 1], projection="3d"), points, red, "(a) stitched cloud, stalks in red")
    _draw_cloud(figure.add_subplot(grid[1, 0], projection="3d"), None, red, "(b) after the threshold")
    _draw_slice(figure.add_subplot(grid[0, 2]), figure.add_subplot(grid[1, 2]), red, scene, perception)
    _draw_cloud(figure.add_subplot(grid[1, 1], projection="3d"), None, red, "(d) grasp points", perception)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=130)
    return perception


def _draw_image(axes: Any, scene: Scene, perception: Perception) -> None:
    image = scene.views[-1].left.copy()
    image[perception.clouds[-1].mask] = (255, 0, 0)
    axes.imshow(image)
    axes.set_title("last left image, painted")
    axes.set_axis_off()


def _draw_cloud(
    axes: Any, points: np.ndarray | None, red: np.ndarray, title: str, perception: Perception | None = None
) -> None:
    rng = np.random.default_rng(0)
    if points is not None:
        x, y, z = _limit_points(points)[rng.integers(len(_limit_points(points)), size=_MAX_POINTS)].T
        axes.scatter(x, y, z, s=0.8, c="#6f8f5a", alpha=0.5, linewidths=0)
    if len(red):
        x, y, z = _limit_points(red)[rng.integers(len(_limit_points(red)), size=_MAX_POINTS)].T
        pale = perception is not None
        axes.scatter(x, y, z, s=0.6, c="#e8b0b0" if pale else "#d62728", linewidths=0)
    if perception is not None and perception.points:
        x, y, z = np.array([point.point for point in perception.points]).T
        axes.scatter(x, y, z, s=40, c="#b01010", depthshade=False)
    limits = dict(zip(("xlim", "ylim", "zlim"), zip(_LOW, _HIGH)))
    axes.set(xlabel="along the row, m", ylabel="away, m", title=title, **limits)
    axes.set_zlabel("height, m", labelpad=-2)
    axes.set(xticks=(-0.8, -0.4, 0.0, 0.4), yticks=(0.4, 0.8), zticks=(0.4, 0.8, 1.2))
    axes.set_box_aspect((1.5, 0.65, 1.2), zoom=0.95)
    axes.view_init(elev=12, azim=-75)


def _limit_points(points: np.ndarray) -> np.ndarray:
    """Return the points [N, 3] within the limits of the axes."""
    return points[((points > _LOW) & (points < _HIGH)).all(axis=1)]


def _draw_slice(above: Any, below: Any, red: np.ndarray, scene: Scene, perception: Perception) -> None:
    """Draw the heat map of a slice ``above``, and its regions with their centres and those of the true stalks ``below``."""
    slice_ = slice_at(red, PREFERRED - 0.5 * THICKNESS)
    size = np.array(slice_.heat.shape) * CELL
    low, high = slice_.corner, slice_.corner + size
    extent = (low[0], high[0], low[1], high[1])
    above.imshow(slice_.heat.T, origin="lower", extent=extent, cmap="magma", interpolation="nearest")
    above.set(title=f"(c) slice {slice_.low:.2f} to {slice_.low + THICKNESS:.2f} m high: density", ylabel="away, m")
    shown = np.where(slice_.regions > 0, (slice_.regions * 7) % 20 + 1, 0).astype(float)
    shown[slice_.regions == 0] = np.nan
    below.imshow(shown.T, origin="lower", extent=extent, cmap="tab20", interpolation="nearest")
    true, inside = [], driven_stretch(scene.plot)
    for stalk in scene.plot.measured:
        middle = stalk.at_height(PREFERRED)[0]
        if inside[0] <= middle[0] <= inside[1]:
            true.append(scene.mount.pose.to_world(scene.drive.poses[-1].to_camera(middle)))
    x, y, _ = np.array(true).reshape(-1, 3).T
    below.plot(x, y, "o", ms=9, mfc="none", mec=_INK, label="true stalks of the stretch")
    x, y, _ = slice_.middles.T
    below.plot(x, y, "x", ms=6, c="black", label="middles of regions (thesis)")
    middles = np.array([point.at_height(PREFERRED) for point in perception.points]).reshape(-1, 3)
    below.plot(middles[:, 0], middles[:, 1], "+", ms=9, c="#b01010", label="lines of several pairs (default)")
    below.set(title="regions and middles", xlabel="along the row, m", ylabel="away, m")
    for axes in (above, below):
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    below.legend(loc="upper center", bbox_to_anchor=(0.5, -0.28), fontsize=8)
