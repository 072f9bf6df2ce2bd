"""Pictures of walls and fences, many of them with upright stripes: reflectance and opacity. NumPy and Pillow only."""

import colorsys
import math
from collections.abc import Callable

import numpy as np
from PIL import Image, ImageDraw

_WORDS = "NORTH FIELD STATION 12 PLOT 07 EXIT SAFETY FIRST LAB B DO NOT TOUCH SALE 50 SEED CO OPEN".split()


def sample_colour(rng: np.random.Generator) -> np.ndarray:
    """Sample the reflectance [3] of paint, metal, wood or masonry."""
    kind = rng.choice(["grey", "paint", "wood", "green"], p=[0.5, 0.15, 0.25, 0.1])
    value = 0.03 * (0.9 / 0.03) ** rng.random()
    hue, saturation = {
        "grey": (rng.random(), rng.uniform(0.0, 0.12)),
        "paint": (rng.random(), rng.uniform(0.15, 0.75)),
        "wood": (rng.uniform(0.05, 0.12), rng.uniform(0.2, 0.65)),
        "green": (rng.uniform(0.2, 0.4), rng.uniform(0.3, 0.8)),
    }[str(kind)]
    return np.array(colorsys.hsv_to_rgb(hue, saturation, value))


def paint_wall(rng: np.random.Generator, kind: str, size: tuple[float, float], texels: float) -> np.ndarray:
    """Paint a wall or fence.

    Args:
        rng: Random number generator.
        kind: One of `KINDS`, or ``plaster``, ``shelves``, ``board`` or ``ceiling``.
        size: Width and height, m.
        texels: Resolution, texels per m.

    Returns:
        [h, w, 4] float32, reflectance (above 1: a lamp) and opacity; row 0 is at the top.
    """
    wide, tall = size
    shape = max(round(tall * texels), 2), max(round(wide * texels), 2)
    x = (np.arange(shape[1], dtype=np.float32) + 0.5)[None, :] / texels
    y = tall - (np.arange(shape[0], dtype=np.float32) + 0.5)[:, None] / texels
    return _PAINTERS[kind](rng, x, y, texels).astype(np.float32)


def _solid(colour: np.ndarray, shade: np.ndarray, opacity: np.ndarray | float = 1.0) -> np.ndarray:
    picture = np.empty((*shade.shape, 4), np.float32)
    picture[..., :3] = shade[..., None] * colour.astype(np.float32)
    picture[..., 3] = opacity
    return picture


def _weather(rng: np.random.Generator, shape: tuple[int, ...], contrast: float) -> np.ndarray:
    """Sample stains, streaks and dirt as a factor [*shape] around 1."""
    cells = max(2, shape[0] // 60), max(2, shape[1] // int(rng.choice([12, 60])))
    coarse = Image.fromarray(rng.uniform(1 - contrast, 1 + contrast, cells).astype(np.float32))
    stains = np.asarray(coarse.resize((shape[1], shape[0]), Image.Resampling.BICUBIC))
    return stains * rng.uniform(1 - 0.3 * contrast, 1 + 0.3 * contrast, shape).astype(np.float32)


def _per_item(rng: np.random.Generator, number: np.ndarray, spread: float) -> np.ndarray:
    """Return a random factor around 1 for each item of an integer array, equal where the integers are."""
    factors = np.exp(spread * rng.normal(size=997)).astype(np.float32)
    return factors[number.astype(int) % 997]


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return low * (high / low) ** rng.random()


def _sheet(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, texels: float) -> np.ndarray:
    """Paint a ribbed or corrugated sheet: upright, level or leaning ribs of equal width, flat or curved, with seams."""
    pitch = max(_log(rng, 0.015, 0.35), 3.0 / texels)
    level = rng.random() < 0.2
    along, across = (x + 0 * y, y + 0 * x) if level else (y + 0 * x, x + 0 * y)
    if rng.random() < 0.35:  # over an arch
        across = across + rng.normal(0.0, 0.12) * along**2
    phase = across / pitch + rng.random()
    wave = np.sin(2 * math.pi * phase)
    edge = rng.uniform(0.1, 0.9)
    profile = str(rng.choice(["round", "box", "narrow"]))
    if profile == "box":
        wave = np.where(np.mod(phase, 1.0) < edge, 1.0, -1.0)
    elif profile == "narrow":  # a narrow rib between flat parts: light on one side, dark on the other
        inside = np.mod(phase, 1.0) / rng.uniform(0.08, 0.35)
        wave = np.where(inside < 1.0, np.sin(2 * math.pi * inside), 0.0)
    shade = 1.0 + rng.uniform(0.05, 0.6) * wave
    if rng.random() < 0.6:  # joints of the sheets
        sheet_width = rng.uniform(0.5, 1.5)
        shade = shade * np.where(np.mod(across, sheet_width) < max(0.008, 1.0 / texels), rng.uniform(0.1, 0.6), 1.0)
    if rng.random() < 0.4:
        shade = shade * (1.0 - rng.uniform(0.0, 0.7) * (along / along.max()) ** 2)  # the curve turns away from the light
    return _solid(sample_colour(rng), np.maximum(shade, 0.03) * _weather(rng, shade.shape, rng.uniform(0.0, 0.25)))


def _planks(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, texels: float) -> np.ndarray:
    """Paint planks, upright or level, with dark gaps and a shade each."""
    pitch = max(_log(rng, 0.03, 0.25), 4.0 / texels)
    across = (x if rng.random() < 0.75 else y) + 0 * x + 0 * y
    phase = across / pitch
    gap = np.mod(phase, 1.0) < max(rng.uniform(0.02, 0.15), 1.0 / texels / pitch)
    shade = np.where(gap, rng.uniform(0.05, 0.5), _per_item(rng, phase, rng.uniform(0.02, 0.35)))
    return _solid(sample_colour(rng), shade * _weather(rng, shade.shape, rng.uniform(0.05, 0.4)))


def _pickets(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, texels: float) -> np.ndarray:
    """Paint a fence of upright slats or bars of equal width and distance, with two or three rails and gaps."""
    wide = max(_log(rng, 0.012, 0.1), 2.0 / texels)
    pitch = wide * rng.uniform(1.2, 5.0)
    phase = np.mod(x, pitch) / wide
    top = y.max() * (0.92 + 0.08 * rng.integers(0, 2) * (1.0 - np.abs(2.0 * phase - 1.0)))
    bar = (phase < 1.0) & (y < top)
    rail = np.zeros((y.size, x.size), bool)
    for height in np.linspace(0.12, 0.85, rng.integers(2, 4)) * y.max():
        rail |= np.abs(y - height) + 0 * x < max(rng.uniform(0.01, 0.05), 1.0 / texels)
    round_bar = rng.random() < 0.5
    across = np.sqrt(np.maximum(1.0 - (2 * np.minimum(phase, 1.0) - 1.0) ** 2, 0.0)) if round_bar else 1.0
    shade = np.where(bar, (0.4 + 0.6 * across) * _per_item(rng, x / pitch, 0.15), 0.75)
    return _solid(sample_colour(rng), shade * _weather(rng, shade.shape, 0.15), bar | rail)


def _wire(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, texels: float) -> np.ndarray:
    """Paint a wire fence: a lattice of any mesh, or a few strands, with posts."""
    line = max(rng.uniform(0.002, 0.006), 0.8 / texels)
    opacity = rng.uniform(0.5, 1.0)
    post = np.mod(x + rng.random(), rng.uniform(0.8, 3.0)) < rng.uniform(0.02, 0.1)
    mesh = max(_log(rng, 0.04, 0.3), 4.0 * line)
    kind = str(rng.choice(["diamond", "square", "strands"]))
    if kind == "strands":
        net = (np.mod(y, max(mesh, 0.15)) < line) | (x < 0)
    else:
        u, v = (x + y, x - y) if kind == "diamond" else (x + 0 * y, y + 0 * x)
        net = (np.mod(u, mesh) < line) | (np.mod(v, mesh * rng.choice([1.0, 2.0])) < line)
    post = post & (y < 0.98 * y.max())
    shade = np.where(post, rng.uniform(0.5, 1.5), 1.0)
    return _solid(sample_colour(rng), shade, np.where(post, 1.0, net * opacity))


def _bricks(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, texels: float, ratio: float | None = None) -> np.ndarray:
    """Paint bricks or blocks of a bond, with joints and a shade each."""
    tall = max(_log(rng, 0.06, 0.3), 4.0 / texels)
    wide = tall * (ratio or rng.uniform(1.5, 3.5))
    row = np.floor(y / tall)
    column = x / wide + (0.5 * np.mod(row, 2.0) if ratio is None else 0.0)
    joint = max(rng.uniform(0.004, 0.015), 0.8 / texels)
    is_joint = (np.mod(y, tall) < joint) | (np.mod(column, 1.0) * wide < joint)
    shade = _per_item(rng, np.floor(column) + 31 * row, rng.uniform(0.0, 0.25))
    shade = np.where(is_joint, rng.choice([0.4, 0.7, 1.4]), shade)
    return _solid(sample_colour(rng), shade * _weather(rng, shade.shape, rng.uniform(0.05, 0.25)))


def _tiles(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, texels: float) -> np.ndarray:
    """Paint square or tall tiles."""
    return _bricks(rng, x, y, texels, ratio=rng.choice([0.3, 1.0, 2.0]))


def _plaster(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, texels: float) -> np.ndarray:
    """Paint a plain wall with a skirting, and at times a pipe, a cable duct or the corner of a wall as upright bars."""
    shade = _weather(rng, (y.size, x.size), rng.uniform(0.02, 0.1))
    colour = sample_colour(rng) if rng.random() < 0.3 else rng.uniform(0.3, 0.85) * rng.uniform(0.92, 1.08, 3)
    picture = _solid(colour, shade)
    picture[(y < 0.1)[:, 0]] *= rng.uniform(0.3, 1.2)
    _bars(rng, picture, x, y, texels, int(rng.integers(0, 4)))
    return _opaque(picture)


def _bars(rng: np.random.Generator, picture: np.ndarray, x: np.ndarray, y: np.ndarray, texels: float, count: int) -> None:
    """Paint upright pipes and ducts, round or flat, into a picture."""
    for _ in range(count):
        wide, at = max(_log(rng, 0.012, 0.15), 2.0 / texels), rng.uniform(0.0, x.max())
        offset = (x[0] - at) / (0.5 * wide)
        columns = np.flatnonzero(np.abs(offset) < 1.0)
        low, high = np.sort(rng.uniform(-0.3, 1.3, 2)) * y.max()
        rows = np.flatnonzero((y[:, 0] >= low) & (y[:, 0] <= high))
        light = 0.35 + 0.65 * np.sqrt(1.0 - offset[columns] ** 2) if rng.random() < 0.6 else np.ones(len(columns))
        picture[rows[:, None], columns[None, :], :3] = light[None, :, None] * sample_colour(rng)


def _windows(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, texels: float) -> np.ndarray:
    """Paint a facade with windows and doors: frames and mullions around panes that mirror the sky or show a dark room."""
    base = str(rng.choice(["plaster", "bricks", "sheet", "planks"]))
    picture = _PAINTERS[base](rng, x, y, texels)
    bay, wide = rng.uniform(0.8, 3.0), rng.uniform(0.4, 0.9)
    sill, head = (0.0, rng.uniform(1.9, 2.3)) if rng.random() < 0.3 else (rng.uniform(0.4, 1.1), rng.uniform(1.6, 2.4))
    u, v = np.mod(x + rng.random(), bay) / (wide * bay), (np.mod(y, 3.0) - sill) / (head - sill)
    frame = max(rng.uniform(0.03, 0.09), 1.5 / texels)
    inside = (u < 1.0) & (v >= 0.0) & (v < 1.0)
    panes = rng.integers(1, 5), rng.integers(1, 4)
    in_pane = np.mod(u * panes[0], 1.0) * wide * bay / panes[0], np.mod(v * panes[1], 1.0) * (head - sill) / panes[1]
    is_frame = (in_pane[0] < frame) | (in_pane[1] < frame) | (u * wide * bay > wide * bay - frame)
    glass = rng.uniform(0.02, 0.9) * np.array([0.9, 0.97, 1.05]) * _weather(rng, inside.shape, 0.3)[..., None]
    pane = np.where((inside & is_frame)[..., None], sample_colour(rng), glass)
    picture[..., :3] = np.where(inside[..., None], pane, picture[..., :3])
    _bars(rng, picture, x, y, texels, int(rng.integers(0, 3)))
    return _opaque(picture)


def _blinds(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, texels: float) -> np.ndarray:
    """Paint slats, upright or level, with bright or dark gaps, some of which are open."""
    pitch = max(_log(rng, 0.02, 0.15), 3.0 / texels)
    phase = ((x if rng.random() < 0.7 else y) + 0 * x + 0 * y) / pitch
    slat = np.mod(phase, 1.0) / rng.uniform(0.5, 0.95)
    shade = np.where(slat < 1.0, (0.7 + 0.3 * slat) * _per_item(rng, phase, 0.05), rng.choice([0.05, 2.0]))
    return _solid(sample_colour(rng), shade)


def _shelves(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, texels: float) -> np.ndarray:
    """Paint shelves with rows of upright things of many colours."""
    tall, pitch = rng.uniform(0.25, 0.5), max(rng.uniform(0.02, 0.12), 3.0 / texels)
    row, column = np.floor(y / tall), np.floor(x / pitch)
    item = (17 * row + column).astype(int) % 997
    colours = np.stack([sample_colour(rng) for _ in range(997)])[item]
    filled = np.mod(y, tall) < tall * (0.5 + 0.4 * (np.sin(item * 12.9898) * 0.5 + 0.5))
    picture = _solid(np.ones(3), np.full(filled.shape, 0.04))
    picture[..., :3] = np.where(filled[..., None], colours, picture[..., :3])
    picture[np.mod(y, tall)[:, 0] < max(0.03, 1.0 / texels), :, :3] = sample_colour(rng)
    return picture


def _board(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, texels: float) -> np.ndarray:
    """Paint a white or black board or a poster, with a frame, lines and text."""
    background, ink = (230, 40) if rng.random() < 0.7 else (30, 220)
    image = Image.new("RGB", (x.size, y.size), (background,) * 3)
    pen = ImageDraw.Draw(image)
    for _ in range(rng.integers(2, 14)):
        left, top = rng.uniform(0, x.size), rng.uniform(0, y.size)
        if rng.random() < 0.6:
            pen.text((left, top), str(rng.choice(_WORDS)), fill=(ink,) * 3, font_size=max(0.1 * texels, 6.0))
        else:
            end = left + rng.normal(0, 0.2 * x.size), top + rng.normal(0, 0.2 * y.size)
            pen.line([(left, top), end], fill=tuple(rng.integers(0, 255, 3).tolist()), width=max(round(0.01 * texels), 1))
    frame = max(round(0.03 * texels), 1)
    pen.rectangle((0, 0, x.size - 1, y.size - 1), outline=tuple(rng.integers(0, 255, 3).tolist()), width=frame)
    return _opaque(np.concatenate([(np.asarray(image) / 255.0) ** 2.2, np.ones((y.size, x.size, 1))], axis=2))


def _ceiling(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, texels: float) -> np.ndarray:
    """Paint a ceiling: panels or beams, and lamps, which are brighter than white."""
    picture = _bricks(rng, x, y, texels, ratio=1.0) if rng.random() < 0.5 else _planks(rng, x, y, texels)
    picture[..., :3] = picture[..., :3] / max(float(picture[..., :3].mean()), 0.05) * rng.uniform(0.15, 0.7)
    _bars(rng, picture, x, y, texels, int(rng.integers(0, 8)))
    pitch, size = rng.uniform(1.2, 2.6, 2), (rng.uniform(0.3, 1.3), rng.uniform(0.12, 0.7))
    lamp = (np.mod(x, pitch[0]) < size[0]) & (np.mod(y, pitch[1]) < size[1])
    picture[lamp, :3] = rng.uniform(2.5, 7.0) * np.array([1.0, rng.uniform(0.9, 1.0), rng.uniform(0.75, 1.0)])
    return picture


def _opaque(picture: np.ndarray) -> np.ndarray:
    picture[..., 3] = 1.0
    return picture


_Painter = Callable[[np.random.Generator, np.ndarray, np.ndarray, float], np.ndarray]
_PAINTERS: dict[str, _Painter] = {
    "sheet": _sheet, "planks": _planks, "pickets": _pickets, "wire": _wire, "windows": _windows, "tiles": _tiles,
    "bricks": _bricks, "blinds": _blinds, "plaster": _plaster, "shelves": _shelves, "board": _board, "ceiling": _ceiling,
}  # fmt: skip
KINDS = ("sheet", "planks", "pickets", "wire", "windows", "tiles", "bricks", "blinds", "board")
"""Kinds of walls and fences that occur on their own."""
SHARES = (0.25, 0.1, 0.15, 0.12, 0.15, 0.06, 0.07, 0.06, 0.04)
"""Shares of the `KINDS`."""
