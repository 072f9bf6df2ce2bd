"""Renderable surfaces of a plot: cones for stalks, triangles for leaves, and their materials. NumPy only."""

import colorsys
import dataclasses

import numpy as np

from jaxrl_vis_envs.plants.clutter import objects
from jaxrl_vis_envs.plants.family import Range, Textures
from jaxrl_vis_envs.plants.field import Leaf, Plot, Stalk, generator
from jaxrl_vis_envs.plants.organs import sample_organs
from jaxrl_vis_envs.plants.scene import Scene

GROUND = -2
"""Label of the ground in an instance image, in which 0, 1, ... are the stalks of a plot."""
NOTHING = -1
"""Label where nothing is within the rendered depth."""
OBJECT = -(1 << 20)
"""Label of round objects that are not stalks, such as poles and ears."""
LITTER = -3
"""Label of litter and flat objects; that of the leaves of stalk n is `LITTER` - 1 - n."""

_GUTTER = 0.3
"""Height of a leaf's edges above its midrib, relative to its half width."""

MATERIAL = ("red", "green", "blue", "red_over", "green_over", "blue_over", "fibre_frequency", "fibre_contrast",
            "blotch_frequency", "blotch_contrast", "speckles", "speckle_frequency", "bands", "band_frequency", "bloom", "gloss",
            "place", "edge")  # fmt: skip
"""Columns of a material. ``over``: colour of sheaths or leaf edges; ``place``: offset of the texture, one per plant."""


@dataclasses.dataclass(frozen=True)
class Surfaces:
    """Cones and triangles of a plot, in the world, m. Row 0 of the materials is the ground.

    Attributes:
        start, end: [C, 3] float64, centres of both ends of each cone.
        radii: [C, 2] float64, mean radii at both ends.
        arcs: [C, 2] float64, arc length along the stalk at both ends.
        sheath, node: [C, 2] float64, weight of sheath or node at both ends, 0 to 1.
        oval: [C, 2] float64, ratio of maximum to minimum diameter, and direction of the maximum in rad.
        cone_stalk, cone_material: [C] int32, index of the stalk (or `OBJECT`), and row of the materials.
        corners: [T, 3, 3] float64, corners of each triangle.
        along, across, offset: [T, 3] float64, coordinates of each corner: m along the midrib, -1 to 1 across it, and m across
        it.
        normals: [T, 3, 3] float64, unit normal of the leaf at each corner.
        triangle_instance, triangle_material: [T] int32, label of the leaf, and row of the materials.
        materials: [M, len(MATERIAL)] float32, see `MATERIAL`.
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
    offset: np.ndarray
    normals: np.ndarray
    triangle_instance: np.ndarray
    triangle_material: np.ndarray
    materials: np.ndarray


def build_surfaces(plot: Plot) -> Surfaces:
    """Build the surfaces of a plot, with materials sampled from its family's textures."""
    rng = generator(plot.family, plot.seed, "textures")
    textures = plot.family.textures
    materials = [_ground(rng, textures)]
    is_daytime = plot.family.scene.share > 0
    if is_daytime:
        materials = [_daytime_ground(rng, plot.family.scene, materials[0])]
    cones = []
    for index, stalk in enumerate(plot.stalks):
        cones.append(_cones(index, stalk, len(materials)))
        materials.append(_material(rng, textures, textures.stalk_hue, textures.dry_hue, (0.35, 0.7), (0.30, 0.5)))
    organs, clasping = sample_organs(plot) if is_daytime else ([], [])
    strips = []
    for leaf in (*plot.leaves, *clasping):
        strips.append(_triangles(leaf, len(materials)))
        hue = textures.dry_hue if leaf.dry else textures.leaf_hue
        saturation, value = ((0.35, 0.6), (0.14, 0.34)) if leaf.dry else ((0.5, 0.75), (0.09, 0.19))
        materials.append(_material(rng, textures, hue, textures.dry_hue, saturation, value))
    if is_daytime:
        round_things, flat_things = objects(plot)
        for tube, paint in [*round_things, *organs]:
            cones.append(_cones(OBJECT, tube, len(materials)))
            materials.append(paint)
        for ribbon, paint in flat_things:
            strips.append(_triangles(ribbon, len(materials)))
            materials.append(paint)
    return Surfaces(
        **_concatenate(cones, _NO_CONES), **_concatenate(strips, _NO_TRIANGLES), materials=np.array(materials, np.float32)
    )


_NO_CONES = {"start": (0, 3), "end": (0, 3), "radii": (0, 2), "arcs": (0, 2), "sheath": (0, 2), "node": (0, 2), "oval": (0, 2),
             "cone_stalk": (0,), "cone_material": (0,)}  # fmt: skip
_NO_TRIANGLES = {"corners": (0, 3, 3), "along": (0, 3), "across": (0, 3), "offset": (0, 3), "normals": (0, 3, 3),
                 "triangle_instance": (0,), "triangle_material": (0,)}  # fmt: skip


def _concatenate(parts: list[dict[str, np.ndarray]], empty: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    if not parts:
        return {name: np.zeros(shape, np.int32 if len(shape) == 1 else float) for name, shape in empty.items()}
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
    """Build two strips, one on each side of the midrib, with raised edges: a leaf is a shallow gutter."""
    normal = np.cross(np.gradient(leaf.middle, axis=0), leaf.across)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    half = leaf.half_width[:, None]
    raised = _GUTTER * half * normal
    rim = {-1.0: leaf.middle - half * leaf.across + raised, 1.0: leaf.middle + half * leaf.across + raised}
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(leaf.middle, axis=0), axis=1))])
    parts: dict[str, list[np.ndarray]] = {name: [] for name in ("corners", "along", "across", "offset", "normals")}
    for side, edge in rim.items():
        slanted = normal - side * _GUTTER * leaf.across
        slanted /= np.linalg.norm(slanted, axis=1, keepdims=True)
        zero = np.zeros_like(length)
        values = {
            "corners": (leaf.middle, edge),
            "along": (length, length),
            "across": (zero, zero + side),
            "offset": (zero, side * leaf.half_width),
            "normals": (normal, slanted),
        }
        for name, (inner, outer) in values.items():
            parts[name] += [
                np.stack([inner[:-1], outer[:-1], inner[1:]], axis=1),
                np.stack([outer[:-1], outer[1:], inner[1:]], axis=1),
            ]
    count = 4 * (len(length) - 1)
    instance = LITTER if leaf.stalk < 0 else LITTER - 1 - leaf.stalk
    return {name: np.concatenate(part) for name, part in parts.items()} | {
        "triangle_instance": np.full(count, instance, np.int32),
        "triangle_material": np.full(count, material, np.int32),
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


def _daytime_ground(rng: np.random.Generator, scene: Scene, soil: list[float]) -> list[float]:
    """Sample the ground's material in a daytime plot: grass, or soil or concrete of any brightness; indoors, a smooth floor."""
    place = soil[-2]
    if scene.grass:
        hue, saturation, value = rng.uniform(0.18, 0.3), rng.uniform(0.4, 0.8), rng.uniform(0.08, 0.3)
        colour = colorsys.hsv_to_rgb(hue, saturation, value)
        # Patches of a lawn are of a similar green, or dry.
        dry = rng.uniform(0.0, 0.12) if rng.random() < 0.3 else rng.uniform(-0.02, 0.03)
        over = colorsys.hsv_to_rgb(hue - dry, saturation * rng.uniform(0.7, 1.1), value * rng.uniform(0.75, 1.5))
        return [*colour, *over, 1 / 0.008, 0.6, 1 / 0.15, 0.4, 0.3, 1 / 0.02, 0.0, 10.0, 0.0, 0.0, place, 0.5]
    if scene.indoors or rng.random() < 0.3:
        grey = rng.uniform(0.15, 0.6)
        over = [0.9 * grey] * 3
        return [grey, grey, grey, *over, 1 / 0.003, 0.1, 1 / 0.3, 0.15, 0.0, 1 / 0.01, 0.0, 10.0, 0.0, 0.05, place, 0.5]
    brightness, contrast = rng.uniform(0.6, 2.0), rng.uniform(0.1, 1.0)
    over = [base + contrast * (other - base) for base, other in zip(soil[:3], soil[3:6])]
    return [brightness * channel for channel in (*soil[:3], *over)] + soil[6:]


def _ground(rng: np.random.Generator, textures: Textures) -> list[float]:
    colour = colorsys.hsv_to_rgb(rng.uniform(*textures.soil_hue), rng.uniform(0.3, 0.5), rng.uniform(0.12, 0.25))
    over = colorsys.hsv_to_rgb(rng.uniform(*textures.soil_hue), rng.uniform(0.2, 0.4), rng.uniform(0.25, 0.4))
    # Clods of 3 cm with grains of 3 mm, and small stones.
    return [*colour, *over, 1 / 0.003, 0.5, 1 / 0.03, 0.75, 0.2, 1 / 0.006, 0.0, 10.0, 0.0, 0.0, rng.uniform(0.0, 50.0), 0.5]
