"""Quality-control page: sortable tables, an image of every stalk, and rejected tracks with reasons, as one HTML file.

Images are cropped from the overlays written by `pipeline.run`. Plots are added one by one and buffered in a temporary file, so
that memory use does not grow with their number; images of whole pairs are limited to about 200 in total, or one per plot.
"""

import base64
import codecs
import dataclasses
import html
import math
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jaxrl_vis.host.files import replacing
from jaxrl_vis.stalks.phenotyping.io.images import read_image
from jaxrl_vis.stalks.phenotyping.io.names import file_name
from jaxrl_vis.stalks.phenotyping.report.overlay import overlay_scale
from jaxrl_vis.stalks.phenotyping.report.qc_style import SCRIPT, STYLE
from jaxrl_vis.stalks.phenotyping.report.tables import NO_GROUND
from jaxrl_vis.stalks.phenotyping.track.follow import Track
from jaxrl_vis.stalks.phenotyping.track.sightings import Sighting

_MAX_PAIR_IMAGES = 200  # images of whole pairs on the page
_MAX_WHOLE, _MIN_WHOLE = 8, 1  # per plot
_MAX_THUMBNAIL_WIDTH = 844  # pixels, maximum width of these
_READ_AT_ONCE = 8  # overlays
_STALK_COLUMNS = {
    "stalk": "stalk",
    "position_m": "position, m",
    "depth_m": "depth, m",
    "width_mm": "width at 12 in, mm",
    "width_se_mm": "± mm",
    "width_24in_mm": "at 24 in, mm",
    "taper_mm_per_in": "taper, mm/in",
    "lean_deg": "lean, °",
    "frames": "pairs",
    "frames_measured": "measured in",
    "confidence": "confidence",
    "flag": "flag",
}
_PLOT_COLUMNS = {
    "plot": "plot",
    "pairs": "pairs",
    "pairs_skipped": "skipped",
    "length_m": "length, m",
    "stalks": "stalks",
    "stalks_per_m": "stalks per m",
    "width_mean_mm": "mean width at 12 in, mm",
    "width_sd_mm": "sd, mm",
    "width_24in_mean_mm": "mean at 24 in, mm",
    "taper_mean_mm_per_in": "mean taper, mm/in",
    "rejected": "rejected",
    "flag": "flag",
}


_DIGITS = {
    **dict.fromkeys(("position_m", "depth_m", "length_m", "width_se_mm", "taper_mm_per_in", "taper_mean_mm_per_in"), 2),
    **dict.fromkeys(("width_mm", "width_24in_mm", "width_mean_mm", "width_sd_mm", "width_24in_mean_mm", "stalks_per_m"), 1),
    "confidence": 2,
}
"""Decimal places of numbers on the page; the tables have more."""
_ERRORS = (
    "± is the standard error of a width: scatter between pairs, masks that err alike in all of them, hidden edges, and a good "
    "calibration. Twice that covers the truth of about 95 % of synthetic stalks. "
    "Point at a picture to enlarge it."
)


@dataclasses.dataclass(frozen=True)
class PlotResult:
    """Results of one plot.

    Attributes:
        row: Row of plots.csv.
        stalks: Rows of stalks.csv, one per counted track.
        pairs: Names of the pairs that were used.
        frames: Sightings in each of these pairs.
        tracks: Counted and rejected tracks; empty if the pairs could not be linked.
        start: Position of the first pair, the origin of the stalks' positions, m.
        image_width: Width of the images, pixels.
        count_reason: Reason that there is no count, beyond the flag; empty if there is a count or nothing to add.
        unfamiliar_note: Description of how the images differ from the training images; empty if they do not.
    """

    row: dict[str, Any]
    stalks: list[dict[str, Any]]
    pairs: list[str]
    frames: list[list[Sighting]]
    tracks: list[Track]
    start: float
    image_width: int
    count_reason: str = ""
    unfamiliar_note: str = ""


class Page:
    """Builder of the page; a context manager that owns the temporary file.

    Args:
        about: Lines of text below the title.
        overlays: Folder with a subfolder of overlays for each plot.
        plots: Number of plots that will be added.
    """

    def __init__(self, about: list[str], overlays: Path, plots: int) -> None:
        self._about, self._overlays = about, overlays
        self._whole = min(max(_MAX_PAIR_IMAGES // max(plots, 1), _MIN_WHOLE), _MAX_WHOLE)
        self._file = tempfile.TemporaryFile("w+", encoding="utf-8")
        self._rows: list[dict[str, Any]] = []

    def __enter__(self) -> "Page":
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def add(self, plot: PlotResult) -> None:
        """Add a plot.

        Raises:
            OSError: An overlay cannot be read.
        """
        name = plot.row["plot"]
        rejected = [track for track in plot.tracks if not track.counted]
        self._rows.append({**plot.row, "rejected": len(rejected) if plot.tracks else ""})
        pictures, pairs = _cut_pictures(self._overlays / file_name(name), plot, self._whole)
        counted = [track for track in plot.tracks if track.counted]
        tables = [
            {"picture": pictures[id(track)], **{column: row[column] for column in _STALK_COLUMNS}}
            for track, row in zip(counted, plot.stalks)
        ]
        others = [
            {
                "picture": pictures[id(track)],
                "position, m": f"{track.position_m - plot.start:.3f}",
                "depth, m": "" if math.isnan(track.depth_m) else f"{track.depth_m:.3f}",
                "pairs": len(track.sightings),
                "why": track.reason,
            }
            for track in rejected
        ]
        reasons = Counter(sighting.reason for frame in plot.frames for sighting in frame if sighting.reason)
        finds = [{"why": why, "finds": count} for why, count in _group_reasons(reasons).most_common()]
        write = self._file.write
        write(f'<details id="{_escape(name)}"><summary>{_escape(name)}: {_escape(_headline(plot.row))}</summary>')
        if plot.count_reason:
            write(f'<p class="doubt">No count: {_escape(plot.count_reason)}.</p>')
        if plot.unfamiliar_note:
            write(f'<p class="doubt">{_escape(plot.unfamiliar_note[:1].upper() + plot.unfamiliar_note[1:])}.</p>')
        if plot.stalks:
            write(_chart(plot, rejected))
            write(f"<h3>Stalks</h3><p>{_ERRORS}</p>" + html_table({"picture": "", **_STALK_COLUMNS}, tables))
        if others:
            write("<h3>Rejected: not counted</h3>" + html_table({column: column for column in others[0]}, others))
        if finds:
            total = sum(map(len, plot.frames))
            write(
                f"<h3>Detections without a width, of {total} in single pairs</h3>"
                + html_table({"why": "why", "finds": "detections"}, finds)
            )
        write("<h3>Pairs</h3>" + pairs + "</details>\n")

    def write(self, path: Path, skipped: list[dict[str, Any]]) -> None:
        """Write the page atomically.

        Args:
            path: The file, .html.
            skipped: Rows of skipped.csv.

        Raises:
            OSError: The file cannot be written.
        """
        rows = [{**row, "plot": _Html(f'<a href="#{_escape(row["plot"])}">{_escape(row["plot"])}</a>')} for row in self._rows]
        with replacing(path) as encoded:
            file = codecs.getwriter("utf-8")(encoded)
            file.write('<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>Stalks</title>')
            file.write(f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>')
            file.write("<h1>Stalks: what was counted and measured</h1>")
            file.write("".join(f"<p>{_escape(line)}</p>" for line in self._about))
            file.write("<h2>Plots</h2><p>Click on a column to sort by it, and on a plot to see its stalks.</p>")
            file.write(html_table(_PLOT_COLUMNS, rows))
            if skipped:
                columns = {"plot": "plot", "pair": "pair", "why": "why"}
                file.write(f"<h2>Pairs that were skipped: {len(skipped)}</h2>" + html_table(columns, skipped))
            file.write("<h2>Plot by plot</h2>")
            self._file.seek(0)
            shutil.copyfileobj(self._file, file)
            file.write(f"<script>{SCRIPT}</script></body></html>\n")


class _Html(str):
    """HTML that must not be escaped again."""


def _escape(value: Any) -> str:
    return html.escape(str(value))


def _headline(row: dict[str, Any]) -> str:
    parts = [f"{row['stalks']} stalks"] if row["stalks"] != "" else []
    where = "" if NO_GROUND in row["flag"] else " at 12 inches"
    parts += [f"{float(row['width_mean_mm']):.1f} mm thick{where}"] if row["width_mean_mm"] != "" else []
    return ", ".join([*parts, *([] if row["flag"] == "ok" else [str(row["flag"])])])


def _group_reasons(reasons: Counter[str]) -> Counter[str]:
    """Merge the counts of reasons that differ only in a distance."""
    groups: Counter[str] = Counter()
    for reason, count in reasons.items():
        groups["it stands too near or too far away" if reason.startswith("it stands ") else reason] += count
    return groups


def html_table(columns: dict[str, str], rows: Iterable[dict[str, Any]]) -> str:
    """Return a sortable HTML table.

    Args:
        columns: Column name in the rows -> title.
        rows: Values by column name; flags other than ``ok`` are highlighted.
    """
    head = "".join(
        f'<th aria-sort="none"><button>{_escape(title)}</button></th>' if title else "<th></th>" for title in columns.values()
    )
    lines = []
    for row in rows:
        cells = []
        for column in columns:
            value = row.get(column, "")
            if column in _DIGITS and value != "":
                value = f"{float(value):.{_DIGITS[column]}f}"
            kind = ' class="doubt"' if column == "flag" and value != "ok" else ""
            cells.append(f"<td{kind}>{value if isinstance(value, _Html) else _escape(value)}</td>")
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return f"<div class=wide><table><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"


def _cut_pictures(folder: Path, plot: PlotResult, count: int) -> tuple[dict[int, _Html], str]:
    """Crop images of a plot from the overlays in a folder, each of which is read once, several at a time.

    Returns:
        Best sighting of each track by its ``id``: one with a width, if any, and with maximum confidence; and elements with at
        most ``count`` whole pairs, spread evenly.
    """
    best: dict[int, list[tuple[int, Sighting]]] = {}  # by pair
    for track in plot.tracks:
        choices = [(frame, plot.frames[frame][place]) for frame, place in track.sightings]
        frame, sighting = max(choices, key=lambda choice: (choice[1].diameter_mm is not None, choice[1].confidence))
        best.setdefault(frame, []).append((id(track), sighting))
    last = len(plot.pairs) - 1
    whole = set(np.linspace(0, last, min(count, last + 1)).round().astype(int).tolist())
    stalks: dict[int, _Html] = {}

    def read_pair(frame: int) -> str:
        name = f"pair {plot.pairs[frame]}"
        overlay = read_image(folder / file_name(f"{plot.pairs[frame]}.png"))
        for track, sighting in best.get(frame, []):
            stalks[track] = html_image(_crop(overlay, sighting, overlay_scale(plot.image_width)), name, "stalk")
        if frame not in whole:
            return ""
        shrink = min(_MAX_THUMBNAIL_WIDTH / overlay.shape[1], 1.0)
        small = cv2.resize(overlay, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        return f"<figure>{html_image(small, name, 'pair')}<figcaption>{_escape(name)}</figcaption></figure>"

    with ThreadPoolExecutor(_READ_AT_ONCE) as threads:
        pairs = "".join(threads.map(read_pair, sorted(best.keys() | whole)))
    return stalks, pairs


def _crop(overlay: np.ndarray, sighting: Sighting, scale: float) -> np.ndarray:
    left, top, right, bottom = (round(edge * scale) for edge in sighting.box)
    margin = max((bottom - top) // 2, 12)
    top, bottom = max(top - margin // 2, 0), min(bottom + margin // 4, overlay.shape[0])
    left, right = max(left - margin, 0), min(right + margin, overlay.shape[1])
    cut = overlay[top:bottom, left:right]
    shrink = min(240 / max(cut.shape[0], 1), 1.0)
    return (
        cv2.resize(cut, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if cut.size else np.zeros((8, 8, 3), np.uint8)
    )


def html_image(image: np.ndarray, name: str, css_class: str) -> _Html:
    """Return an HTML element with an image (RGB [H, W, 3] uint8) embedded as JPEG.

    Args:
        image: The image.
        name: Alternative text and tooltip.
        css_class: CSS class, ``stalk`` or ``pair``.
    """
    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 75])
    source = base64.b64encode(data.tobytes()).decode()
    title = _escape(name)
    return _Html(
        f'<img class="{css_class}" loading="lazy" alt="{title}" title="{title}" src="data:image/jpeg;base64,{source}">'
    )


def _chart(plot: PlotResult, rejected: list[Track]) -> str:
    """Plot widths with standard errors, and rejected tracks, along the row as SVG; empty if no width was measured."""
    points = [
        (float(row["position_m"]), float(row["width_mm"]), float(row["width_se_mm"] or 0), row)
        for row in plot.stalks
        if row["width_mm"] != ""
    ]
    if not points:
        return ""
    places = [point[0] for point in points] + [track.position_m - plot.start for track in rejected]
    low, high = min(places) - 0.05, max(places) + 0.05
    maximum = 1.1 * max(point[1] + point[2] for point in points)
    wide, tall, margin = 900, 240, 44

    def x(place: float) -> float:
        return margin + (place - low) / (high - low) * (wide - margin - 8)

    def y(width: float) -> float:
        return tall - 30 - width / maximum * (tall - 40)

    marks = []
    step = 5 if maximum < 40 else 10
    for value in range(0, int(maximum) + 1, step):
        marks.append(f'<line class="grid" x1="{margin}" x2="{wide - 8}" y1="{y(value):.1f}" y2="{y(value):.1f}"/>')
        marks.append(f'<text x="{margin - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{value}</text>')
    apart = 0.25 if high - low > 1.0 else 0.1
    for number in range(math.ceil(low / apart), math.floor(high / apart) + 1):
        tick = number * apart
        marks.append(f'<text x="{x(tick):.1f}" y="{tall - 12}" text-anchor="middle">{tick:.2f}</text>')
    for track in rejected:
        place = f'x="{x(track.position_m - plot.start):.1f}" y="{tall - 32}"'
        marks.append(f'<text class="no" {place} text-anchor="middle">×<title>{_escape(track.reason)}</title></text>')
    for place, width, error, row in points:
        kind = "good" if row["flag"] == "ok" else "doubt"
        ends = f'y1="{y(width - error):.1f}" y2="{y(width + error):.1f}"'
        title = f"stalk {row['stalk']}: {row['width_mm']} ± {row['width_se_mm']} mm, {row['flag']}"
        marks.append(f'<line class="{kind}" x1="{x(place):.1f}" x2="{x(place):.1f}" {ends}/>')
        marks.append(
            f'<circle class="{kind}" cx="{x(place):.1f}" cy="{y(width):.1f}" r="4"><title>{_escape(title)}</title></circle>'
        )
    caption = "Width in mm along the row in m. Orange: look at its flag. ×: rejected."
    return (
        f'<figure><svg viewBox="0 0 {wide} {tall}" role="img">{"".join(marks)}</svg><figcaption>{caption}</figcaption></figure>'
    )
