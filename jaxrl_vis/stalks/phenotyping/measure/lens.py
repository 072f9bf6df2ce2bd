"""Lenses with which counting and measuring was tried, by what their images show of a row: pixels per metre, and its height."""

import dataclasses

from jaxrl_vis_envs.plants import Calibration

UNTRIED = "untried lens"
"""Flag of a plot whose images show less of the row, or fewer pixels of it, than those that the networks were tried on."""


@dataclasses.dataclass(frozen=True)
class LensRange:
    """Range of lenses.

    Attributes:
        density: Least number of pixels per metre at the row.
        view: Least height of what an image shows at the row, m.
    """

    density: float
    view: float


TRIED = LensRange(density=640.0, view=0.68)
"""Range in which stalks are counted and measured as with the usual lens: 5 % beyond the last lenses of
`benchmarks.stalks.lenses` that were, as rows do not stand at 0.8 m exactly."""


def lens_fault(calibration: Calibration, distance: float, lines: int, tried: LensRange = TRIED) -> str | None:
    """Say in words why a lens is outside a range; None if it is within.

    Args:
        calibration: Calibration of the cameras.
        distance: Distance from the cameras to the row, m.
        lines: Number of lines of an image that show anything.
        tried: The range.
    """
    density = calibration.focal / distance
    view = lines / density
    if density < tried.density:
        return (
            f"{density:.0f} pixels per metre of a row {distance:.2f} m away, fewer than the {tried.density:.0f} that were "
            "tried: use images of more pixels, a longer lens or a smaller distance"
        )
    if view < tried.view:
        return (
            f"its images show {view:.2f} m from top to bottom of a row {distance:.2f} m away, less than the "
            f"{tried.view:.2f} m that were tried: use a wider lens or a greater distance"
        )
    return None
