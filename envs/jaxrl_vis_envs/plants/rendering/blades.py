"""Blades of grass on the ground of daytime plots: upright strips that resemble stalks. NumPy and Pillow only."""

import dataclasses

import numpy as np
from PIL import Image, ImageDraw

from jaxrl_vis_envs.plants.rendering.surfaces import GROUND

_MIN_DEPTH = 0.15
"""Minimum depth of a rendered blade, m."""


@dataclasses.dataclass(frozen=True)
class Blades:
    """Blades of grass of a plot.

    Attributes:
        points: [B, 3, 3] float64, base, middle and tip in the world, m.
        width: [B] float64, width at the base, m.
        tint: [B, 3] float64, colour relative to that of the ground around the base.
    """

    points: np.ndarray
    width: np.ndarray
    tint: np.ndarray


def sample_blades(rng: np.random.Generator, length: float, distance: float) -> Blades:
    """Sample the blades around a row from x = 0 to ``length`` and y = 0, seen from y = -``distance`` (m)."""
    low, high = np.array([-2.0, -distance + 0.25]), np.array([length + 2.0, 3.0])
    count = int(np.exp(rng.uniform(np.log(50.0), np.log(500.0))) * np.prod(high - low))
    base = np.concatenate([rng.uniform(low, high, (count, 2)), np.zeros((count, 1))], axis=1)
    tall = np.exp(rng.uniform(np.log(0.02), np.log(0.12)) + 0.4 * rng.normal(size=count))
    lean = 0.5 * tall[:, None] * rng.normal(size=(count, 2))
    middle = base + np.concatenate([0.3 * lean, 0.6 * tall[:, None]], axis=1)
    tip = base + np.concatenate([lean, tall[:, None]], axis=1)
    dry = rng.random(count) < rng.uniform(0.0, 0.4)
    tint = np.exp(0.35 * rng.normal(size=(count, 1)) + 0.1 * rng.normal(size=(count, 3)))
    tint = rng.uniform(0.8, 1.6) * tint * np.where(dry[:, None], [1.5, 1.2, 0.8], 1.0)
    return Blades(np.stack([base, middle, tip], axis=1), rng.uniform(0.002, 0.006, count), tint)


def render_blades(
    radiance: np.ndarray,
    instance: np.ndarray,
    depth: np.ndarray,
    blades: Blades,
    camera: tuple[np.ndarray, np.ndarray, float, tuple[float, float]],
) -> np.ndarray:
    """Render blades into an image, where they occlude its surfaces.

    Args:
        radiance: [H, W, 3] float32, linear.
        instance: [H, W] int32, see `surfaces`.
        depth: [H, W] float32, planar, m.
        blades: Blades of the plot.
        camera: Position [3] (m) and rotation [3, 3], as in a `Pose`; focal length and principal point, pixels.

    Returns:
        Radiance [H, W, 3] float32 with the blades. Instance and depth images are not changed: blades are not in them.
    """
    position, rotation, focal, centre = camera
    in_camera = (blades.points - position) @ rotation.T
    there = np.flatnonzero(in_camera[:, :, 2].min(axis=1) > _MIN_DEPTH)
    there = there[np.argsort(-in_camera[there, 0, 2])]
    across = in_camera[there, :, :2] / in_camera[there, :, 2:] * focal + np.array(centre)
    half = np.maximum(0.5 * focal * blades.width[there] / in_camera[there, 0, 2], 0.3)
    sideways = half[:, None] * rotation[:2, 0]  # a blade's width is horizontal in the world, also where the camera is rolled
    base, middle, tip = across[:, 0], across[:, 1], across[:, 2]
    corners = base - sideways, middle - 0.7 * sideways, tip, middle + 0.7 * sideways, base + sideways
    outline = np.stack(corners, axis=1).reshape(len(there), 10)
    height, width = instance.shape
    # Blades are drawn from far to near, so that each pixel has the index of the nearest one.
    canvas = Image.new("I", (width, height), 0)
    pen = ImageDraw.Draw(canvas)
    for index, polygon in enumerate(outline.tolist(), start=1):
        pen.polygon(polygon, fill=index)
    nearest = np.asarray(canvas)
    row, column = np.nonzero(nearest)
    blade = nearest[row, column] - 1
    shown = in_camera[there[blade], 0, 2] < depth[row, column]
    row, column, blade = row[shown], column[shown], blade[shown]
    colours = _ground_at(radiance, instance, base) * blades.tint[there]
    covered = np.array(radiance)
    covered[row, column] = colours[blade]
    return covered


def _ground_at(radiance: np.ndarray, instance: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the radiance [B, 3] of the ground at pixels (column, row) [B, 2]; its median where it is not visible."""
    ground = instance == GROUND
    median = np.median(radiance[ground], axis=0) if ground.any() else np.zeros(3)
    column, row = np.round(pixels).astype(int).T
    height, width = instance.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    row, column = np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)
    own = (inside & ground[row, column])[:, None]
    return np.where(own, radiance[row, column], median)
