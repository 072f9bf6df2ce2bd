"""Organised point clouds from stereo pairs and masks.

Robot frame: x along the row, 0 at the left camera; y away from the cameras, 0 at the left camera; z up, 0 at the ground. It
follows from the mount of the cameras, which is known up to the wobble of the robot.
"""

import dataclasses
import math

import cv2
import numpy as np

from jaxrl_vis_envs.plants import Calibration, Pose
from jaxrl_vis_envs.plants.cameras import looking_along_y
from jaxrl_vis_envs.plants.family import Rig

MASK_THRESHOLD = 0.5
"""Threshold of `redness` above which a pixel counts as painted."""


@dataclasses.dataclass(frozen=True)
class Mount:
    """Mount of the stereo pair, and the range of depths in which it is trusted.

    Attributes:
        height: Height of the left camera above the ground, m.
        pitch: Downward pitch of the cameras, degrees.
        nearest, farthest: Minimum and maximum planar depth, m; points beyond belong to the next row.
    """

    height: float = 1.0
    pitch: float = 15.0
    nearest: float = 0.22
    farthest: float = 0.95

    @classmethod
    def of(cls, rig: Rig) -> "Mount":
        """Return the nominal mount of a family's cameras."""
        return cls(rig.camera_height, rig.pitch, max(rig.distance - 0.33, 0.15), rig.distance + 0.4)

    @property
    def pose(self) -> Pose:
        """Pose of the left camera in the robot frame."""
        return Pose(np.array([0.0, 0.0, self.height]), looking_along_y(math.radians(self.pitch)))


@dataclasses.dataclass(frozen=True)
class Cloud:
    """Organised point cloud: one point for each pixel of the left image.

    Attributes:
        points: [H, W, 3] float32, in the robot frame of its own pair, m; NaN where there is no depth.
        depth: [H, W] float32, planar depth, m; NaN where there is none.
        mask: [H, W] bool, mask of stalks.
    """

    points: np.ndarray
    depth: np.ndarray
    mask: np.ndarray

    def all_points(self) -> np.ndarray:
        """Return all points with a depth, [N, 3] float32, m."""
        return self.points[np.isfinite(self.depth)]

    def stalk_points(self) -> np.ndarray:
        """Return the points of stalks with a depth, [N, 3] float32, m."""
        return self.points[self.mask & np.isfinite(self.depth)]


def redness(image: np.ndarray) -> np.ndarray:
    """Return the redness of RGB pixels [..., 3] uint8: red minus the maximum of green and blue.

    Returns:
        [...] float32, 1 for pure red, 0 for grey, negative where green or blue exceed red.
    """
    values = image.astype(np.float32) / 255.0
    return values[..., 0] - np.maximum(values[..., 1], values[..., 2])


def compute_disparity(left: np.ndarray, right: np.ndarray, calibration: Calibration, mount: Mount) -> np.ndarray:
    """Compute the disparities of a whole pair by semi-global matching.

    Args:
        left, right: [H, W, 3] or [H, W] uint8, rectified.
        calibration: Calibration of the pair.
        mount: Mount of the pair, with the range of depths to search.

    Returns:
        [H, W] float32, pixels; NaN where nothing matches.
    """
    nearest, farthest = calibration.disparity(np.array([mount.nearest, mount.farthest]))
    low = math.floor(farthest)
    count = max(-(-(math.ceil(nearest) - low + 1) // 16) * 16, 16)
    grey = [image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right)]
    # Without padding, columns at the left edge could not be matched over the whole range of disparities.
    padded = [cv2.copyMakeBorder(image, 0, 0, low + count, 0, cv2.BORDER_CONSTANT) for image in grey]
    matcher = cv2.StereoSGBM_create(
        minDisparity=low,
        numDisparities=count,
        blockSize=_BLOCK_SIZE,
        P1=_SMALL_STEP * _BLOCK_SIZE**2,
        P2=_LARGE_STEP * _BLOCK_SIZE**2,
        disp12MaxDiff=1,
        uniquenessRatio=5,
        preFilterCap=31,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    disparity = matcher.compute(*padded)[:, low + count :].astype(np.float32) / 16.0
    return np.where(disparity >= low, disparity, np.float32(np.nan))


_BLOCK_SIZE = 5
_SMALL_STEP, _LARGE_STEP = 4, 24
"""Smoothness penalties for disparity changes of one pixel and of more, per pixel of a block."""


def build_cloud(disparity: np.ndarray, mask: np.ndarray, calibration: Calibration, mount: Mount) -> Cloud:
    """Build the organised cloud of a pair; depths outside the mount's range become NaN.

    Args:
        disparity: [H, W] float32, pixels; NaN where there is none.
        mask: [H, W] bool, mask of stalks.
        calibration: Calibration of the pair.
        mount: Mount of the pair.
    """
    with np.errstate(invalid="ignore"):
        depth = calibration.depth(disparity).astype(np.float32)
        depth = np.where((depth >= mount.nearest) & (depth <= mount.farthest), depth, np.float32(np.nan))
    height, width = depth.shape
    x = ((np.arange(width) - calibration.centre[0]) / calibration.focal).astype(np.float32)
    y = ((np.arange(height) - calibration.centre[1]) / calibration.focal).astype(np.float32)
    rays = np.stack([*np.broadcast_arrays(x[None, :], y[:, None]), np.ones((height, width), np.float32)], axis=-1)
    pose = mount.pose
    points = rays @ pose.rotation.astype(np.float32) * depth[..., None] + pose.position.astype(np.float32)
    return Cloud(points, depth, mask)


def subsample(points: np.ndarray, size: float) -> np.ndarray:
    """Downsample points on a voxel grid: return the mean of the points in each occupied voxel.

    Args:
        points: [N, 3], m.
        size: Edge of a voxel, m.

    Returns:
        [V, 3] float64, m.
    """
    if not len(points):
        return points
    cell = np.floor(points / size).astype(np.int64)
    cell -= cell.min(axis=0)
    extent = cell.max(axis=0) + 1
    index = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    _, place, count = np.unique(index, return_inverse=True, return_counts=True)
    sums = [np.bincount(place, points[:, axis], len(count)) for axis in range(3)]
    return np.stack(sums, axis=1) / count[:, None]
