"""Plant organs other than plain leaves, in daytime plots: ears, tassels, panicles, and clasping and hanging leaves.

NumPy only.
"""

import colorsys
import math

import numpy as np

from jaxrl_vis_envs.plants.field import Leaf, Plot, Stalk, generator
from jaxrl_vis_envs.plants.structures import Tube, plain_material, tube

_UP = np.array([0.0, 0.0, 1.0])
_EAR_PROFILE = np.array([0.45, 0.85, 1.0, 0.95, 0.7, 0.3])
_PANICLE_PROFILE = np.array([0.3, 0.8, 1.0, 0.9, 0.65, 0.25])


def sample_organs(plot: Plot) -> tuple[list[Tube], list[Leaf]]:
    """Sample the organs of the plants of a daytime plot.

    Returns:
        Round organs: ears and tassels of maize, panicles of sorghum; and leaves of the near row: bases of leaves that clasp a
        stalk and hide it at its nodes, and long dry leaves that hang along it.
    """
    rng = generator(plot.family, plot.seed, "organs")
    scene, ripe = plot.family.scene, plot.family.leaves.dry
    organs: list[Tube] = []
    leaves: list[Leaf] = []
    for index, stalk in enumerate(plot.stalks):
        for node in stalk.nodes if stalk.row == 0 else ():
            clasping, hanging = rng.random(2) < (scene.organs[0], scene.hanging[0])
            if clasping:
                leaves.append(_clasp(rng, index, stalk, node, dry=bool(rng.random() < ripe)))
            if hanging and rng.random() < ripe:
                leaves.append(_hanging(rng, index, stalk, node))
        if rng.random() >= scene.organs[0]:
            continue
        if scene.maize:
            organs += _tassel(rng, stalk, ripe)
            for _ in range(rng.choice([0, 1, 2], p=[0.3, 0.55, 0.15])):
                organs += _ear(rng, stalk, ripe)
        else:
            organs.append(_panicle(rng, stalk))
    return organs, leaves


def _at(stalk: Stalk, arc: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centres [..., 3] and radii [...] of a stalk at arc lengths [...], m."""
    points = np.stack([np.interp(arc, stalk.arc, stalk.points[:, axis]) for axis in range(3)], axis=-1)
    return points, np.asarray(np.interp(arc, stalk.arc, stalk.radius))


def _clasp(rng: np.random.Generator, index: int, stalk: Stalk, node: float, dry: bool) -> Leaf:
    """Sample the lower part of a leaf, which wraps one side of the stalk above its node and then leaves it."""
    along = np.linspace(0.0, 1.0, 5)
    centre, radius = _at(stalk, node + along * rng.uniform(0.05, 0.16))
    angle = rng.uniform(-math.pi, math.pi)
    outward = np.array([math.cos(angle), math.sin(angle), 0.0])
    away = 1.05 * radius + rng.uniform(0.0, 0.03) * along**2
    half = radius * rng.uniform(0.9, 1.5) * np.array([0.9, 1.1, 1.3, 1.2, 0.6])
    across = np.tile([-math.sin(angle), math.cos(angle), 0.0], (5, 1))
    # The gutter of a ribbon opens along its normal: it is turned such that its edges bend around the stalk.
    return Leaf(index, centre + away[:, None] * outward, across, half, dry)


def _hanging(rng: np.random.Generator, index: int, stalk: Stalk, node: float) -> Leaf:
    """Sample a dry leaf that bends down at its collar and hangs close to the stalk, curled."""
    count = 7
    collar, radius = _at(stalk, node + rng.uniform(0.02, 0.1))
    length = min(rng.uniform(0.2, 0.6), max(collar[2] - 0.02, 0.05))
    heading = rng.uniform(-math.pi, math.pi) + np.cumsum(rng.normal(0.0, 0.3, count))
    outward = np.stack([np.cos(heading), np.sin(heading), np.zeros(count)], axis=1)
    along = np.linspace(0.0, 1.0, count)
    away = radius + rng.uniform(0.005, 0.05) * np.sin(math.pi * np.minimum(along + 0.1, 0.9))
    middle = collar - (along * length)[:, None] * _UP + away[:, None] * outward
    twist = rng.uniform(-math.pi, math.pi) + np.cumsum(rng.normal(0.0, 0.5, count))
    across = np.stack([np.cos(twist), np.sin(twist), rng.normal(0.0, 0.2, count)], axis=1)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    half = rng.uniform(0.006, 0.025) * np.clip(1.05 - along**2, 0.1, 1.0) * rng.uniform(0.6, 1.0, count)
    return Leaf(index, middle, across, half, True)


def _ear(rng: np.random.Generator, stalk: Stalk, ripe: float) -> list[Tube]:
    """Sample an ear in its husk beside the stalk, with silk at its tip."""
    node = stalk.nodes[np.argmin(np.abs(stalk.nodes - rng.uniform(0.35, 0.6) * stalk.arc[-1]))] if len(stalk.nodes) else 0.7
    base, radius = _at(stalk, node)
    angle, tilt = rng.uniform(-math.pi, math.pi), rng.uniform(0.1, 0.6) + (rng.uniform(0.0, 2.0) if ripe > 0.8 else 0.0)
    outward = np.array([math.cos(angle), math.sin(angle), 0.0])
    axis = math.sin(tilt) * outward + math.cos(tilt) * _UP
    length, thick = rng.uniform(0.14, 0.26), rng.uniform(0.018, 0.03)
    start = base + (radius + 0.4 * thick) * outward
    corners = [start + fraction * length * axis for fraction in np.linspace(0.0, 1.0, len(_EAR_PROFILE))]
    hue, value = 0.25 - 0.12 * ripe, 0.2 + 0.35 * ripe
    husk = plain_material(rng, list(colorsys.hsv_to_rgb(hue, rng.uniform(0.3, 0.6), value * rng.uniform(0.8, 1.2))), 0.35)
    silk = plain_material(rng, list(colorsys.hsv_to_rgb(rng.uniform(0.02, 0.14), 0.6, rng.uniform(0.08, 0.45))), 0.3)
    organs = [(tube(corners, thick * _EAR_PROFILE), husk)]
    for _ in range(rng.integers(3, 8)):
        curl = rng.normal(0.0, 0.02, 3)
        ends = [corners[-1], corners[-1] + 0.03 * axis + curl, corners[-1] + 0.04 * axis + 2 * curl - 0.03 * _UP]
        organs.append((tube(ends, 0.0022, 0.001), silk))
    return organs


def _tassel(rng: np.random.Generator, stalk: Stalk, ripe: float) -> list[Tube]:
    """Sample a tassel: a spike and branches that arch outwards; coarse in rows behind."""
    top = stalk.points[-1]
    colour = colorsys.hsv_to_rgb(rng.uniform(0.08, 0.17), rng.uniform(0.3, 0.7), rng.uniform(0.2, 0.5) * (0.7 + 0.3 * ripe))
    paint, length = plain_material(rng, list(colour), 0.4), rng.uniform(0.15, 0.32)
    organs = [(tube([top, top + length * _UP + rng.normal(0.0, 0.02, 3)], 0.0045, 0.002), paint)]
    for _ in range(rng.integers(4, 12) if stalk.row == 0 else 3):
        angle, spread = rng.uniform(-math.pi, math.pi), rng.uniform(0.2, 0.9)
        outward = np.array([math.cos(angle), math.sin(angle), 0.0])
        start = top + rng.uniform(0.0, 0.3) * length * _UP
        middle = start + 0.4 * length * (math.cos(spread) * _UP + math.sin(spread) * outward)
        end = middle + 0.4 * length * (math.cos(1.8 * spread) * _UP + math.sin(1.8 * spread) * outward)
        organs.append((tube([start, middle, end], 0.0035, 0.0015), paint))
    return organs


def _panicle(rng: np.random.Generator, stalk: Stalk) -> Tube:
    """Sample the panicle of a sorghum plant, from open and green to compact and red."""
    colour = colorsys.hsv_to_rgb(rng.uniform(0.02, 0.16), rng.uniform(0.3, 0.7), rng.uniform(0.12, 0.45))
    paint = plain_material(rng, list(colour), 0.3)
    paint[8:12] = [1.0 / rng.uniform(0.006, 0.015), 0.7, 0.6, 1.0 / 0.004]  # grains
    length, thick = rng.uniform(0.15, 0.3), rng.uniform(0.02, 0.05)
    axis = _UP + rng.normal(0.0, 0.15, 3)
    corners = [stalk.points[-1] + fraction * length * axis for fraction in np.linspace(0.0, 1.0, len(_PANICLE_PROFILE))]
    return tube(corners, thick * _PANICLE_PROFILE), paint
