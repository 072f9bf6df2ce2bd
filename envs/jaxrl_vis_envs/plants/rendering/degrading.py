"""Effects of simple cameras on images of daytime plots: white balance, low resolution, motion blur, JPEG, borders, overlays.

NumPy and Pillow only.
"""

import io

import numpy as np
from PIL import Image

from jaxrl_vis_envs.plants.rendering.overlays import draw_overlay, replicate_border
from jaxrl_vis_envs.plants.scene import Scene


def degrade(image: np.ndarray, scene: Scene, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Degrade an image as a simple camera does.

    Args:
        image: [H, W, 3] uint8.
        scene: Factors of the plot, after `settle`.
        rng: Random number generator; with equal seeds for both images of a pair, so that both are degraded alike.

    Returns:
        The degraded image [H, W, 3] uint8, and a mask [H, W] bool, False on black and repeated borders.
    """
    height, width = image.shape[:2]
    gains = np.exp(scene.white_balance * rng.normal(size=3) * [1.0, 0.2, 1.0])
    contrast = np.exp(0.12 * rng.normal())
    table = np.clip((np.arange(256) / 255.0)[:, None] ** contrast * gains ** (1 / 2.2), 0.0, 1.0)
    values = np.stack(
        [np.round(255.0 * table[:, channel]).astype(np.uint8)[image[..., channel]] for channel in range(3)], axis=2
    )
    values = _blur_motion(values, scene.motion[0] * width)
    scale = scene.resolution[0]
    small = Image.fromarray(values).resize((max(round(scale * width), 8), max(round(scale * height), 8)), Image.Resampling.BOX)
    packed = io.BytesIO()
    small.save(packed, "JPEG", quality=round(scene.jpeg[0]))
    with Image.open(packed) as opened:
        values = np.asarray(opened.resize((width, height), Image.Resampling.BILINEAR)).copy()
    shown = np.ones((height, width), bool)
    if rng.random() < scene.borders:
        shown = ~_border(rng, height, width)
        values[~shown] = 0
    if rng.random() < scene.replicated:
        values, beside = replicate_border(values, rng)
        shown &= beside
    if rng.random() < scene.overlay:
        values = draw_overlay(values, rng)
    return values, shown


def _blur_motion(image: np.ndarray, length: float) -> np.ndarray:
    """Apply horizontal motion blur over ``length`` pixels."""
    taps = round(length) + 1
    if taps < 2:
        return image
    padded = np.pad(image.astype(np.float32), ((0, 0), (taps // 2, taps - 1 - taps // 2), (0, 0)), mode="edge")
    sums = np.cumsum(np.pad(padded, ((0, 0), (1, 0), (0, 0))), axis=1, dtype=np.float64)
    return np.round((sums[:, taps:] - sums[:, :-taps]) / taps).astype(np.uint8)


def _border(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Sample a mask [H, W] bool of bars or wedges at one or two sides."""
    row, column = np.mgrid[0:height, 0:width]
    covered = np.zeros((height, width), bool)
    for _ in range(rng.integers(1, 3)):
        side, size = rng.integers(4), rng.uniform(0.01, 0.15)
        along, across = (row / height, column / width) if side < 2 else (column / width, row / height)
        across = across if side % 2 else 1.0 - across
        slope = rng.uniform(-1.0, 1.0) if rng.random() < 0.5 else 0.0
        bend = rng.uniform(-0.5, 0.5) if rng.random() < 0.3 else 0.0
        covered |= across < size * (1.0 + slope * (2 * along - 1) + bend * (2 * along - 1) ** 2)
    return covered
