"""Stereo camera pair: poses, projection and calibration. NumPy only.

Camera frame: x to the right of the image, y down, z forwards. The cameras look along the world's y axis and move along its x
axis; the right one is a baseline further along. Both are rectified: a point at (X, Y, Z) in the left camera's frame projects to
column centre + f X / Z in the left image and a disparity f B / Z further left in the right one, in the same row up to a small
error. The centre of the first pixel (column 0, row 0) is at (0.0, 0.0).
"""

import dataclasses
import math

import numpy as np

from jaxrl_vis_envs.plants.family import Family, Rig
from jaxrl_vis_envs.plants.field import generator
from jaxrl_vis_envs.plants.scene import Scene


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Calibration of a pair of rectified cameras. Both images have the same size.

    Attributes:
        width, height: Image size, pixels.
        focal: Focal length, pixels.
        centre: Column and row of the left camera's principal point, pixels.
        baseline: Distance between the cameras, m.
        offset: Disparity at infinite depth, pixels: the column of the left principal point minus that of the right one.
    """

    width: int
    height: int
    focal: float
    centre: tuple[float, float]
    baseline: float
    offset: float = 0.0

    def depth(self, disparity: np.ndarray) -> np.ndarray:
        """Convert disparities in pixels, of any shape, to planar depth in m; infinite for invalid disparities."""
        beyond = np.asarray(disparity) - self.offset
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(beyond > 0, self.focal * self.baseline / beyond, np.inf)

    def disparity(self, depth: np.ndarray) -> np.ndarray:
        """Convert planar depths in m, of any shape, to disparities in pixels."""
        return self.focal * self.baseline / np.asarray(depth) + self.offset


@dataclasses.dataclass(frozen=True)
class Pose:
    """Pose of the left camera for one pair.

    Attributes:
        position: [3] float64, in the world, m.
        rotation: [3, 3] float64, from the world's axes to the camera's.
    """

    position: np.ndarray
    rotation: np.ndarray

    def to_camera(self, points: np.ndarray) -> np.ndarray:
        """Transform points [..., 3] from the world to the left camera's frame, m."""
        return (points - self.position) @ self.rotation.T

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Transform points [..., 3] from the left camera's frame to the world, m."""
        return points @ self.rotation + self.position


@dataclasses.dataclass(frozen=True)
class Drive:
    """Trajectory of the cameras past one plot.

    Attributes:
        true: Actual calibration of the cameras.
        stated: Calibration as known to users, with its errors.
        poses: Actual pose of the left camera for each of F pairs.
        times: [F] float64, times of the pairs, s.
        odometry: [F] float64, distance along the row reported by the robot, m, from 0.
        vertical_offset: Downward offset of the right image, pixels.
        vertical_slope: Change of this offset per column, pixels.
    """

    true: Calibration
    stated: Calibration
    poses: tuple[Pose, ...]
    times: np.ndarray
    odometry: np.ndarray
    vertical_offset: float
    vertical_slope: float


def drive(family: Family, seed: int) -> Drive:
    """Sample the trajectory of a family's cameras past its plot of this seed; it begins and ends half a step inside the
    stretch.

    Raises:
        ValueError: The seed is not an integer of at least 0.
    """
    rig = family.rig
    rng = generator(family, seed, "drive")
    focal, baseline = (
        nominal * (1.0 + rng.uniform(-rig.stated_spread, rig.stated_spread)) for nominal in (rig.focal, rig.baseline)
    )
    centre = ((rig.width - 1) / 2.0, (rig.height - 1) / 2.0)
    true = Calibration(rig.width, rig.height, focal, centre, baseline)
    errors = 1.0 + rig.calibration_error * rng.choice([-1.0, 1.0], 2)
    stated = dataclasses.replace(true, focal=focal * errors[0], baseline=baseline * errors[1])

    length = rig.stretch or family.layout.plot_length
    begin = 0.5 * (family.layout.plot_length - length)
    along = begin + length / rig.frames * (np.arange(rig.frames) + 0.5)
    height = rig.camera_height + rig.camera_height_sd * rng.normal() + rig.wobble * rng.normal(size=rig.frames)
    distance = rig.distance + rig.distance_sd * rng.normal() + rig.wobble * rng.normal(size=rig.frames)
    pitch = math.radians(rig.pitch) + math.radians(rig.pitch_sd) * (rng.normal() + 0.2 * rng.normal(size=rig.frames))
    positions = np.stack([along - baseline / 2.0, -distance, height], axis=1)
    poses = tuple(Pose(position, looking_along_y(angle)) for position, angle in zip(positions, pitch))
    if family.scene.share > 0:
        signs = generator(family, seed, "turn").choice([-1.0, 1.0], 2)
        poses = tuple(_rotate_pose(pose, family.scene, signs, family.rig.distance) for pose in poses)

    scale = 1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(*rig.odometry_noise)
    reported = (along - along[0]) * scale + 0.0005 * rng.normal(size=rig.frames) * (np.arange(rig.frames) > 0)
    pixels = rig.width / Rig().width
    offset, slope = (
        rig.rectification_error * pixels * rng.normal(),
        0.5 * rig.rectification_error * pixels * rng.normal() / rig.width,
    )
    return Drive(true, stated, poses, (along - begin) / rig.speed, reported, offset, slope)


def _rotate_pose(pose: Pose, scene: Scene, signs: np.ndarray, distance: float) -> Pose:
    """Turn a camera about the vertical through the point of the row that it looks at, and roll it about its optical axis."""
    yaw, roll = (math.radians(sign * angle) for sign, angle in zip(signs, (scene.yaw[0], scene.roll[0])))
    about = np.array([[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    pivot = pose.position + np.array([0.0, distance, 0.0])
    rolled = np.array([[math.cos(roll), -math.sin(roll), 0.0], [math.sin(roll), math.cos(roll), 0.0], [0.0, 0.0, 1.0]])
    return Pose(pivot + about @ (pose.position - pivot), rolled @ pose.rotation @ about.T)


def looking_along_y(pitch: float) -> np.ndarray:
    """Return the rotation [3, 3] of a camera that looks along the world's y axis, pitched down by ``pitch`` (rad)."""
    sine, cosine = math.sin(pitch), math.cos(pitch)
    return np.array([[1.0, 0.0, 0.0], [0.0, -sine, -cosine], [0.0, cosine, -sine]])
