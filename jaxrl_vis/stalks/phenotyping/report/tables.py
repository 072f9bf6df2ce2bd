"""Tidy result tables: one row per stalk and one row per plot, with units in the column names."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.host.spreadsheets import to_csv
from jaxrl_vis.stalks.phenotyping.track.follow import RobotPath, Track
from jaxrl_vis.stalks.phenotyping.track.heights import StalkWidths, stalk_widths
from jaxrl_vis.stalks.phenotyping.track.sightings import Sighting

STALK_COLUMNS = (
    "plot",
    "stalk",
    "position_m",
    "depth_m",
    "width_mm",
    "width_se_mm",
    "height_in",
    "width_24in_mm",
    "width_24in_se_mm",
    "taper_mm_per_in",
    "lean_deg",
    "frames",
    "frames_measured",
    "confidence",
    "flag",
    "method",
    "version",
)
PLOT_COLUMNS = (
    "plot",
    "pairs",
    "pairs_skipped",
    "length_m",
    "stalks",
    "stalks_per_m",
    "width_mean_mm",
    "width_sd_mm",
    "width_se_mm",
    "width_24in_mean_mm",
    "taper_mean_mm_per_in",
    "stalks_measured",
    "flag",
    "method",
    "version",
)
Row = dict[str, Any]
_MIN_SEEN = 0.95  # minimum fraction of the row that pairs must show for a count
_MAX_ERROR = 0.08  # of a width: maximum scatter between pairs before it is uncertain
NO_GROUND = "no visible ground"
"""Flag of widths at an unknown height, as the ground was not seen."""
NO_ROW = "nothing like a row seen"
"""Flag of a plot without counted stalks: it is empty, or its images differ from the training images."""
PARTLY_SEEN = "part of the row not seen"
"""Flag of a plot without a count, as no pair shows some part of the row."""
FEW_FRAMES = "few frames"
"""Flag of a width measured in fewer than three pairs, and of a plot in which most widths are."""
SKIPPED = "pairs skipped"
"""Flag of a plot with pairs that could not be used."""
NO_WIDTHS = "no widths"
"""Flag of a plot with stalks, none of which could be measured."""
UNFAMILIAR = "unlike what the networks know"
"""Flag of a plot for which the gate doubts the detections in most images."""


@dataclasses.dataclass(frozen=True)
class Origin:
    """Values common to all rows of a plot.

    Attributes:
        plot: Name of the plot.
        method: Method of measuring widths.
        version: Version of the software.
    """

    plot: str
    method: str
    version: str


def plot_rows(
    frames: list[list[Sighting]], tracks: list[Track], path: RobotPath, skipped: int, origin: Origin
) -> tuple[list[Row], Row]:
    """Compute the rows of the counted stalks of one plot, in the order of ``tracks``, and the plot's own row.

    Values are text or integers, and empty text if unknown.

    Args:
        frames: Sightings of each pair.
        tracks: Tracks of the plot; only counted ones give rows.
        path: Path of the robot.
        skipped: Number of pairs that could not be used.
        origin: Values common to all rows.
    """
    stalks: list[Row] = []
    counted = [track for track in tracks if track.counted]
    for track, widths in zip(counted, stalk_widths(frames, counted)):
        sightings = [frames[frame][place] for frame, place in track.sightings]
        leans = [sighting.lean_deg for sighting in sightings if sighting.lean_deg is not None]
        confidence = float(np.median([sighting.confidence for sighting in sightings]))
        lower, upper = widths.lower, widths.upper
        stalks.append(
            {
                "plot": origin.plot,
                "stalk": len(stalks) + 1,
                "position_m": _format_number(track.position_m - path.positions[0], 4),
                "depth_m": _format_number(track.depth_m, 4),
                "width_mm": "" if lower is None else _format_number(lower.mm, 3),
                "width_se_mm": "" if lower is None else _format_number(lower.error, 3),
                "height_in": 12 if widths.height_known else "",
                "width_24in_mm": "" if upper is None else _format_number(upper.mm, 3),
                "width_24in_se_mm": "" if upper is None else _format_number(upper.error, 3),
                "taper_mm_per_in": "" if widths.taper is None else _format_number(widths.taper, 3),
                "lean_deg": _format_number(float(np.median(leans)), 1) if leans else "",
                "frames": len(sightings),
                "frames_measured": 0 if lower is None else lower.count,
                "confidence": _format_number(confidence, 3),
                "flag": _flag(widths, confidence),
                "method": origin.method,
                "version": origin.version,
            }
        )
    return stalks, _plot_row(stalks, len(frames), path, skipped, origin)


def _flag(widths: StalkWidths, confidence: float) -> str:
    """Return the flag of a stalk, the main reservation about its width; ``ok`` if there is none."""
    if widths.lower is None:
        return "no width"
    if not widths.height_known:
        return NO_GROUND
    if widths.lower.count < 3:
        return FEW_FRAMES
    if confidence < 0.3 or widths.lower.scatter > _MAX_ERROR * widths.lower.mm:
        return "uncertain"
    return "corrected for taper" if widths.lower.corrected else "ok"


def _plot_row(stalks: list[Row], pairs: int, path: RobotPath, skipped: int, origin: Origin) -> Row:
    widths = np.array([float(row["width_mm"]) for row in stalks if row["width_mm"] != ""])
    # In unfamiliar images the networks detect nothing, so no detections do not mean a count of 0.
    count = len(stalks) if path.seen_fraction >= _MIN_SEEN and stalks else ""
    doubts = [PARTLY_SEEN] if stalks and count == "" else []
    doubts += [NO_WIDTHS] if stalks and not widths.size else []
    doubts += [SKIPPED] if stalks and skipped else []
    doubts += [name for name in (NO_GROUND, FEW_FRAMES) if sum(row["flag"] == name for row in stalks) > len(stalks) / 2]
    flag = "; ".join(doubts or ["ok" if stalks else NO_ROW])
    return {
        "plot": origin.plot,
        "pairs": pairs,
        "pairs_skipped": skipped,
        "length_m": _format_number(path.length, 4),
        "stalks": count,
        "stalks_per_m": _format_number(count / path.length, 3) if count != "" and path.length > 0 else "",
        **_width_columns(widths),
        **_upper_columns(stalks),
        "flag": flag,
        "method": origin.method,
        "version": origin.version,
    }


def rows_without_path(
    frames: list[list[Sighting]], skipped: int, origin: Origin, reason: str, metric: bool = True
) -> tuple[list[Row], Row]:
    """Compute the row of a plot whose pairs cannot be linked: there is no count, and there are no rows of stalks.

    Args:
        frames: Sightings of each pair.
        skipped: Number of pairs that could not be used.
        origin: Values common to all rows.
        reason: Flag of the plot.
        metric: If true, state the mean width of the detections; false if the unit of the calibration is in doubt.
    """
    sightings = [sighting for frame in frames for sighting in frame] if metric else []
    measured = [sighting.diameter_mm for sighting in sightings if sighting.diameter_mm is not None]
    row = {
        "plot": origin.plot,
        "pairs": len(frames),
        "pairs_skipped": skipped,
        "length_m": "",
        "stalks": "",
        "stalks_per_m": "",
        **_width_columns(np.array(measured)),
        "flag": reason,
        "method": origin.method,
        "version": origin.version,
    }
    # Detections of the same stalk are not independent: a standard error would be too small.
    return [], {**row, "width_se_mm": "", "width_24in_mean_mm": "", "taper_mean_mm_per_in": "", "stalks_measured": ""}


def _upper_columns(stalks: list[Row]) -> Row:
    """Return mean width and taper over the stalks that were also measured at 24 inches."""
    means = {"width_24in_mean_mm": "width_24in_mm", "taper_mean_mm_per_in": "taper_mm_per_in"}
    values = {name: [float(row[column]) for row in stalks if row[column] != ""] for name, column in means.items()}
    return {name: _format_number(float(np.mean(numbers)), 3) if numbers else "" for name, numbers in values.items()}


def _width_columns(widths: np.ndarray) -> Row:
    spread = float(widths.std(ddof=1)) if widths.size > 1 else math.nan
    return {
        "width_mean_mm": _format_number(float(widths.mean()), 3) if widths.size else "",
        "width_sd_mm": _format_number(spread, 3),
        "width_se_mm": _format_number(spread / math.sqrt(widths.size), 3) if widths.size else "",
        "stalks_measured": widths.size,
    }


def _format_number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""


def write_rows(path: Path, columns: tuple[str, ...], rows: list[Row]) -> None:
    """Write a table as CSV atomically.

    Raises:
        OSError: The file cannot be written.
    """
    write_atomically(path, to_csv(rows, columns))
