"""Pairs of images of a plot, with what is true in them."""

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.plants import drawing, imaging, tables
from jaxrl_vis_envs.plants.cameras import Drive, Pose, drive
from jaxrl_vis_envs.plants.field import Plot, generator
from jaxrl_vis_envs.plants.surfaces import Surfaces, build

_FLASH = np.array([0.05, -0.10, -0.02])
"""Where the flash is, in the left camera's frame, m: above the middle of the pair."""


@dataclasses.dataclass(frozen=True)
class Pair:
    """One pair, and the truth of its left image.

    Attributes:
        left, right: [H, W, 3] uint8, on the device.
        instance: [H, W] int32: index in `Plot.stalks`, or negative: see `surfaces`.
        depth: [H, W] float32, planar, m; infinite where there is nothing.
        disparity: [H, W] float32, pixels; 0 where there is nothing.
        pose: Of the left camera.
        frame: Which of the plot's pairs it is.
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
    """All pairs of a plot, drawn when they are asked for.

    Attributes:
        plot: What stands there.
        surfaces: The same, as it is drawn.
        drive: How the cameras pass it.
    """

    plot: Plot
    surfaces: Surfaces
    drive: Drive

    @classmethod
    def of(cls, plot: Plot) -> "Sequence":
        """The pairs of a plot, as its family's cameras take them."""
        return cls(plot, build(plot), drive(plot.family, plot.seed))

    def __len__(self) -> int:
        return len(self.drive.poses)

    def __iter__(self) -> Iterator[Pair]:
        return (self[frame] for frame in range(len(self)))

    def __getitem__(self, frame: int) -> Pair:
        """Draws one pair.

        Raises:
            IndexError: There is no such pair.
        """
        if not 0 <= frame < len(self):
            raise IndexError(f"pair {frame} of {len(self)}")
        true = self.drive.true
        left, instance, depth = self._take(frame, 0)
        right, _, _ = self._take(frame, 1)
        disparity = true.focal * true.baseline / depth
        return Pair(left, right, instance, depth, disparity, self.drive.poses[frame], frame)

    def left(self, frame: int) -> tuple[jax.Array, jax.Array, jax.Array]:
        """The left image of one pair alone, and instance and depth in it; see `Pair`."""
        return self._take(frame, 0)

    def _take(self, frame: int, side: int) -> tuple[jax.Array, jax.Array, jax.Array]:
        """One image, and instance and depth in it; side 0 is the left one."""
        family, drive = self.plot.family, self.drive
        pose, true = drive.poses[frame], drive.true
        shift = side * true.baseline
        view = tables.see(self.surfaces, pose, true, shift)
        offset = np.array([shift, 0.0, 0.0])
        rng = generator(family, self.plot.seed, "flash")
        imaging_of = family.imaging
        flash, blur = rng.uniform(*imaging_of.flash), rng.uniform(*imaging_of.blur, 2)
        gains = np.exp(imaging_of.exposure_spread * rng.normal(size=(len(self), 1)) + 0.01 * rng.normal(size=(len(self), 2)))
        lines = np.array([drive.line_offset, drive.line_slope]) * side
        numbers = (
            true.focal,
            true.centre,
            lines,
            pose.rotation,
            pose.position + offset @ pose.rotation,
            _FLASH - offset,
            (flash, imaging_of.ambient, family.rig.distance),
        )
        shot = drawing.Shot(*(jnp.asarray(number, jnp.float32) for number in numbers))
        radiance, instance, depth = drawing.draw(view, shot, true.width, true.height, imaging_of.samples)
        exposure = imaging.Exposure(
            gain=2.0 * gains[frame, side],
            blur=blur[side] * true.width / 3376,
            vignetting=imaging_of.vignetting,
            full_well=imaging_of.full_well,
            read_noise=imaging_of.read_noise,
            noise=imaging_of.noise,
            seed=int(generator(family, self.plot.seed, f"noise {frame} {side}").integers(1 << 32)),
        )
        return imaging.expose(radiance, exposure), instance, depth
