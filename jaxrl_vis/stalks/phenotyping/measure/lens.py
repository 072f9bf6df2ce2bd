"""Range of lenses validated for counting and measuring: resolution and vertical field of view at the row of plants."""

import dataclasses

from jaxrl_vis_envs.plants import Calibration

UNTRIED = "untried lens"
"""Flag of a plot whose images have a smaller field of view or a lower resolution at the plants than the validated range."""


@dataclasses.dataclass(frozen=True)
class LensRange:
    """Range of lenses.

    Attributes:
        pixels_per_metre: Minimum resolution at the row of plants, pixels per metre.
        view: Minimum vertical field of view at the row of plants, m.
    """

    pixels_per_metre: float
    view: float


VALIDATED = LensRange(pixels_per_metre=640.0, view=0.68)
"""Range in which counts and widths are as good as with the standard lens: 5 % beyond the last such lenses of
`benchmarks.stalks.lenses`, as rows are not exactly 0.8 m away."""


def lens_fault(calibration: Calibration, distance: float, height: int, validated: LensRange = VALIDATED) -> str | None:
    """Return a message on why a lens is outside a range; None if it is within.

    Args:
        calibration: Calibration of the cameras.
        distance: Distance from the cameras to the row of plants, m.
        height: Height of the images without black borders, pixels.
        validated: Range of validated lenses.
    """
    pixels_per_metre = calibration.focal / distance
    view = height / pixels_per_metre
    if pixels_per_metre < validated.pixels_per_metre:
        return (
            f"{pixels_per_metre:.0f} pixels per metre of a row {distance:.2f} m away, fewer than the "
            f"{validated.pixels_per_metre:.0f} that were tried: use images of more pixels, a longer lens or a smaller distance"
        )
    if view < validated.view:
        return (
            f"its images show {view:.2f} m from top to bottom of a row {distance:.2f} m away, less than the "
            f"{validated.view:.2f} m that were tried: use a wider lens or a greater distance"
        )
    return None
