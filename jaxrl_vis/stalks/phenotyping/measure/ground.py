"""Ground plane of a stereo pair, the reference for heights of stalks.

Windows on a grid over the left image are matched in the right one. Disparity is linear in image coordinates on a plane, so the
ground is the plausible plane with the most inliers (RANSAC). If there are too few inliers, no ground is visible and heights are
unknown.
"""

import dataclasses
import math

import cv2
import numpy as np

from jaxrl_vis.stalks.phenotyping.measure.borders import find_frame
from jaxrl_vis_envs.plants import Calibration
from jaxrl_vis_envs.plants.truth import BAND

_FOCAL = 1084.0  # pixels: focal length of the downscaled images, in which the grain of the ground remains visible
_WINDOW = (5, 41)  # height and width in the downscaled image: flat, as the depth of the ground changes from row to row
_DEPTHS = (3.0, 0.45)  # m: maximum and minimum depth of matched windows
_COLUMNS, _ROWS = 32, 32  # numbers of windows horizontally and vertically
_MIN_SCORE = 0.7
_TOLERANCE = 0.7  # pixels of the downscaled image
_TRIES = 600
_CAMERA_HEIGHTS = (0.1, 2.0)  # m
_MAX_PITCH, _MAX_ROLL = math.radians(30.0), math.radians(12.0)
_MIN_WINDOWS = 30
_MIN_SPAN = 0.3  # minimum horizontal span of the inliers, as a fraction of the image's width
_MAX_BELOW = 0.1  # maximum fraction of windows below the ground, which are mismatches
_USUAL_HEIGHT = 0.42  # m: height of the cameras where no ground is found


@dataclasses.dataclass(frozen=True)
class Ground:
    """Ground plane in the left camera's frame: x to the right, y down, z forwards.

    Attributes:
        normal: [3], 1/m; a point lies on the plane if its dot product with ``normal`` is 1.
    """

    normal: tuple[float, float, float]

    @property
    def camera_height(self) -> float:
        """Height of the left camera above the ground, m."""
        return 1.0 / math.hypot(*self.normal)

    def height(self, column: float, row: float, depth: float, calibration: Calibration) -> float:
        """Return the height of a point above the ground, m.

        Args:
            column, row: Position in the left image, pixels.
            depth: Planar depth, m.
            calibration: Calibration of the cameras.
        """
        x = (column - calibration.centre[0]) / calibration.focal
        y = (row - calibration.centre[1]) / calibration.focal
        across, down, forwards = self.normal
        return (1.0 - depth * (across * x + down * y + forwards)) * self.camera_height

    def row(self, column: float, height: float, depth: float, calibration: Calibration) -> float:
        """Return the row of a point in a column at a ``height`` above the ground and a ``depth``, m; inverse of `height`."""
        x = (column - calibration.centre[0]) / calibration.focal
        across, down, forwards = self.normal
        y = ((1.0 - height / self.camera_height) / depth - across * x - forwards) / down
        return y * calibration.focal + calibration.centre[1]


def band_rows(ground: Ground | None, calibration: Calibration, distance: float, column: float) -> tuple[float, float, bool]:
    """Return the first and last image row of the band in a column of the left image, for stalks at a ``distance`` in m.

    Without a ground plane, cameras are assumed to be level and at their usual height, and the third value is False.
    """
    plane = ground or Ground((0.0, 1.0 / _USUAL_HEIGHT, 0.0))
    top, bottom = (plane.row(column, height, distance, calibration) for height in reversed(BAND))
    return top, bottom, ground is not None


def find_ground(
    left: np.ndarray,
    right: np.ndarray,
    calibration: Calibration,
    disparity: np.ndarray | None = None,
) -> Ground | None:
    """Find the ground plane of a pair; return None if it is not visible, or too little of it.

    Args:
        left, right: Rectified greyscale images [H, W], uint8 or float32.
        calibration: Calibration of the cameras, for images of this size.
        disparity: Known disparities [H, W] float32 to use instead of matching, pixels; NaN where unknown. None to match.
    """
    frame = find_frame(left)
    part = (slice(*frame.rows), slice(*frame.columns))
    left, right = left[part], right[part]
    disparity = None if disparity is None else disparity[part]
    scale = min(_FOCAL / calibration.focal, 1.0)
    if scale < 1.0:
        size = (round(left.shape[1] * scale), round(left.shape[0] * scale))
        left, right = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right))
    bounds = tuple(float(calibration.disparity(np.array(depth))) * scale for depth in _DEPTHS)
    if disparity is None:
        places, values = _match_windows(left, right, (bounds[0], bounds[1]))
    else:
        places, values = _samples(disparity, scale)
    if len(values) < _MIN_WINDOWS:
        return None
    focal = calibration.focal * scale
    corner = np.array([frame.columns[0], frame.rows[0]])
    centre = (np.array(calibration.centre) - corner + 0.5) * scale - 0.5
    # Inverse depth, which is linear in the rays to points of a plane; `unit` is the change per pixel of disparity.
    unit = 1.0 / (focal * calibration.baseline)
    rays = np.concatenate([(places - centre) / focal, np.ones((len(places), 1))], axis=1)
    inverse = (values - calibration.offset * scale) * unit
    fitted = _fit_plane(rays, inverse, _TOLERANCE * unit)
    if fitted is None:
        return None
    residual = inverse - rays @ fitted
    agree = np.abs(residual) < _TOLERANCE * unit
    facing = rays @ fitted > 0
    below = facing & (residual < -4.0 * _TOLERANCE * unit)
    span = float(np.ptp(places[agree, 0])) if agree.any() else 0.0
    if agree.sum() < _MIN_WINDOWS or span < _MIN_SPAN * left.shape[1] or below.sum() > _MAX_BELOW * facing.sum():
        return None
    return Ground((float(fitted[0]), float(fitted[1]), float(fitted[2])))


def _match_windows(left: np.ndarray, right: np.ndarray, bounds: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Match a grid of windows of the left image in the right one.

    Args:
        left, right: Rectified greyscale images [H, W], uint8 or float32.
        bounds: Minimum and maximum disparity, pixels.

    Returns:
        Centres (x, y) [N, 2] in the left image and disparities [N] of the windows with a clear match, pixels, float64.
    """
    tall, wide = _WINDOW
    height, width = left.shape
    low, high = math.floor(bounds[0]), math.ceil(bounds[1])
    columns = np.linspace(low + 1, width - wide - 1, _COLUMNS).astype(int)
    rows = np.linspace(1, height - tall - 1, _ROWS).astype(int)
    places, values = [], []
    for top in rows:
        for first in columns:
            window = left[top : top + tall, first : first + wide]
            begin, end = max(first - high - 1, 0), first - low + 1 + wide
            if float(window.max()) - float(window.min()) < 4.0 or end - begin <= wide + 2:
                continue
            score = cv2.matchTemplate(right[top - 1 : top + tall + 1, begin:end], window, cv2.TM_CCOEFF_NORMED).max(axis=0)
            column = int(np.argmax(score))
            if not score[column] >= _MIN_SCORE or column in (0, score.size - 1):
                continue
            before, at, after = score[column - 1 : column + 2]
            bend = before - 2.0 * at + after
            fraction = 0.0 if bend >= 0.0 else 0.5 * float(before - after) / float(bend)
            places.append((first + 0.5 * (wide - 1), top + 0.5 * (tall - 1)))
            values.append(first - (begin + column + fraction))
    return np.array(places, float).reshape(-1, 2), np.array(values, float)


def _samples(disparity: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Sample positions [N, 2] and disparities [N], as in `_match_windows`, from disparities [H, W] in full-size pixels."""
    rows, columns = (np.linspace(0, size - 1, 64).astype(int) for size in disparity.shape)
    values = disparity[np.ix_(rows, columns)]
    row, column = np.nonzero(np.isfinite(values))
    places = (np.stack([columns[column], rows[row]], axis=1) + 0.5) * scale - 0.5
    return places, values[row, column] * scale


def _fit_plane(rays: np.ndarray, inverse: np.ndarray, tolerance: float) -> np.ndarray | None:
    """Fit the plausible ground plane [3] (see `Ground.normal`) with the most inliers, by RANSAC; None if there is none.

    Args:
        rays: [N, 3], directions to points, with z = 1.
        inverse: [N], inverse planar depths of the points, 1/m.
        tolerance: Maximum error of an inlier's inverse depth, 1/m.
    """
    rng = np.random.default_rng(0)
    # Most of an image is not ground, but most of its lower third is: half of the samples come from there.
    low = np.flatnonzero(rays[:, 1] >= np.quantile(rays[:, 1], 2 / 3))
    triples = np.concatenate([rng.integers(len(rays), size=(_TRIES // 2, 3)), rng.choice(low, (_TRIES // 2, 3))])
    corners = rays[triples]
    good = np.abs(np.linalg.det(corners)) > 1e-4
    planes = np.linalg.solve(corners[good], inverse[triples[good]][..., None])[..., 0]
    planes = planes[_could_be_ground(planes)]
    if not len(planes):
        return None
    votes = (np.abs(rays @ planes.T - inverse[:, None]) < tolerance).sum(axis=0)
    best = planes[int(np.argmax(votes))]
    for _ in range(5):
        agree = np.abs(rays @ best - inverse) < tolerance
        if agree.sum() < 3:
            return None
        best = np.linalg.lstsq(rays[agree], inverse[agree], rcond=None)[0]
    return best if bool(_could_be_ground(best[None])[0]) else None


def _could_be_ground(planes: np.ndarray) -> np.ndarray:
    """Return [N] bool, True for planes [N, 3] that lie below the camera and are roughly level."""
    length = np.linalg.norm(planes, axis=1)
    height = 1.0 / np.maximum(length, 1e-9)
    roll = np.abs(np.arcsin(np.clip(planes[:, 0] / np.maximum(length, 1e-9), -1.0, 1.0)))
    pitch = np.abs(np.arctan2(planes[:, 2], planes[:, 1]))
    return (
        (height > _CAMERA_HEIGHTS[0])
        & (height < _CAMERA_HEIGHTS[1])
        & (planes[:, 1] > 0)
        & (pitch < _MAX_PITCH)
        & (roll < _MAX_ROLL)
    )
