"""Diameter of a stalk in millimetres from its edges in pixels and its depth.

The edges of a round stalk are where rays from the camera are tangent to it. If a is half the angle between these rays and D the
distance from the camera to the stalk's axis, its radius is D sin a. Stereo measures the distance of the front surface, D less
the radius, so

    r = (distance of the front) * sin a / (1 - sin a)

Using the distance of the front as that of the axis would underestimate a diameter of 14 mm at 0.8 m by 0.9 %.
"""

import math

import numpy as np

from jaxrl_vis_envs.plants import Calibration


def diameter_mm(
    calibration: Calibration,
    left: tuple[float, float],
    right: tuple[float, float],
    front_depth: float,
    lean: float = 0.0,
    tilt: float = 0.0,
) -> float:
    """Compute the diameter of a stalk perpendicular to its axis, mm.

    Args:
        calibration: Calibration of the cameras.
        left, right: A point (x, y) on each edge in the left image, pixels; they need not be opposite each other.
        front_depth: Planar depth of the stalk's front surface between the points, m.
        lean: Angle between the stalk and the vertical of the image, rad; positive to the right.
        tilt: Angle by which the stalk leans away from the camera, rad.
    """
    # Upward axis of the stalk in the camera's frame: x to the right, y down, z forwards.
    axis = np.array([math.tan(lean), -1.0, math.tan(tilt)])
    axis /= np.linalg.norm(axis)
    rays = []
    for column, row in (left, right):
        ray = np.array([column - calibration.centre[0], row - calibration.centre[1], calibration.focal])
        ray -= (ray @ axis) * axis
        rays.append(ray / np.linalg.norm(ray))
    half = 0.5 * math.acos(min(max(float(rays[0] @ rays[1]), -1.0), 1.0))
    middle = np.array([0.5 * (left[0] + right[0]), 0.5 * (left[1] + right[1])])
    front = front_depth * np.array([*((middle - np.array(calibration.centre)) / calibration.focal), 1.0])
    front -= (front @ axis) * axis
    sine = math.sin(half)
    return 2e3 * float(np.linalg.norm(front)) * sine / (1.0 - sine)


def tilt_from_disparity(slope: float, disparity: float, calibration: Calibration) -> float:
    """Compute the angle by which a stalk leans away from the camera, rad; 0 if the disparity is not positive.

    Args:
        slope: Change of its disparity per row of the left image, pixels.
        disparity: Disparity at the same point, pixels.
        calibration: Calibration of the cameras, whose offset is subtracted from the disparity.
    """
    beyond = disparity - calibration.offset
    # Depth is Z = f B / d, and a row spans a height of Z / f, so dZ / dheight = f slope / d as rows count downwards.
    return math.atan(calibration.focal * slope / beyond) if beyond > 0 else 0.0
