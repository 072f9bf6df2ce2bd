"""Visibility of points in all pairs: pairs show a stalk at a point, or see through it to something farther away."""

import dataclasses

import numpy as np

from jaxrl_vis.stalks.grasping.perception.cloud import Cloud, Mount
from jaxrl_vis.stalks.grasping.perception.stitch import Motion
from jaxrl_vis_envs.plants import Calibration

_SAME = 0.02  # m: a pixel whose depth differs by less shows the point
_THROUGH = 0.035  # m: a pixel whose depth is greater by more sees through the point


@dataclasses.dataclass(frozen=True)
class Visibility:
    """Visibility of points in the stitched clouds of a run.

    Attributes:
        clouds: Cloud of each pair, in its own robot frame.
        to_last: Motion of each cloud to the robot frame of the last pair.
        calibration: Calibration of the pair.
        mount: Mount of the pair.
    """

    clouds: tuple[Cloud, ...]
    to_last: tuple[Motion, ...]
    calibration: Calibration
    mount: Mount

    def query(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return masks of the points at which pairs show a stalk, and of those that they see through.

        Both are False for points that are outside the image, occluded, or at pixels without depth.

        Args:
            points: [K, 3] in the robot frame of the last pair, m.

        Returns:
            Two [F, K] bool: shown, and seen through.
        """
        shown, through = np.zeros((2, len(self.clouds), len(points)), bool)
        for frame, (cloud, motion) in enumerate(zip(self.clouds, self.to_last)):
            x, y, z = self.mount.pose.to_camera(motion.inverse()(points)).T
            height, width = cloud.depth.shape
            with np.errstate(divide="ignore", invalid="ignore"):
                column = np.round(self.calibration.focal * x / z + self.calibration.centre[0])
                row = np.round(self.calibration.focal * y / z + self.calibration.centre[1])
                inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
            place = row[inside].astype(int), column[inside].astype(int)
            with np.errstate(invalid="ignore"):
                behind = cloud.depth[place] - z[inside]
                shown[frame, inside] = cloud.mask[place] & (np.abs(behind) < _SAME)
                through[frame, inside] = behind > _THROUGH
        return shown, through
