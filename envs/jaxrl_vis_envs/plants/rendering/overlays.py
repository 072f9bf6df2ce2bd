"""Lens flare, repeated borders, and lines, rectangles and text drawn over an image. NumPy and Pillow only."""

import colorsys

import numpy as np
from PIL import Image, ImageDraw

_WORDS = ("stalk 1", "0.87", "ROI", "frame 120", "2023-07-14 10:32:08", "A", "Fig. 3", "L = 21 mm")


def add_flare(radiance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add lens flare: a glow around a bright point above, its veil over the image, streaks, and ghosts through the centre.

    Args:
        radiance: [H, W, 3] float32, linear.
        rng: Random number generator.

    Returns:
        [H, W, 3] float32.
    """
    height, width = radiance.shape[:2]
    size = max(height, width)
    x, y = np.arange(width, dtype=np.float32)[None, :] / size, np.arange(height, dtype=np.float32)[:, None] / size
    sun = np.array([rng.uniform(-0.1, 1.1) * width, rng.uniform(-0.15, 0.5) * height]) / size
    distance = np.hypot(x - sun[0], y - sun[1])
    glow = rng.uniform(0.3, 4.0) * np.exp(-distance / rng.uniform(0.03, 0.25)) + rng.uniform(0.0, 0.4)
    angle = np.arctan2(y - sun[1], x - sun[0])
    glow *= 1.0 + rng.uniform(0.0, 0.5) * np.cos(rng.integers(3, 10) * angle + rng.uniform(0, 6)) ** 8
    light = glow[..., None] * np.array([1.0, rng.uniform(0.85, 1.0), rng.uniform(0.6, 1.0)], np.float32)
    middle = np.array([width, height]) / (2 * size)
    for _ in range(rng.integers(0, 6)):
        place = sun + rng.uniform(0.3, 2.2) * (middle - sun)
        disc = np.hypot(x - place[0], y - place[1]) < rng.uniform(0.01, 0.06)
        light[disc] += rng.uniform(0.02, 0.3) * np.array(colorsys.hsv_to_rgb(rng.random(), 0.6, 1.0))
    return radiance + light * float(radiance.mean())


def replicate_border(image: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Replace a strip at one side of an image [H, W, 3] by its neighbourhood, mirrored or repeated.

    Returns:
        The image, and a mask [H, W] bool, False in the strip.
    """
    turns = int(rng.integers(4))
    values = np.rot90(image, turns).copy()
    width = image.shape[1 - turns % 2]
    shown = np.ones(values.shape[:2], bool)
    strip = max(round(rng.uniform(0.005, 0.06) * width), 1)
    beside = values[:, strip : 2 * strip][:, ::-1] if rng.random() < 0.5 else values[:, strip : strip + 1]
    values[:, :strip], shown[:, :strip] = beside, False
    return np.rot90(values, -turns), np.rot90(shown, -turns)


def draw_overlay(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw annotations over an image [H, W, 3] uint8: lines, rectangles, a grid of upright lines, arrows, text."""
    height, width = image.shape[:2]
    canvas = Image.fromarray(image)
    pen = ImageDraw.Draw(canvas)
    pure = [tuple(255 * (number >> bit & 1) for bit in range(3)) for number in range(8)]
    colour, thick = pure[rng.integers(8)], int(rng.integers(1, 2 + width // 150))

    def point() -> tuple[float, float]:
        return float(rng.uniform(0, width)), float(rng.uniform(0, height))

    for _ in range(rng.integers(1, 9)):
        kind = rng.choice(["line", "upright", "rectangle", "text", "grid"], p=[0.25, 0.3, 0.25, 0.15, 0.05])
        (x, y), (u, v) = point(), point()
        if rng.random() < 0.3:
            colour = pure[rng.integers(8)]
        if kind == "line":
            pen.line([(x, y), (u, v)], fill=colour, width=thick)
        elif kind == "upright":
            pen.line([(x, y), (x + rng.normal(0.0, 0.02) * width, v)], fill=colour, width=thick)
        elif kind == "rectangle":
            box = (min(x, u), min(y, v), max(x, u), max(y, v))
            pen.rectangle(box, outline=colour, width=thick)
        elif kind == "text":
            pen.text((x, y), str(rng.choice(_WORDS)), fill=colour, font_size=float(rng.uniform(0.015, 0.06) * height))
        else:
            step = rng.uniform(0.02, 0.2) * width
            for column in np.arange(step, width, step):
                pen.line([(column, 0), (column, height)], fill=colour, width=1)
    return np.asarray(canvas)
