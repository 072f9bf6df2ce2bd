"""Round structures that are not stalks: tripods, scaffolds, hoses, bare trees, trunks, jointed arms. NumPy only."""

import colorsys
import math

import numpy as np

from jaxrl_vis_envs.plants.field import Stalk

Tube = tuple[Stalk, list[float]]
"""A chain of truncated cones and its material (`rendering.surfaces.MATERIAL`)."""
_MAX_SEGMENT = 0.1  # m: maximum length of the pieces of long objects, so that pieces out of sight can be culled
_UP = np.array([0.0, 0.0, 1.0])


def tube(corners: list[np.ndarray], radius: float | np.ndarray, end: float | None = None) -> Stalk:
    """Return a tube through ``corners``.

    Args:
        corners: K points [3] on its axis, m.
        radius: Radius at the start, or [K] at each corner, m.
        end: Radius at the end, m, for a radius that changes linearly; None for a constant one.
    """
    last = radius if end is None else end
    at_corners = radius if isinstance(radius, np.ndarray) else np.linspace(radius, last, len(corners))
    points, radii = [corners[0]], [at_corners[0]]
    for number, (one, other) in enumerate(zip(corners, corners[1:])):
        pieces = max(math.ceil(float(np.linalg.norm(other - one)) / _MAX_SEGMENT), 1)
        for fraction in np.arange(1, pieces + 1) / pieces:
            points.append(one + (other - one) * fraction)
            radii.append(at_corners[number] + (at_corners[number + 1] - at_corners[number]) * fraction)
    line, wide = np.array(points, float), np.array(radii, float)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    # The direction of the maximum diameter, without effect on a round tube, must not be that of its axis.
    sideways = math.atan2(line[-1, 1] - line[0, 1], line[-1, 0] - line[0, 0]) + math.pi / 2
    return Stalk(-1, line, wide, wide, arc, np.zeros(len(line)), np.zeros(0), 1.0, sideways)


def plain_material(rng: np.random.Generator, colour: list[float], grain: float = 0.05) -> list[float]:
    """Sample a material of one colour (RGB, 0 to 1), with fibres of contrast ``grain`` and, in one of ten cases, bands."""
    bands = rng.uniform(0.2, 0.8) if rng.random() < 0.1 else 0.0
    return [
        *colour, *colour, 1.0 / rng.uniform(1e-3, 6e-3), grain, 1.0 / rng.uniform(0.02, 0.1), rng.uniform(0.0, 0.25),
        0.0, 500.0, bands, 1.0 / rng.uniform(0.05, 0.3), 0.0, rng.uniform(0.0, 0.4), rng.uniform(0.0, 50.0), 0.0,
    ]  # fmt: skip


def sample_structures(rng: np.random.Generator, mean: float, length: float, distance: float) -> list[Tube]:
    """Sample structures around a row.

    Args:
        rng: Random number generator.
        mean: Mean number of structures.
        length: Length of the row along x, m.
        distance: Distance from the cameras to the row, m.
    """
    tubes: list[Tube] = []
    for _ in range(rng.poisson(mean)):
        kind = rng.choice(["tripod", "scaffold", "hose", "tree", "trunks"], p=[0.2, 0.2, 0.25, 0.2, 0.15])
        foot = np.array([rng.uniform(-0.8, length + 0.8), rng.uniform(-0.2 * min(distance, 2.0), 2.2), 0.0])
        tubes += {"tripod": _tripod, "scaffold": _scaffold, "hose": _hose, "tree": _tree, "trunks": _trunks}[kind](rng, foot)
    return tubes


def _tripod(rng: np.random.Generator, foot: np.ndarray) -> list[Tube]:
    paint = plain_material(rng, [rng.choice([0.03, 0.12, 0.5])] * 3)
    top = foot + rng.uniform(0.5, 1.5) * _UP
    turn, spread, radius = rng.uniform(0.0, math.pi), rng.uniform(0.2, 0.5), rng.uniform(0.008, 0.02)
    legs = []
    for number in range(3):
        angle = turn + number * 2 * math.pi / 3
        end = foot + spread * np.array([math.cos(angle), math.sin(angle), 0.0])
        legs.append((tube([top, end], radius, 0.6 * radius), paint))
    return [*legs, (tube([top - 0.2 * _UP, top + rng.uniform(0.1, 0.5) * _UP], radius), paint)]


def _scaffold(rng: np.random.Generator, foot: np.ndarray) -> list[Tube]:
    """Sample a frame of uprights, ledgers and braces: a scaffold, a rack or the skeleton of a greenhouse."""
    paint = plain_material(rng, [rng.uniform(0.1, 0.8)] * 3)
    foot = foot + [0.0, rng.uniform(0.3, 1.5), 0.0]
    bay, lift, radius = rng.uniform(0.3, 1.6), rng.uniform(0.35, 1.2), rng.uniform(0.006, 0.026)
    columns, levels = rng.integers(2, 5), rng.integers(1, 4)
    left = foot - [0.5 * bay * columns, 0.0, 0.0]
    frame = []
    for column in range(columns + 1):
        base = left + [column * bay, 0.0, 0.0]
        frame.append((tube([base, base + levels * lift * _UP], radius), paint))
    for level in range(1, levels + 1):
        base = left + level * lift * _UP
        frame.append((tube([base, base + [columns * bay, 0.0, 0.0]], radius), paint))
    for column in range(columns if rng.random() < 0.6 else 0):
        base = left + [column * bay, 0.0, 0.0]
        frame.append((tube([base, base + [bay, 0.0, lift]], 0.8 * radius), paint))
    return frame


def _hose(rng: np.random.Generator, foot: np.ndarray) -> list[Tube]:
    """Sample a hose or cable that hangs, or lies in a curve on the ground."""
    start, radius = foot + rng.uniform(0.01, 1.8) * _UP, rng.uniform(0.003, 0.02)
    end = start + [rng.normal(0.0, 0.8), rng.normal(0.0, 0.2), -rng.uniform(0.0, start[2])]
    sag = rng.uniform(0.0, 0.7) * np.linalg.norm(end - start)
    along = np.linspace(0.0, 1.0, 14)[:, None]
    line = start + (end - start) * along - 4 * sag * along * (1 - along) * _UP
    line += np.cumsum(rng.normal(0.0, 0.012, (14, 3)), axis=0)
    line[:, 2] = np.maximum(line[:, 2], radius)
    colour = list(colorsys.hsv_to_rgb(rng.random(), rng.choice([0.0, 0.8]), rng.choice([0.03, 0.2, 0.5])))
    return [(tube(list(line), radius), plain_material(rng, colour))]


def _bark(rng: np.random.Generator) -> list[float]:
    """Sample the material of bark: rough along the trunk, with lichens, or with rings like those of a cherry tree."""
    colour = colorsys.hsv_to_rgb(rng.uniform(0.02, 0.12), rng.uniform(0.05, 0.5), rng.uniform(0.04, 0.35))
    over = colorsys.hsv_to_rgb(rng.uniform(0.1, 0.3), rng.uniform(0.05, 0.3), rng.uniform(0.2, 0.5))
    return [
        *colour, *over, 1.0 / rng.uniform(2e-3, 2e-2), rng.uniform(0.2, 0.6), 1.0 / rng.uniform(0.02, 0.1),
        rng.uniform(0.2, 0.6), rng.uniform(0.0, 0.5), 1.0 / rng.uniform(3e-3, 2e-2), rng.choice([0.0, 0.3]),
        1.0 / rng.uniform(0.02, 0.08), 0.0, rng.uniform(0.0, 0.08), rng.uniform(0.0, 50.0), 0.0,
    ]  # fmt: skip


def _tree(rng: np.random.Generator, foot: np.ndarray) -> list[Tube]:
    """Sample a bare tree or shrub: a trunk, branches and twigs."""
    foot, bark = foot + [0.0, rng.uniform(0.2, 1.5), 0.0], _bark(rng)
    radius, tall = rng.uniform(0.012, 0.09), rng.uniform(1.2, 3.0)
    top = foot + tall * (_UP + rng.normal(0.0, 0.08, 3) * [1.0, 1.0, 0.0])
    branches = [(tube([foot, 0.5 * (foot + top) + rng.normal(0.0, 0.04, 3), top], radius, 0.3 * radius), bark)]
    for _ in range(rng.integers(5, 15)):
        at = rng.uniform(0.15, 1.0)
        start, wide = foot + at * (top - foot), radius * (1.0 - 0.7 * at) * rng.uniform(0.3, 0.7)
        reach = rng.uniform(0.3, 1.0) * np.array([*rng.normal(0.0, 0.6, 2), rng.uniform(0.2, 1.0)])
        middle = start + 0.5 * reach + rng.normal(0.0, 0.05, 3)
        branches.append((tube([start, middle, start + reach], wide, 0.3 * wide), bark))
        for _ in range(rng.integers(0, 4)):
            twig = middle + rng.random() * (start + reach - middle)
            tip = twig + rng.uniform(0.1, 0.4) * (0.6 * reach + rng.normal(0.0, 0.5, 3))
            branches.append((tube([twig, tip], 0.4 * wide, 0.2 * wide), bark))
    return branches


def _trunks(rng: np.random.Generator, foot: np.ndarray) -> list[Tube]:
    """Sample trunks of conifers in a row or a stand, with stubs of dead branches."""
    trunks = []
    for _ in range(rng.integers(3, 12)):
        base = np.array([foot[0] + rng.uniform(-3.0, 3.0), rng.uniform(1.0, 4.5), 0.0])
        radius, bark = rng.uniform(0.03, 0.16), _bark(rng)
        top = base + rng.uniform(2.5, 4.0) * (_UP + rng.normal(0.0, 0.03, 3) * [1.0, 1.0, 0.0])
        trunks.append((tube([base, base + 0.15 * (top - base), top], np.array([1.25, 1.0, 0.75]) * radius), bark))
        for _ in range(rng.integers(0, 6)):
            start = base + rng.uniform(0.2, 0.9) * (top - base)
            side = np.array([*rng.normal(0.0, 1.0, 2), rng.uniform(-0.5, 0.3)])
            trunks.append((tube([start, start + rng.uniform(0.1, 0.6) * side], 0.12 * radius, 0.05 * radius), bark))
    return trunks


def sample_arm(rng: np.random.Generator, start: np.ndarray, side: float) -> list[Tube]:
    """Sample an arm of two to four thick smooth links with thicker joints and a gripper, which hangs from ``start`` [3], m.

    ``side`` is 1 if it reaches into the image from the right, and -1 from the left.
    """
    grey = rng.uniform(0.5, 0.8) if rng.random() < 0.7 else rng.uniform(0.03, 0.2)
    links, rings = plain_material(rng, [grey] * 3), plain_material(rng, [rng.choice([0.04, 0.3, grey])] * 3)
    links[-3] = rng.uniform(0.1, 0.5)  # smooth: a highlight
    radius, at, parts = rng.uniform(0.025, 0.065), start, []
    for _ in range(rng.integers(2, 5)):
        step = np.array([-side * rng.uniform(0.0, 0.35), rng.normal(0.0, 0.05), rng.normal(-0.15, 0.2)])
        bend = at + 0.5 * step + rng.normal(0.0, 0.2, 3) * np.linalg.norm(step) * [1.0, 0.3, 1.0]
        corners = [(1 - t) ** 2 * at + 2 * t * (1 - t) * bend + t * t * (at + step) for t in np.linspace(0.0, 1.0, 6)]
        thick = radius * (1.0 - 0.25 * np.sin(np.linspace(0.0, math.pi, 6)))
        parts.append((tube(corners, thick), links))
        across = np.array([0.0, 1.0, 0.0]) * 1.2 * radius
        parts.append((tube([at + step - across, at + step + across], 1.15 * radius), rings))
        at, radius = at + step, radius * rng.uniform(0.75, 1.0)
    hand = at - 0.1 * _UP
    parts.append((tube([at, hand], 0.6 * radius), rings))
    for finger in (-1.0, 1.0):
        out = hand + [finger * radius * rng.uniform(0.4, 1.0), 0.0, 0.0]
        parts.append((tube([out, out - rng.uniform(0.05, 0.12) * _UP], 0.25 * radius), rings))
    return parts
