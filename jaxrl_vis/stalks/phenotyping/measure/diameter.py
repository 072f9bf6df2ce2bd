"""From edges in pixels and a disparity to a diameter in millimetres.

The two edges of a round stalk are where rays from the camera touch it. With half the angle between them a, and the distance D
of its middle from the camera, its radius is D sin a. Stereo measures the distance of the front surface, D less the radius, so

    r = (distance of the front) * sin a / (1 - sin a)

Taking the front's distance for the middle's understates a diameter of 14 mm at 0.8 m by 0.9 %.
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
    """Diameter of a stalk across its axis.

    Args:
        calibration: Calibration of the cameras.
        left, right: Column and line of a point of each edge in the left image, pixels; they need not be opposite each other.
        front_depth: Planar depth of the stalk's front between them, m.
        lean: Angle between the stalk and the image's vertical, rad; positive to the right.
        tilt: Angle by which the stalk leans away from the camera, rad.

    Returns:
        Millimetres.
    """
    # The axis in the camera's frame, up along the image: columns to the right, lines down, depth forwards.
    axis = np.array([math.tan(lean), -1.0, math.tan(tilt)])
    axis /= np.linalg.norm(axis)
    rays = []
    for column, line in (left, right):
        ray = np.array([column - calibration.centre[0], line - calibration.centre[1], calibration.focal])
        ray -= (ray @ axis) * axis
        rays.append(ray / np.linalg.norm(ray))
    half = 0.5 * math.acos(min(max(float(rays[0] @ rays[1]), -1.0), 1.0))
    middle = np.array([0.5 * (left[0] + right[0]), 0.5 * (left[1] + right[1])])
    front = front_depth * np.array([*((middle - np.array(calibration.centre)) / calibration.focal), 1.0])
    front -= (front @ axis) * axis
    sine = math.sin(half)
    return 2e3 * float(np.linalg.norm(front)) * sine / (1.0 - sine)


def edge_tilt(slope: float, disparity: float, calibration: Calibration) -> float:
    """Angle in rad by which a stalk leans away from the camera.

    Args:
        slope: Change of its disparity per line of the left image, pixels.
        disparity: In the same place, pixels.
        calibration: Calibration of the cameras.
    """
    beyond = disparity - calibration.offset
    # Depth is f B / d and height Z / f per line, so that dZ / dheight = f slope / d, and lines count downwards.
    return math.atan(calibration.focal * slope / beyond) if beyond > 0 else 0.0
