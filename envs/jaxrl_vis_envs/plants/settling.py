"""Sampling of the factors that are common to one plot, for families with daytime and night plots. NumPy only."""

import dataclasses
import math

import numpy as np

from jaxrl_vis_envs.plants.family import BOUNDS, Family, Layout, Leaves, Rig, Stalks, Textures
from jaxrl_vis_envs.plants.scene import Scene

_MAIZE_STALKS = {
    "diameter_mean": 0.022,
    "diameter_sd": 0.004,
    "lean_sd": (2.0, 6.0),
    "node_spacing": (0.10, 0.22),
    "node_swelling": (0.03, 0.12),
    "sheaths": 0.85,
    "sheath_length": (0.08, 0.2),
}
_OF_IMAGES = ("white_balance", "borders", "overlay", "replicated")  # sampled image by image
_MAIZE_LEAVES = {"lower": 0.25, "middle": 0.7, "upper": 0.95, "width_mean": 0.085, "length_mean": 0.75}


def settle(family: Family, rng: np.random.Generator) -> Family:
    """Sample the factors that are common to a plot: night or day, maize or sorghum, pots or rows, camera poses and light.

    Args:
        family: Family to sample from; returned unchanged if it has no daytime plots.
        rng: Random number generator.

    Returns:
        At night, the family with the default scene, whose share is 0. In daytime, a family with a share of 1, one value in
        each range of its scene and 0 or 1 for its fractions (those of images apart), and its other parts adapted to these.
    """
    if family.scene.share <= 0:
        return family
    if rng.random() >= family.scene.share:
        return dataclasses.replace(family, scene=Scene())
    scene = _sample_values(family.scene, rng)
    layout, stalks, leaves, textures = family.layout, family.stalks, family.leaves, family.textures
    distance = scene.distance[0]
    if scene.maize:
        # Factor of the stalks' diameter, common to the plot.
        size = rng.uniform(0.7, 1.2)
        stalks = dataclasses.replace(stalks, **_MAIZE_STALKS | {"diameter_mean": 0.022 * size})
        leaves = dataclasses.replace(leaves, **_MAIZE_LEAVES, density=leaves.density * rng.uniform(0.5, 1.3))
        layout = dataclasses.replace(
            layout, stalks_mean=layout.stalks_mean * rng.uniform(0.3, 0.6), tillers=0.0, offset_sd=0.015
        )
        stalks = dataclasses.replace(stalks, taper=stalks.taper * rng.uniform(0.6, 1.6))
    leaves, textures = _sample_ripeness(leaves, textures, rng)
    if scene.indoors:
        scene = dataclasses.replace(scene, grass=0.0)
    if scene.lone:
        layout = dataclasses.replace(layout, rows_behind=0)
    width, height = family.rig.width, family.rig.height
    focal = 0.5 * width / math.tan(math.radians(scene.lens[0]) / 2)
    if scene.portrait:
        width, height = height, width
    if scene.single:
        scene, layout, stalks, leaves, distance = _single(scene, layout, stalks, leaves, 0.5 * height / focal, rng)
    elif scene.potted:
        layout = dataclasses.replace(layout, plot_length=0.3, stalks_mean=rng.integers(1, 3), stalks_sd=0.0, rows_behind=0)
        leaves = dataclasses.replace(leaves, litter=0.0)
        distance *= rng.uniform(1.0, 2.0)
    # Few plants are seen from half a view's way to the side, so that the images of a plot differ.
    stretch = 0.5 * width / focal * distance if scene.single or scene.potted else family.rig.stretch
    leaves = dataclasses.replace(leaves, litter=leaves.litter * scene.straw[0])
    rig = dataclasses.replace(
        family.rig,
        width=width,
        height=height,
        focal=focal,
        distance=distance,
        camera_height=scene.camera_height[0],
        camera_height_sd=0.0,
        distance_sd=0.0,
        pitch=scene.pitch[0],
        stretch=stretch,
    )
    imaging = dataclasses.replace(family.imaging, flash=(0.01, 0.01))
    return _family(family, scene, layout, stalks, leaves, textures, rig, imaging)


def _single(
    scene: Scene, layout: Layout, stalks: Stalks, leaves: Leaves, slope: float, rng: np.random.Generator
) -> tuple[Scene, Layout, Stalks, Leaves, float]:
    """Sample a single plant and the distance (m) at which an image shows most of it; ``slope``: tangent of half the view."""
    tall = rng.uniform(0.9, 2.3)
    # From a part of the plant to a plant that is small in its image.
    distance = float(np.clip(0.5 * tall / slope * rng.uniform(0.5, 1.6), 0.4, 4.0))
    camera_height = float(np.clip(tall * rng.uniform(0.3, 0.8), 0.1, 2.0))
    pitch = rng.uniform(-8.0, 12.0)
    scene = dataclasses.replace(scene, camera_height=(camera_height, camera_height), pitch=(pitch, pitch))
    layout = dataclasses.replace(layout, plot_length=0.3, stalks_mean=1, stalks_sd=0.0, tillers=0.0, rows_behind=0)
    spacing = rng.uniform(0.06, 0.1) * tall
    shortest = max(0.7 * spacing, BOUNDS["stalks.node_spacing"][0])
    stalks = dataclasses.replace(stalks, height=(tall, tall), node_spacing=(shortest, 1.3 * spacing))
    # Seen on its own, a plant keeps the leaves that machines strip from the lower part of a row.
    every = {"lower": rng.uniform(0.2, 1.0), "middle": rng.uniform(0.6, 1.0), "upper": 1.0}
    leaves = dataclasses.replace(leaves, **every, density=1.0, litter=leaves.litter * rng.uniform(0.0, 0.3))
    return scene, layout, stalks, leaves, distance


def _family(
    family: Family, scene: Scene, layout: Layout, stalks: Stalks, leaves: Leaves, textures: Textures, rig: Rig, imaging
):
    return dataclasses.replace(
        family, scene=scene, layout=layout, stalks=stalks, leaves=leaves, textures=textures, rig=rig, imaging=imaging
    )


def _sample_ripeness(leaves: Leaves, textures: Textures, rng: np.random.Generator) -> tuple[Leaves, Textures]:
    """Sample the ripeness of the plants, between green and dry, and return leaves and textures adapted to it."""
    ripe = rng.random()
    hue = 0.24 - 0.13 * ripe
    changed = {"stalk_hue": (hue - 0.04, hue + 0.03), "speckles": (0.0, 0.5), "blotch_contrast": (0.1, 0.6)}
    dry = min(max(rng.normal(ripe, 0.2), 0.0), 1.0)
    return dataclasses.replace(leaves, dry=dry), dataclasses.replace(textures, **changed)


def _sample_values(scene: Scene, rng: np.random.Generator) -> Scene:
    """Sample one value from each range, and 0 or 1 for each fraction of plots."""
    drawn = {}
    for field in dataclasses.fields(scene):
        value = getattr(scene, field.name)
        if isinstance(value, tuple):
            low, high = value
            number = rng.uniform(low, high)
            drawn[field.name] = (number, number)
        elif field.name not in _OF_IMAGES:
            drawn[field.name] = float(rng.random() < value)
    return dataclasses.replace(scene, **drawn | {"share": 1.0})
