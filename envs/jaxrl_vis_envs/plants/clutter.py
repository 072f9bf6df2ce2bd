"""Objects around plants: poles, tubes, cables, strips, blades, pots, parts of a robot. NumPy only."""

import colorsys
import math

import numpy as np

from jaxrl_vis_envs.plants.family import Family
from jaxrl_vis_envs.plants.field import Leaf, Plot, Stalk, generator
from jaxrl_vis_envs.plants.structures import plain_material, sample_arm, sample_structures, tube

_MAX_SEGMENT = 0.1  # m: maximum length of the pieces of a ribbon, so that pieces out of sight can be culled
_UP = np.array([0.0, 0.0, 1.0])


def objects(plot: Plot) -> tuple[list[tuple[Stalk, list[float]]], list[tuple[Leaf, list[float]]]]:
    """Sample the objects of a daytime plot, determined by its family and seed.

    Returns:
        Round objects as chains of truncated cones (`Stalk`), and flat ones as ribbons (`Leaf`), each with its material
        (`surfaces.MATERIAL`).
    """
    rng = generator(plot.family, plot.seed, "objects")
    family, scene = plot.family, plot.family.scene
    length = family.layout.plot_length + 2.0
    round_things: list[tuple[Stalk, list[float]]] = []
    flat_things: list[tuple[Leaf, list[float]]] = []
    for _ in range(rng.poisson(scene.objects[0] * length)):
        foot = np.array([rng.uniform(-1.0, length - 1.0), _offset_from_row(rng, family), 0.0])
        kind = rng.choice(["pole", "tube", "cable", "strip", "blade", "legs"], p=[0.3, 0.15, 0.1, 0.2, 0.2, 0.05])
        if kind in ("strip", "blade"):
            flat_things.append((_ribbon(rng, foot, kind), material(rng, green=kind == "blade")))
            continue
        paint = material(rng)
        if kind == "pole":
            top = foot + [*rng.normal(0.0, 0.04, 2), 0.0] + _UP * rng.uniform(0.3, 2.6)
            round_things.append((tube([foot, top], _sample_log_uniform(rng, 0.003, 0.05)), paint))
        elif kind == "legs":
            for side in (-0.09, 0.09):
                start = foot + [side, rng.uniform(0.1, 0.8), 0.0]
                round_things.append((tube([start, start + 0.9 * _UP], rng.uniform(0.05, 0.08)), paint))
        else:
            high = rng.uniform(0.02, 1.6)
            across = rng.normal(0.0, 1.0 if kind == "tube" else 0.05, 3) + [1.0, 0.0, 0.0]
            across *= rng.uniform(0.5, 2.5) / np.linalg.norm(across)
            start = foot + high * _UP
            radius = _sample_log_uniform(rng, 0.005, 0.04) if kind == "tube" else rng.uniform(0.001, 0.005)
            round_things.append((tube([start, start + across], radius), paint))
    round_things += sample_structures(rng, scene.structures[0], family.layout.plot_length, family.rig.distance)
    if scene.potted:
        round_things += _pots(generator(family, plot.seed, "pots"), plot)
    if scene.robot:
        round_things += _robot(rng, family)
    return round_things, flat_things


def _offset_from_row(rng: np.random.Generator, family: Family) -> float:
    """Sample the y coordinate of an object, m: behind the row, or with probability 0.25 in front of it."""
    return rng.uniform(-0.3 * family.rig.distance, 0.0) if rng.random() < 0.25 else rng.uniform(0.0, 1.5)


def _sample_log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return low * (high / low) ** rng.random()


def _ribbon(rng: np.random.Generator, foot: np.ndarray, kind: str) -> Leaf:
    """Sample an upright ribbon: a ``strip`` with parallel sides, or a ``blade`` that bends and tapers."""
    tall = rng.uniform(0.25, 1.8)
    knots = max(math.ceil(tall / _MAX_SEGMENT), 3)
    along = np.linspace(0.0, 1.0, knots + 1)
    lean = rng.normal(0.0, 0.06 if kind == "strip" else 0.25, 2)
    bend = 0.0 if kind == "strip" else rng.uniform(0.0, 0.5)
    sideways = (along + bend * along**2)[:, None] * lean * tall
    middle = foot + np.concatenate([sideways, (along * tall)[:, None]], axis=1)
    turn = rng.uniform(-0.8, 0.8)
    across = np.tile([math.cos(turn), math.sin(turn), 0.0], (knots + 1, 1))
    half = _sample_log_uniform(rng, 0.004, 0.03) * (np.ones(knots + 1) if kind == "strip" else np.maximum(1.0 - along**2, 0.05))
    return Leaf(-1, middle, across, half, kind == "strip")


def _pots(rng: np.random.Generator, plot: Plot) -> list[tuple[Stalk, list[float]]]:
    dark = [0.03, 0.03, 0.035] if rng.random() < 0.6 else list(colorsys.hsv_to_rgb(0.05, 0.6, 0.35))
    pots = []
    for stalk in plot.measured:
        foot, tall, wide = stalk.points[0] * [1.0, 1.0, 0.0], rng.uniform(0.08, 0.3), rng.uniform(0.06, 0.18)
        pots.append((tube([foot, foot + tall * _UP], 0.8 * wide, wide), plain_material(rng, dark)))
        earth = tube([foot + 0.7 * tall * _UP, foot + 1.1 * tall * _UP], 0.8 * wide, 0.01)
        pots.append((earth, plain_material(rng, [0.06, 0.04, 0.03])))
    return pots


def _robot(rng: np.random.Generator, family: Family) -> list[tuple[Stalk, list[float]]]:
    """Sample an arm that reaches into the image, between the cameras and the row."""
    middle = 0.5 * family.layout.plot_length + rng.uniform(-0.5, 0.5)
    side = rng.choice([-1.0, 1.0])
    near = -rng.uniform(0.2, 0.6) * family.rig.distance
    return sample_arm(
        rng,
        np.array([middle + side * rng.uniform(0.5, 0.9), near, family.rig.camera_height + rng.uniform(0.3, 0.9)]),
        side,
    )


def material(rng: np.random.Generator, green: bool = False) -> list[float]:
    """Sample a material, grey, wooden, painted or straw-like, or that of a green blade; see `surfaces.MATERIAL`."""
    if green:
        return plain_material(
            rng, list(colorsys.hsv_to_rgb(rng.uniform(0.17, 0.32), rng.uniform(0.4, 0.8), rng.uniform(0.1, 0.35)))
        )
    kind = rng.choice(["grey", "wood", "paint", "straw"], p=[0.45, 0.25, 0.15, 0.15])
    if kind == "grey":
        return plain_material(rng, [_sample_log_uniform(rng, 0.03, 0.85)] * 3)
    hue, saturation = {
        "wood": (rng.uniform(0.05, 0.1), rng.uniform(0.2, 0.6)),
        "paint": (rng.random(), rng.uniform(0.4, 0.9)),
        "straw": (rng.uniform(0.08, 0.16), rng.uniform(0.3, 0.6)),
    }[kind]
    grain = 0.5 if kind == "wood" else 0.05
    return plain_material(rng, list(colorsys.hsv_to_rgb(hue, saturation, rng.uniform(0.1, 0.7))), grain)
