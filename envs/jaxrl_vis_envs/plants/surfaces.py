"""A plot as surfaces that can be drawn: cones for stalks, triangles for leaves, and what each of them looks like. NumPy
only.
"""

import colorsys
import dataclasses

import numpy as np

from jaxrl_vis_envs.plants.family import Range, Textures
from jaxrl_vis_envs.plants.field import Leaf, Plot, Stalk, generator

GROUND = -2
"""Instance of the ground in an image of instances, in which 0, 1, ... are the stalks of a plot."""
NOTHING = -1
"""Instance where there is nothing near enough to be drawn."""
LITTER = -3
"""Instance of litter; that of the leaves of stalk n is `LITTER` - 1 - n."""

MATERIAL = ("red", "green", "blue", "red_over", "green_over", "blue_over", "fibre_frequency", "fibre_contrast",
            "blotch_frequency", "blotch_contrast", "speckles", "speckle_frequency", "bands", "band_frequency", "bloom", "gloss",
            "place", "edge")  # fmt: skip
"""Columns of a material. ``over`` is the colour of sheaths, or of the edges of leaves; ``place`` shifts textures between
plants.
"""


@dataclasses.dataclass(frozen=True)
class Surfaces:
    """Cones and triangles of a plot, in the world, m. Row 0 of the materials is the ground.

    Attributes:
        start, end: [C, 3] float64, middles of the ends of each cone.
        radii: [C, 2] float64, mean radii at both ends.
        arcs: [C, 2] float64, length along the stalk at both ends.
        sheath, node: [C, 2] float64, how much of a sheath or node each end is, 0 to 1.
        oval: [C, 2] float64, greatest over least diameter, and the direction of the greatest in rad.
        cone_stalk, cone_material: [C] int32.
        corners: [T, 3, 3] float64, of each triangle.
        along, across: [T, 3] float64, texture coordinates of each corner: m along the midrib, and -1 to 1 across it.
        half_width: [T] float64, m.
        sideways: [T, 3] float64, unit vector from the midrib to the edge.
        triangle_instance, triangle_material: [T] int32.
        materials: [M, len(MATERIAL)] float32.
    """

    start: np.ndarray
    end: np.ndarray
    radii: np.ndarray
    arcs: np.ndarray
    sheath: np.ndarray
    node: np.ndarray
    oval: np.ndarray
    cone_stalk: np.ndarray
    cone_material: np.ndarray
    corners: np.ndarray
    along: np.ndarray
    across: np.ndarray
    half_width: np.ndarray
    sideways: np.ndarray
    triangle_instance: np.ndarray
    triangle_material: np.ndarray
    materials: np.ndarray


def build(plot: Plot) -> Surfaces:
    """The surfaces of a plot, with looks drawn from its family's textures."""
    rng = generator(plot.family, plot.seed, "textures")
    textures = plot.family.textures
    materials = [_ground(rng, textures)]
    cones = []
    for index, stalk in enumerate(plot.stalks):
        cones.append(_cones(index, stalk, len(materials)))
        materials.append(_material(rng, textures, textures.stalk_hue, textures.dry_hue, (0.35, 0.7), (0.30, 0.5)))
    strips = []
    for leaf in plot.leaves:
        strips.append(_triangles(leaf, len(materials)))
        hue = textures.dry_hue if leaf.dry else textures.leaf_hue
        saturation, value = ((0.35, 0.6), (0.16, 0.36)) if leaf.dry else ((0.55, 0.8), (0.12, 0.24))
        materials.append(_material(rng, textures, hue, textures.dry_hue, saturation, value))
    return Surfaces(**_joined(cones, _NO_CONES), **_joined(strips, _NO_TRIANGLES), materials=np.array(materials, np.float32))


_NO_CONES = {"start": (0, 3), "end": (0, 3), "radii": (0, 2), "arcs": (0, 2), "sheath": (0, 2), "node": (0, 2), "oval": (0, 2),
             "cone_stalk": (0,), "cone_material": (0,)}  # fmt: skip
_NO_TRIANGLES = {"corners": (0, 3, 3), "along": (0, 3), "across": (0, 3), "half_width": (0,), "sideways": (0, 3),
                 "triangle_instance": (0,), "triangle_material": (0,)}  # fmt: skip


def _joined(parts: list[dict[str, np.ndarray]], empty: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    if not parts:
        return {
            name: np.zeros(shape, np.int32 if len(shape) == 1 and name != "half_width" else float)
            for name, shape in empty.items()
        }
    return {name: np.concatenate([part[name] for part in parts]) for name in empty}


def _cones(index: int, stalk: Stalk, material: int) -> dict[str, np.ndarray]:
    count = len(stalk.arc) - 1
    bump = np.zeros_like(stalk.arc)
    for node in stalk.nodes:
        bump = np.maximum(bump, np.clip(1.0 - np.abs(stalk.arc - node) / 0.006, 0.0, 1.0))

    def pairs(values: np.ndarray) -> np.ndarray:
        return np.stack([values[:-1], values[1:]], axis=1)

    return {
        "start": stalk.points[:-1],
        "end": stalk.points[1:],
        "radii": pairs(stalk.radius),
        "arcs": pairs(stalk.arc),
        "sheath": pairs(stalk.sheath),
        "node": pairs(bump),
        "oval": np.tile([stalk.ovality, stalk.oval_angle], (count, 1)),
        "cone_stalk": np.full(count, index, np.int32),
        "cone_material": np.full(count, material, np.int32),
    }


def _triangles(leaf: Leaf, material: int) -> dict[str, np.ndarray]:
    left = leaf.middle - leaf.across * leaf.half_width[:, None]
    right = leaf.middle + leaf.across * leaf.half_width[:, None]
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(leaf.middle, axis=0), axis=1))])
    quads = len(length) - 1
    corners = np.stack([
        np.stack([left[:-1], right[:-1], left[1:]], axis=1),
        np.stack([right[:-1], right[1:], left[1:]], axis=1),
    ], axis=1)  # fmt: skip
    along = np.stack([
        np.stack([length[:-1], length[:-1], length[1:]], axis=1),
        np.stack([length[:-1], length[1:], length[1:]], axis=1),
    ], axis=1)  # fmt: skip
    across = np.tile(np.array([[-1.0, 1.0, -1.0], [1.0, 1.0, -1.0]]), (quads, 1))
    instance = LITTER if leaf.stalk < 0 else LITTER - 1 - leaf.stalk
    return {
        "corners": corners.reshape(-1, 3, 3),
        "along": along.reshape(-1, 3),
        "across": across,
        "half_width": np.repeat(0.5 * (leaf.half_width[1:] + leaf.half_width[:-1]), 2),
        "sideways": np.repeat(leaf.across[:-1], 2, axis=0),
        "triangle_instance": np.full(2 * quads, instance, np.int32),
        "triangle_material": np.full(2 * quads, material, np.int32),
    }


def _material(
    rng: np.random.Generator, textures: Textures, hue: Range, hue_over: Range, saturation: Range, value: Range
) -> list[float]:
    colour = colorsys.hsv_to_rgb(rng.uniform(*hue), rng.uniform(*saturation), rng.uniform(*value))
    over = colorsys.hsv_to_rgb(rng.uniform(*hue_over), rng.uniform(0.25, 0.55), rng.uniform(0.25, 0.5))
    return [
        *colour,
        *over,
        1.0 / rng.uniform(*textures.fibre_pitch),
        rng.uniform(*textures.fibre_contrast),
        1.0 / rng.uniform(*textures.blotch_size),
        rng.uniform(*textures.blotch_contrast),
        rng.uniform(*textures.speckles),
        1.0 / rng.uniform(*textures.speckle_size),
        rng.uniform(*textures.bands),
        1.0 / rng.uniform(*textures.band_pitch),
        rng.uniform(*textures.bloom),
        rng.uniform(*textures.gloss),
        rng.uniform(0.0, 50.0),
        rng.uniform(0.2, 1.0),
    ]


def _ground(rng: np.random.Generator, textures: Textures) -> list[float]:
    colour = colorsys.hsv_to_rgb(rng.uniform(*textures.soil_hue), rng.uniform(0.3, 0.5), rng.uniform(0.12, 0.25))
    over = colorsys.hsv_to_rgb(rng.uniform(*textures.soil_hue), rng.uniform(0.2, 0.4), rng.uniform(0.25, 0.4))
    # Clods of 3 cm with grains of 3 mm, and small stones.
    return [*colour, *over, 1 / 0.003, 0.5, 1 / 0.03, 0.75, 0.2, 1 / 0.006, 0.0, 10.0, 0.0, 0.0, rng.uniform(0.0, 50.0), 0.5]
