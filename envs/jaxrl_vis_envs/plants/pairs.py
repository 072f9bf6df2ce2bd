"""Stereo pairs of a plot, with ground truth."""

import dataclasses
import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.plants.cameras import Drive, Pose, drive
from jaxrl_vis_envs.plants.family import Family
from jaxrl_vis_envs.plants.field import Plot, generator
from jaxrl_vis_envs.plants.rendering import drawing, imaging, shading, tables
from jaxrl_vis_envs.plants.rendering.backdrop import sample_backdrop
from jaxrl_vis_envs.plants.rendering.blades import Blades, render_blades, sample_blades
from jaxrl_vis_envs.plants.rendering.degrading import degrade
from jaxrl_vis_envs.plants.rendering.overlays import add_flare
from jaxrl_vis_envs.plants.rendering.panels import Panel, render_panels, sample_panels
from jaxrl_vis_envs.plants.rendering.surfaces import NOTHING, Surfaces, build_surfaces

_FLASH = np.array([0.05, -0.10, -0.02])
"""Position of the flash in the left camera's frame, m: above the middle of the pair."""
_MOWN = 0.25
"""Fraction of plots with grass whose grass has no visible blades."""


@functools.lru_cache(maxsize=2)
def daylight(family: Family, seed: int) -> shading.Day | None:
    """Sample the daylight and the backdrop of a plot from its settled family; None at night. Two results are cached."""
    scene = family.scene
    if scene.share <= 0:
        return None
    rng = generator(family, seed, "daylight")
    height, azimuth = np.radians(scene.elevation[0]), rng.uniform(-np.pi, np.pi)
    sun = np.array([np.cos(height) * np.sin(azimuth), np.cos(height) * np.cos(azimuth), np.sin(height)])
    # Indoors, lamps and windows light one side, without shadows of a canopy.
    strength, depth = (0.6 * scene.sky[0], 0.0) if scene.indoors else (scene.sun[0], scene.shadow[0])
    warm = np.array([1.0, rng.uniform(0.85, 1.0), rng.uniform(0.65, 0.95)])
    blue = np.array([rng.uniform(0.75, 1.0), rng.uniform(0.85, 1.0), 1.0])
    shadow = (depth, rng.uniform(0.2, 0.7), rng.uniform(0.05, 0.4), rng.uniform(0.02, 0.1))
    brightness = scene.sky[0] + 0.3 * strength
    backdrop = sample_backdrop(rng, scene.indoors > 0, scene.photographs > 0, brightness, 2.0 ** scene.glare[0])
    values = (sun, strength * warm, scene.sky[0] * blue, np.array(shadow), backdrop)
    return shading.Day(*(jnp.asarray(value, jnp.float32) for value in values))


@functools.lru_cache(maxsize=2)
def grass(family: Family, seed: int) -> Blades | None:
    """Sample the blades of grass of a plot from its settled family; None at night, on other ground, and on mown grass."""
    rng = generator(family, seed, "grass")
    if family.scene.share <= 0 or family.scene.grass <= 0 or rng.random() < _MOWN:
        return None
    return sample_blades(rng, family.layout.plot_length, family.rig.distance)


@functools.lru_cache(maxsize=2)
def panels(family: Family, seed: int) -> list[Panel]:
    """Sample the walls, fences and furniture of a plot from its settled family; none at night."""
    return sample_panels(generator(family, seed, "panels"), family) if family.scene.share > 0 else []


@dataclasses.dataclass(frozen=True)
class Pair:
    """One stereo pair, and the ground truth of its left image. Arrays are on the device.

    Attributes:
        left, right: [H, W, 3] uint8, RGB.
        instance: [H, W] int32, index in `Plot.stalks`, or a negative label (see `surfaces`).
        depth: [H, W] float32, planar, m; infinite where nothing is visible.
        disparity: [H, W] float32, pixels; 0 where nothing is visible.
        pose: Pose of the left camera.
        frame: Index among the plot's pairs.
    """

    left: jax.Array
    right: jax.Array
    instance: jax.Array
    depth: jax.Array
    disparity: jax.Array
    pose: Pose
    frame: int


@dataclasses.dataclass(frozen=True)
class Sequence:
    """All stereo pairs of a plot, rendered on access.

    Attributes:
        plot: The plot.
        surfaces: Its renderable surfaces.
        drive: Trajectory of the cameras.
    """

    plot: Plot
    surfaces: Surfaces
    drive: Drive

    @classmethod
    def of(cls, plot: Plot) -> "Sequence":
        """Return the pairs of a plot as taken by its family's cameras."""
        return cls(plot, build_surfaces(plot), drive(plot.family, plot.seed))

    def __len__(self) -> int:
        return len(self.drive.poses)

    def __iter__(self) -> Iterator[Pair]:
        return (self[frame] for frame in range(len(self)))

    def __getitem__(self, frame: int) -> Pair:
        """Render one pair.

        Raises:
            IndexError: There is no such pair.
        """
        if not 0 <= frame < len(self):
            raise IndexError(f"pair {frame} of {len(self)}")
        true = self.drive.true
        left, instance, depth = self._render(frame, 0)
        right, _, _ = self._render(frame, 1)
        disparity = true.focal * true.baseline / depth
        return Pair(left, right, instance, depth, disparity, self.drive.poses[frame], frame)

    def left(self, frame: int) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Render the left image of one pair, with its instance and depth images; see `Pair`."""
        return self._render(frame, 0)

    def _render(self, frame: int, camera_index: int) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Render one image, with its instance and depth images; ``camera_index`` 0 is the left camera."""
        family, drive = self.plot.family, self.drive
        pose, true = drive.poses[frame], drive.true
        shift = camera_index * true.baseline
        view = tables.build_view(self.surfaces, pose, true, shift)
        offset = np.array([shift, 0.0, 0.0])
        rng = generator(family, self.plot.seed, "flash")
        settings = family.imaging
        flash, blur = rng.uniform(*settings.flash), rng.uniform(*settings.blur, 2)
        gains = np.exp(settings.exposure_spread * rng.normal(size=(len(self), 1)) + 0.01 * rng.normal(size=(len(self), 2)))
        vertical_offset = np.array([drive.vertical_offset, drive.vertical_slope]) * camera_index
        values = (
            true.focal,
            true.centre,
            vertical_offset,
            pose.rotation,
            pose.position + offset @ pose.rotation,
            _FLASH - offset,
            (flash, settings.ambient, family.rig.distance),
        )
        shot = shading.Shot(*(jnp.asarray(value, jnp.float32) for value in values), day=daylight(family, self.plot.seed))
        radiance, instance, depth = drawing.render_view(view, shot, true.width, true.height, settings.samples)
        if shot.day is not None:
            camera = (pose.position + offset @ pose.rotation, pose.rotation, true.focal, true.centre)
            radiance, instance, depth = self._add_surroundings((radiance, instance, depth), camera, shot.day)
        gain = 2.0 * gains[frame, camera_index]
        if shot.day is not None:
            gain *= 0.5 * family.scene.brightness[0] / max(float(radiance.mean()), 1e-4)
        exposure = imaging.Exposure(
            gain=gain,
            blur=blur[camera_index] * true.width / 3376,
            vignetting=settings.vignetting,
            full_well=settings.full_well,
            read_noise=settings.read_noise,
            noise=settings.noise,
            seed=int(generator(family, self.plot.seed, f"noise {frame} {camera_index}").integers(1 << 32)),
        )
        image = imaging.expose(radiance, exposure)
        if shot.day is None:
            return image, instance, depth
        values, shown = degrade(np.asarray(image), family.scene, generator(family, self.plot.seed, f"degrade {frame}"))
        return jnp.asarray(values), jnp.where(jnp.asarray(shown), instance, NOTHING), depth

    def _add_surroundings(self, images: tuple[jax.Array, ...], camera: tuple, day: shading.Day) -> tuple[jax.Array, ...]:
        """Add panels, blades of grass and lens flare to the radiance, instance and depth images of a camera in daylight."""
        family, seed = self.plot.family, self.plot.seed
        radiance, instance, depth = map(np.asarray, images)
        walls = panels(family, seed)
        if walls:
            light = np.asarray(day.sun), np.asarray(day.sunlight), np.asarray(day.skylight)
            radiance, instance, depth = render_panels((radiance, instance, depth), walls, camera, light)
        blades = grass(family, seed)
        if blades is not None:
            radiance = render_blades(radiance, instance, depth, blades, camera)
        if family.scene.flare:
            radiance = add_flare(radiance, generator(family, seed, "flare"))
        return jnp.asarray(radiance), jnp.asarray(instance), jnp.asarray(depth)
