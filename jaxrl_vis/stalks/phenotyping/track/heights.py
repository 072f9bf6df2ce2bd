"""Widths of stalks at stated heights above the ground, 12 and 24 inches, and the taper between them.

A stalk is measured as near to a height as its edges are seen. Where that is not quite there, taper makes up for the rest: how
much thinner stalks become from inch to inch, by the stalks of the same plot that were measured at both heights.
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
"""mm per inch: of the thesis, for plots with too few stalks that were measured at both heights."""
_TAPER_SPREAD = 0.3  # of a stalk's own taper about the plot's, of 1
_MIN_SIGHTINGS = 5
_MIN_CLEAR = 3  # sightings without a hidden edge that make others unnecessary
_LOWER_BOUNDS = 0.85
# What pairs do not disagree about, so that their scatter does not tell it: by the errors of synthetic stalks.
_MASK_ERROR = 0.7  # pixels: masks err alike on one texture
_HIDING_ERROR = 0.8  # mm, where all pairs may hide an edge
_CALIBRATION_ERROR = 0.005  # of the width: focal length and baseline of a good calibration
_FEW = 2.0  # pairs: few of them scatter by less than many would
_FURTHEST = 4.0 * INCH  # m: what was measured further away says nothing of a height
_NEAR_HEIGHT = 0.5 * INCH  # m: taper within that does not matter
_ASIDE = (
    20.0  # degrees beside the cameras' axis: from there another side of an oval stalk is seen than the one that faces the row
)


@dataclasses.dataclass(frozen=True)
class Width:
    """Diameter of a stalk by all its sightings.

    Attributes:
        mm: Weighted median.
        error: Its standard error, mm: of the scatter between pairs, of masks that err alike in all of them, of hidden edges,
            and of a good calibration. Intervals of twice that cover about 95 % of synthetic stalks.
        scatter: Standard error of the scatter between pairs alone, mm, and at least what edges and disparity tell.
        count: Number of sightings.
        corrected: Most of them were measured elsewhere, so that taper had to make up for it.
    """

    mm: float
    error: float
    scatter: float
    count: int
    corrected: bool = False


@dataclasses.dataclass(frozen=True)
class StalkWidths:
    """One stalk.

    Attributes:
        lower: At 12 inches, or where it was seen if ``height_known`` is false.
        upper: At 24 inches.
        taper: Between them, mm per inch; None unless both were measured.
        height_known: A pair that shows the stalk shows the ground.
    """

    lower: Width | None
    upper: Width | None
    taper: float | None
    height_known: bool


def stalk_widths(frames: list[list[Sighting]], tracks: list[Track]) -> list[StalkWidths]:
    """Widths of the stalks of a plot, in the order of their tracks."""
    of_stalks = [[frames[frame][place] for frame, place in track.sightings] for track in tracks]
    first = [_of_stalk(sightings, USUAL_TAPER) for sightings in of_stalks]
    tapers = [width.taper for width in first if width.taper is not None]
    taper = float(np.median(tapers)) if len(tapers) >= _MIN_SIGHTINGS else USUAL_TAPER
    return [_of_stalk(sightings, taper) for sightings in of_stalks]


@dataclasses.dataclass(frozen=True)
class _Value:
    """Width in one pair.

    Attributes:
        mm, deviation: Diameter and its standard error, mm.
        height: Of the measurement, m.
        confidence: Weight.
        hidden: An edge may be hidden.
        pixel: Length of a pixel there, mm.
    """

    mm: float
    deviation: float | None
    height: float
    confidence: float
    hidden: bool
    pixel: float


def _of_stalk(sightings: list[Sighting], taper: float) -> StalkWidths:
    known = [
        _Value(
            e.diameter_mm, e.deviation_mm, e.height_m, e.confidence * _facing(e), e.hidden, _pixel(e.diameter_mm, e.width_px)
        )
        for e in sightings
        if e.diameter_mm is not None and e.height_m is not None
    ]
    above = [
        _Value(
            e.upper_mm,
            e.upper_deviation_mm,
            e.upper_height_m,
            e.upper_confidence * _facing(e),
            e.upper_hidden,
            _pixel(e.upper_mm, None if e.upper_place is None else e.upper_place[2]),
        )
        for e in sightings
        if e.upper_mm is not None and e.upper_height_m is not None
    ]
    lower, upper = _at(LOWER, known, taper), _at(UPPER, above, taper)
    if lower is None:
        return StalkWidths(robust_width(sightings), upper, None, False)
    own = None if upper is None else (lower.mm - upper.mm) / ((UPPER - LOWER) / INCH)
    return StalkWidths(lower, upper, own, True)


def _pixel(mm: float, pixels: float | None) -> float:
    """Return the length of a pixel, mm, at a stalk that is so wide; 0 where nobody knows."""
    return mm / pixels if pixels else 0.0


def _facing(sighting: Sighting) -> float:
    """Return the weight of a sighting for the side of a stalk that faces the row, 0 to 1."""
    return 1.0 if sighting.ray_deg is None else math.exp(-((sighting.ray_deg / _ASIDE) ** 2))


def _at(height: float, values: list[_Value], taper: float) -> Width | None:
    """Width at a height in m."""
    near, far = [], 0
    for value in values:
        beside = (value.height - height) / INCH
        if abs(value.height - height) > _FURTHEST:
            continue
        error = math.hypot(value.deviation or 0.0, _TAPER_SPREAD * taper * beside)
        near.append(dataclasses.replace(value, mm=value.mm + taper * beside, deviation=error))
        far += abs(value.height - height) > _NEAR_HEIGHT
    width = _robust(near)
    return None if width is None else dataclasses.replace(width, corrected=2 * far > len(near))


def robust_width(sightings: list[Sighting]) -> Width | None:
    """Diameter of a stalk wherever it was measured; None if it never was."""
    return _robust(
        [
            _Value(e.diameter_mm, e.deviation_mm, 0.0, e.confidence * _facing(e), e.hidden, _pixel(e.diameter_mm, e.width_px))
            for e in sightings
            if e.diameter_mm is not None
        ]
    )


def _robust(values: list[_Value]) -> Width | None:
    """The median of what shows both edges; None where there is nothing.

    Where too little does, a stalk is at least as thick as it looks, and most of what is said of it is too thin.
    """
    clear = [value for value in values if not value.hidden]
    some, share = (clear, 0.5) if len(clear) >= _MIN_CLEAR or len(clear) == len(values) else (values, _LOWER_BOUNDS)
    if not some:
        return None
    widths, stated, weights = np.array([(value.mm, value.deviation or 0.0, value.confidence) for value in some]).T
    weights = np.maximum(weights, 0.02)
    order = np.argsort(widths)
    passed = np.cumsum(weights[order]) - 0.5 * weights[order]
    middle = float(np.interp(share * weights.sum(), passed, widths[order]))
    enough = float(weights.sum() ** 2 / (weights**2).sum())
    scatter = 1.4826 * float(np.median(np.abs(widths - middle))) * 1.2533 if len(widths) > 2 else 0.0
    least = math.sqrt(float((weights * stated**2).sum() / weights.sum()))
    of_pairs = max(scatter, least) / math.sqrt(enough)
    error = math.hypot(
        of_pairs * math.sqrt(1.0 + _FEW / len(widths)),
        _MASK_ERROR * float(np.median([value.pixel for value in some])),
        _HIDING_ERROR * (1.0 - len(clear) / len(values)),
        _CALIBRATION_ERROR * middle,
    )
    return Width(middle, error, of_pairs, len(widths))
