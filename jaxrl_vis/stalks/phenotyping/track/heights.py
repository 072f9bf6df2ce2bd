"""Widths of stalks at 12 and 24 inches above the ground, and the taper between them.

A stalk is measured as near to a height as its edges are visible. Widths measured at another height are corrected by the taper,
the decrease in width per inch: the median over stalks of the same plot that were measured at both heights.

Of a stalk with an occluded edge in all pairs, a sliver may be all that was measured; the plot's other widths replace it.
"""

import dataclasses
import math

import numpy as np

from jaxrl_vis.stalks.phenotyping.track.follow import Track
from jaxrl_vis.stalks.phenotyping.track.sightings import Sighting
from jaxrl_vis_envs.plants.family import INCH
from jaxrl_vis_envs.plants.truth import HEIGHTS

LOWER, UPPER = HEIGHTS
USUAL_TAPER = 0.405
"""Taper of the thesis, mm per inch, for plots with too few stalks measured at both heights."""
_TAPER_SPREAD = 0.3  # relative standard deviation of the taper of stalks within a plot
_MIN_SIGHTINGS = 5
_OCCLUDED_QUANTILE = 0.85  # of measurements with an occluded edge, which are lower bounds
_OCCLUDED_WEIGHT = 4.0  # factor of their weights: their confidence, a tenth of others', is that of a diameter, not of a bound
# Errors common to all pairs, which their scatter does not show; estimated on synthetic stalks.
_MASK_ERROR = 0.7  # pixels: bias of masks on one texture
_OCCLUSION_ERROR = 1.5  # mm, if an edge may be occluded in all pairs
_CLEAR, _OCCLUDED = 0.5, 0.9  # shares of occluded measurements below and above which a width is clear and a lower bound
_SLIVER = 0.4  # lower bounds below this fraction of the median of the plot's clear widths are slivers
_CALIBRATION_ERROR = 0.005  # relative: focal length and baseline of a good calibration
_FEW = 2.0  # pairs: correction for the underestimated scatter of few pairs
_MAX_OFFSET = 4.0 * INCH  # m: maximum distance of a measurement from a height
_NEAR_HEIGHT = 0.5 * INCH  # m: distance within which the taper correction is negligible
_ASIDE = 20.0  # degrees off the cameras' axis at which the weight is 1/e: from aside, oval stalks show another side


@dataclasses.dataclass(frozen=True)
class Width:
    """Diameter of a stalk, estimated from all its sightings.

    Attributes:
        mm: Weighted median of the diameters, mm; those with an occluded edge count as lower bounds. For a sliver, the median of
            the plot's clear widths.
        error: Standard error, mm: from the scatter between pairs, the common bias of masks, occluded edges, and a good
            calibration. Intervals of +/- 2 standard errors cover about 95 % of synthetic stalks.
        scatter: Standard error from the scatter between pairs alone, mm, at least that from the errors of edges and disparity.
        count: Number of sightings that were used.
        occluded: Share of sightings with an occluded edge in the sum of weights, 0 to 1.
        corrected: True if most of them were measured at another height and corrected by the taper.
    """

    mm: float
    error: float
    scatter: float
    count: int
    occluded: float
    corrected: bool = False


@dataclasses.dataclass(frozen=True)
class StalkWidths:
    """Widths of one stalk.

    Attributes:
        lower: Width at 12 inches, or wherever it was measured if ``height_known`` is False; None if not measured.
        upper: Width at 24 inches; None if not measured.
        height_known: True if ``lower`` is a width at 12 inches, which requires a pair that shows both the stalk and the ground.
    """

    lower: Width | None
    upper: Width | None
    height_known: bool

    @property
    def taper(self) -> float | None:
        """Decrease in width between both heights, mm per inch; None unless both were measured."""
        if self.lower is None or self.upper is None or not self.height_known:
            return None
        return (self.lower.mm - self.upper.mm) / ((UPPER - LOWER) / INCH)


def stalk_widths(frames: list[list[Sighting]], tracks: list[Track]) -> list[StalkWidths]:
    """Estimate the widths of the stalks of a plot, in the order of their tracks.

    Args:
        frames: Sightings of each pair.
        tracks: Tracks of the stalks, whose indices refer to ``frames``.
    """
    of_stalks = [[frames[frame][place] for frame, place in track.sightings] for track in tracks]
    first = [_widths_of_stalk(sightings, USUAL_TAPER) for sightings in of_stalks]
    tapers = [width.taper for width in first if width.taper is not None]
    taper = float(np.median(tapers)) if len(tapers) >= _MIN_SIGHTINGS else USUAL_TAPER
    measured = [_widths_of_stalk(sightings, taper) for sightings in of_stalks]
    lower = _replace_slivers([width.lower for width in measured])
    return [dataclasses.replace(width, lower=mended) for width, mended in zip(measured, lower)]


@dataclasses.dataclass(frozen=True)
class _WidthMeasurement:
    """Diameter measured in one pair.

    Attributes:
        mm, deviation: Diameter and its standard error, mm; the error is None if unknown.
        height: Height of the measurement above the ground, m.
        confidence: Weight of the measurement.
        occluded: True if an edge may be occluded.
        pixel: Size of a pixel at the stalk, mm; 0 if unknown.
    """

    mm: float
    deviation: float | None
    height: float
    confidence: float
    occluded: bool
    pixel: float


def _widths_of_stalk(sightings: list[Sighting], taper: float) -> StalkWidths:
    known = [_lower_measurement(e, e.height_m) for e in sightings if e.diameter_mm is not None and e.height_m is not None]
    above = [
        _WidthMeasurement(
            e.upper_mm,
            e.upper_deviation_mm,
            e.upper_height_m,
            e.upper_confidence * _view_weight(e),
            e.upper_occluded,
            e.upper_mm / e.upper_place[2] if e.upper_place and e.upper_place[2] else 0.0,
        )
        for e in sightings
        if e.upper_mm is not None and e.upper_height_m is not None
    ]
    lower, upper = _width_at(LOWER, known, taper), _width_at(UPPER, above, taper)
    return StalkWidths(robust_width(sightings), upper, False) if lower is None else StalkWidths(lower, upper, True)


def _lower_measurement(sighting: Sighting, height: float) -> _WidthMeasurement:
    """Return the measurement around 12 inches of a sighting that has one, with its height in m."""
    mm, weight = sighting.diameter_mm, sighting.confidence * _view_weight(sighting)
    assert mm is not None
    pixel = mm / sighting.width_px if sighting.width_px else 0.0
    return _WidthMeasurement(mm, sighting.deviation_mm, height, weight, sighting.occluded, pixel)


def _replace_slivers(widths: list[Width | None]) -> list[Width | None]:
    """Replace the widths of slivers by the median of the plot's clear widths, with their standard deviation as the error."""
    clear = [width.mm for width in widths if width is not None and width.occluded < _CLEAR]
    if len(clear) < _MIN_SIGHTINGS:
        return widths
    usual, spread = float(np.median(clear)), float(np.std(clear))
    return [
        width
        if width is None or width.occluded <= _OCCLUDED or width.mm >= _SLIVER * usual
        else dataclasses.replace(width, mm=usual, error=spread)
        for width in widths
    ]


def _view_weight(sighting: Sighting) -> float:
    """Return the weight of a sighting by its viewing angle, 0 to 1; 1 if the angle is unknown."""
    return 1.0 if sighting.ray_deg is None else math.exp(-((sighting.ray_deg / _ASIDE) ** 2))


def _width_at(height: float, values: list[_WidthMeasurement], taper: float) -> Width | None:
    """Estimate the width at a height in m, corrected by the ``taper`` in mm per inch; None if nothing was measured near it."""
    near, far = [], 0
    for value in values:
        inches = (value.height - height) / INCH
        if abs(value.height - height) > _MAX_OFFSET:
            continue
        error = math.hypot(value.deviation or 0.0, _TAPER_SPREAD * taper * inches)
        near.append(dataclasses.replace(value, mm=value.mm + taper * inches, deviation=error))
        far += abs(value.height - height) > _NEAR_HEIGHT
    width = _combine(near)
    return None if width is None else dataclasses.replace(width, corrected=2 * far > len(near))


def robust_width(sightings: list[Sighting]) -> Width | None:
    """Estimate the diameter of a stalk from sightings at any height; None if it was never measured."""
    return _combine([_lower_measurement(sighting, 0.0) for sighting in sightings if sighting.diameter_mm is not None])


def _combine(values: list[_WidthMeasurement]) -> Width | None:
    """Estimate a width as the weighted median of its measurements; None if there are none.

    Those with an occluded edge are lower bounds and count with their 0.85 quantile: the sum of quantile losses is minimised.
    """
    if not values:
        return None
    widths, stated, weights = np.array([(value.mm, value.deviation or 0.0, value.confidence) for value in values]).T
    occluded = np.array([value.occluded for value in values])
    weights = np.maximum(weights, 0.02) * np.where(occluded, _OCCLUDED_WEIGHT, 1.0)
    middle = _joint_quantile(widths, weights, np.where(occluded, _OCCLUDED_QUANTILE, 0.5))
    enough = float(weights.sum() ** 2 / (weights**2).sum())
    share = float(weights[occluded].sum() / weights.sum())
    scatter = 1.4826 * float(np.median(np.abs(widths - middle))) * 1.2533 if len(widths) > 2 else 0.0
    mean_error = math.sqrt(float((weights * stated**2).sum() / weights.sum()))
    of_pairs = max(scatter, mean_error) / math.sqrt(enough)
    error = math.hypot(
        of_pairs * math.sqrt(1.0 + _FEW / len(widths)),
        _MASK_ERROR * float(np.median([value.pixel for value in values])),
        _OCCLUSION_ERROR * share,
        _CALIBRATION_ERROR * middle,
    )
    return Width(middle, error, of_pairs, len(widths), share)


def _joint_quantile(values: np.ndarray, weights: np.ndarray, quantiles: np.ndarray) -> float:
    """Return the minimiser of weighted quantile losses, interpolated as a weighted median; arrays [N] float64."""
    order = np.argsort(values)
    below, above = (weights * (1.0 - quantiles))[order], (weights * quantiles)[order]
    # The slope of the loss halfway through the step at each value.
    slope = np.cumsum(below) - 0.5 * below - (above.sum() - np.cumsum(above) + 0.5 * above)
    return float(np.interp(0.0, slope, values[order]))
