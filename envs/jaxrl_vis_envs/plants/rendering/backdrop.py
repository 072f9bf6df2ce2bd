"""Backdrops of daytime plots, beyond the ground. NumPy and Pillow only.

A backdrop is an image in azimuth and tangent of the elevation, infinitely far away, in the units of the renderer's radiance.
"""

import importlib.util
import math
from pathlib import Path

import numpy as np
from PIL import Image

SHAPE = (768, 1536)
"""Height and width of a backdrop, pixels."""
REACH = (1.6, 2.0)
"""Maximum tangent of the elevation, and maximum azimuth in rad, to either side."""
_HORIZON = SHAPE[0] // 2
_LEVELS = 1024  # of smooth noise
_PHOTOGRAPHS = (("skimage", "data"), ("sklearn", "datasets/images"))


def sample_backdrop(rng: np.random.Generator, indoors: bool, photograph: bool, sky: float, glare: float = 1.0) -> np.ndarray:
    """Sample a backdrop.

    Args:
        rng: Random number generator.
        indoors: Sample a wall and a ceiling instead of the sky and a skyline.
        photograph: Use a photograph shipped with an installed package instead; takes precedence over ``indoors``.
        sky: Light of the sky on a white surface, which scales the radiance.
        glare: Factor of the radiance of the sky outdoors alone: large for a white sky, small for a dark one.

    Returns:
        [*SHAPE, 3] float32 radiance.

    Raises:
        ValueError: ``photograph`` is True, and no package that ships photographs is installed.
    """
    if photograph:
        return (_photograph(rng) * sky * rng.uniform(0.6, 1.6)).astype(np.float32)
    picture = _room(rng) if indoors else _outdoors(rng, glare)
    return (picture * sky).astype(np.float32)


def smooth_noise(rng: np.random.Generator, size: tuple[float, float], shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """Sample smooth noise, uniformly distributed in 0 to 1: [*shape] float64.

    Args:
        rng: Random number generator.
        size: Height and width of the features, pixels.
        shape: Height and width of the result, pixels.
    """
    spacing = [min(max(0.6 * length, 1.0), count) for length, count in zip(size, shape)]
    cells = [math.ceil(count / step) + 3 for count, step in zip(shape, spacing)]
    left, top = rng.uniform(0.0, 2.0, 2)
    box = (left, top, left + shape[1] / spacing[1], top + shape[0] / spacing[0])
    coarse = Image.fromarray(rng.normal(size=cells).astype(np.float32))
    values = np.asarray(coarse.resize((shape[1], shape[0]), Image.Resampling.BICUBIC, box))
    # Ranks by histogram are as good as exact ones here, and much faster.
    span = max(float(np.ptp(values)), 1e-6)
    level = ((values - values.min()) * ((_LEVELS - 1) / span)).astype(np.int32)
    ranks = np.cumsum(np.bincount(level.ravel(), minlength=_LEVELS)) / values.size
    return ranks[level]


def _outdoors(rng: np.random.Generator, glare: float) -> np.ndarray:
    """Sample a sky with clouds, a ground, and one to three of: trees, a building, a crop's canopy, trunks."""
    elevation = ((_HORIZON - np.arange(SHAPE[0])) / _HORIZON * REACH[0])[:, None, None]
    zenith = np.array([0.25, 0.45, 0.95]) * rng.uniform(0.5, 1.3)
    haze = np.array([0.85, 0.92, 1.0]) * rng.uniform(0.7, 1.6)
    fraction = np.exp(-np.clip(elevation, 0.0, None) / rng.uniform(0.15, 0.8))
    picture = zenith + (haze - zenith) * fraction
    cover = rng.uniform(0.0, 1.0)
    clouds = 0.6 * smooth_noise(rng, (30, 90)) + 0.4 * smooth_noise(rng, (10, 25))
    thick = np.clip((clouds - (1.0 - cover)) / 0.25, 0.0, 1.0)[..., None]
    picture = picture + (np.array([1.0, 1.0, 1.02]) * rng.uniform(0.7, 1.8) - picture) * thick
    picture = picture * glare
    below = np.where(rng.random() < 0.5, [0.05, 0.08, 0.03], [0.14, 0.11, 0.08]) * rng.uniform(0.5, 1.5)
    picture = np.where(elevation < 0, below * (0.6 + 0.8 * smooth_noise(rng, (4, 10))[..., None]), picture)
    layers = rng.choice(
        ["trees", "building", "canopy", "trunks"], rng.integers(1, 4), replace=False, p=[0.35, 0.35, 0.12, 0.18]
    )
    for layer in layers:
        picture = {"trees": _trees, "building": _building, "canopy": _canopy, "trunks": _trunks}[layer](rng, picture)
    return picture


def _skyline(rng: np.random.Generator, height: float, roughness: tuple[float, float]) -> np.ndarray:
    """Sample a mask [*SHAPE] bool from the horizon up to an uneven skyline with a mean tangent of about ``height``."""
    line = sum(smooth_noise(rng, (1, size), (1, SHAPE[1]))[0] * weight for size, weight in zip((8, 60), roughness))
    top = _HORIZON * (1.0 - height * (0.5 + line) / REACH[0])
    rows = np.arange(SHAPE[0])[:, None]
    return (rows >= top) & (rows < _HORIZON + 12)


def _trees(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    mask = _skyline(rng, rng.uniform(0.04, 0.4), (0.35, 0.65))
    leaves = np.array([0.06, 0.10, 0.03]) * rng.uniform(0.5, 2.5) * rng.uniform(0.8, 1.2, 3)
    texture = 0.3 + 1.4 * smooth_noise(rng, (3, 3)) * smooth_noise(rng, (14, 14))
    return np.where(mask[..., None], leaves * texture[..., None], picture)


def _building(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    left, wide = rng.integers(0, SHAPE[1] - 100), rng.integers(60, 700)
    top = int(_HORIZON * (1.0 - rng.uniform(0.05, 0.5) / REACH[0]))
    part = picture[top : _HORIZON + 6, left : left + wide]
    colour = rng.uniform(0.15, 0.9) * rng.uniform(0.85, 1.15, 3)
    columns = np.arange(part.shape[1])
    ribs = 1.0 + rng.uniform(0.0, 0.5) * np.sin(2 * np.pi * columns / rng.uniform(3, 16))
    picture = picture.copy()
    picture[top : _HORIZON + 6, left : left + wide] = (
        colour * ribs[None, :, None] * (0.9 + 0.2 * smooth_noise(rng, (20, 20), part.shape[:2])[..., None])
    )
    return picture


def _canopy(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    """Paste the canopy of a distant crop: leaves, upright streaks, and gaps that show what is behind."""
    mask = _skyline(rng, rng.uniform(0.3, 1.4), (0.5, 0.3))
    mask[_HORIZON : _HORIZON + 60] = True
    green = np.array([0.10, 0.16, 0.04]) * rng.uniform(0.5, 1.8) * rng.uniform(0.8, 1.2, 3)
    dry = np.array([0.30, 0.24, 0.14]) * rng.uniform(0.5, 1.5)
    ripe = np.clip(smooth_noise(rng, (20, 5)) + rng.uniform(-0.7, 0.7), 0.0, 1.0)[..., None]
    streaks = 0.25 + 1.5 * smooth_noise(rng, (rng.uniform(15, 80), rng.uniform(3, 9)))
    leaves = 0.4 + 0.8 * smooth_noise(rng, (8, 14)) + 0.4 * smooth_noise(rng, (3, 5))
    texture = (streaks * leaves)[..., None]
    gaps = (smooth_noise(rng, (rng.uniform(12, 40), rng.uniform(6, 16))) < rng.uniform(0.0, 0.3)) & mask
    colours = (green + (dry - green) * ripe) * texture
    return np.where((mask & ~gaps)[..., None], colours, picture)


def _trunks(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    """Paste 3 to 39 trunks or poles, 1.5 to 20 pixels wide, of random brightness and with a small random lean."""
    picture = picture.copy()
    for _ in range(rng.integers(3, 40)):
        wide, at = 1.5 * (20 / 1.5) ** rng.random(), rng.uniform(0, SHAPE[1])
        top = int(_HORIZON * (1.0 - rng.uniform(0.1, 1.5) / REACH[0]))
        bottom = _HORIZON + rng.integers(2, 40)
        colour = rng.uniform(0.03, 0.6) * np.array([1.0, rng.uniform(0.8, 1.0), rng.uniform(0.6, 1.0)])
        lean = rng.normal(0.0, 0.03)
        rows, sway = np.arange(max(top, 0), bottom), abs(lean) * SHAPE[0]
        columns = np.arange(max(int(at - wide - sway), 0), min(int(at + wide + sway) + 1, SHAPE[1]))
        offset = (columns - at - lean * (rows[:, None] - _HORIZON)) / (0.5 * wide)
        shade = np.clip(1.0 - offset**2, 0.0, 1.0)
        light = 0.5 + 0.8 * np.sqrt(shade) * (0.8 + 0.4 * rng.random(shade.shape))
        part = picture[rows[0] : bottom, columns[0] : columns[-1] + 1]
        part[shade > 0] = (colour * light[..., None])[shade > 0]
    return picture


def _room(rng: np.random.Generator) -> np.ndarray:
    """Sample a wall and a ceiling, with rectangles as lamps and furniture."""
    picture = np.ones((*SHAPE, 3)) * rng.uniform(0.2, 0.9) * rng.uniform(0.9, 1.1, 3)
    ceiling = int(_HORIZON * (1.0 - rng.uniform(0.3, 1.0) / REACH[0]))
    picture[:ceiling] *= rng.uniform(0.3, 1.0)
    for _ in range(rng.integers(5, 40)):
        is_lamp = rng.random() < 0.25
        row = rng.integers(0, ceiling + 1) if is_lamp else rng.integers(ceiling, _HORIZON + 80)
        column, tall, wide = rng.integers(0, SHAPE[1]), rng.integers(4, 60), rng.integers(4, 160)
        colour = np.full(3, rng.uniform(2.0, 6.0)) if is_lamp else rng.uniform(0.02, 0.9) * rng.uniform(0.6, 1.2, 3)
        picture[row : row + tall, column : column + wide] = colour
    return picture * (0.85 + 0.3 * smooth_noise(rng, (80, 120))[..., None])


def _photograph(rng: np.random.Generator) -> np.ndarray:
    """Sample a crop of an installed photograph, mirrored with probability 0.5: [*SHAPE, 3] in linear light, 0 to 1."""
    paths = photograph_files()
    if not paths:
        raise ValueError("scene.photographs needs photographs that packages ship: pip install scikit-image, or scikit-learn")
    with Image.open(paths[rng.integers(len(paths))]) as opened:
        photograph = np.asarray(opened.convert("RGB"))
    tall, wide = (int(length * rng.uniform(0.5, 1.0)) for length in photograph.shape[:2])
    row, column = rng.integers(0, photograph.shape[0] - tall + 1), rng.integers(0, photograph.shape[1] - wide + 1)
    part = Image.fromarray(photograph[row : row + tall, column : column + wide])
    part = part.resize((SHAPE[1], SHAPE[0]), Image.Resampling.BILINEAR)
    values = (np.asarray(part) / 255.0) ** 2.2
    return values[:, ::-1] if rng.random() < 0.5 else values


def photograph_files() -> list[Path]:
    """Return the paths of the photographs shipped with scikit-image and scikit-learn, in fixed order; empty without them."""
    paths = []
    for package, folder in _PHOTOGRAPHS:
        spec = importlib.util.find_spec(package)
        if spec is not None and spec.origin is not None:
            paths += sorted((Path(spec.origin).parent / folder).glob("*.jpg"))
    return paths
