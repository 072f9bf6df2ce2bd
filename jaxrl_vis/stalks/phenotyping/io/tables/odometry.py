"""Odometry of plots: the distance driven at each pair, from tables, printed ROS messages or GPS fixes.

odometry.csv     distance_m (_cm, _mm), or time_s (_ms, _us, _ns) with --speed, or positions (x, y), or latitude and longitude;
                 matched to the pairs by name of the left image (left), by order, or by timestamps in the image names
odometry.txt     the same, separated by tabs, semicolons or spaces; or the output of rostopic echo or ros2 topic echo
"""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.spreadsheets import unescape_cell
from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles, PlotFolder
from jaxrl_vis.stalks.phenotyping.io.names import readable
from jaxrl_vis.stalks.phenotyping.io.naming.stamps import parse_timestamp
from jaxrl_vis.stalks.phenotyping.io.tables.cells import read_table_text, split_cells

_MAX_ODOMETRY = 8_000_000  # bytes
_NAMES = tuple(f"{stem}{end}" for stem in ("odometry", "odom", "gps") for end in (".csv", ".tsv", ".txt", ".yaml"))
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "in": 0.0254, "ft": 0.3048}
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_DISTANCE = re.compile(r"(?:distance|odometer|dist|travelled)[ _]*[\[(]?(mm|cm|m|km|in|ft)[\])]?")
_TIME = re.compile(r"(?:time|timestamp|stamp)[ _]*[\[(]?(s|ms|us|ns)[\])]?")
_ROS_TIMES = ("%time", "field.header.stamp")  # ns
_PLAIN_TIMES = ("time", "timestamp", "stamp")
_LEFT = ("left", "left_image", "image", "filename", "file", "image_name", "left_file")
_POSITIONS = (
    ("field.pose.pose.position.x", "field.pose.pose.position.y", "field.pose.pose.position.z"),
    ("pose.pose.position.x", "pose.pose.position.y", "pose.pose.position.z"),
    ("field.pose.position.x", "field.pose.position.y", "field.pose.position.z"),
    ("x_m", "y_m", "z_m"),
    ("tx", "ty", "tz"),
    ("easting", "northing"),
    ("x", "y", "z"),
)
_GLOBE = (("latitude", "longitude"), ("lat", "lon"), ("lat", "lng"), ("field.latitude", "field.longitude"))
_EARTH_RADIUS = 6_371_000.0  # m, radius
_MAX_SECONDS = 1e11  # maximum of time_s: larger numbers are in another unit
_NUMBER = r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)"
_PRINTED_STAMP = re.compile(r"\bsecs?: *(\d{1,12})\s+n(?:ano)?secs?: *(\d{1,9})\b")
_PRINTED_PLACE = re.compile(rf"\bposition:\s+x: *{_NUMBER}\s+y: *{_NUMBER}\s+z: *{_NUMBER}")
_PRINTED_GLOBE = re.compile(rf"\blatitude: *{_NUMBER}\s+longitude: *{_NUMBER}")


@dataclasses.dataclass(frozen=True)
class _Table:
    """Odometry as stored in a file, with one entry per row.

    Attributes:
        path: The file.
        names: Names of left images; None if there is no such column.
        times: Times relative to the first one, s; None if there are none, or if they are not needed.
        start: The first time, s.
        distances: Distances driven, m; None if there are only times.
    """

    path: Path
    names: list[str] | None
    times: np.ndarray | None
    start: float
    distances: np.ndarray | None


def odometry_file(folder: Path) -> Path:
    """Return the odometry file in a plot's folder; ``odometry.csv`` if there is none."""
    return next((folder / name for name in _NAMES if (folder / name).exists()), folder / _NAMES[0])


def read_odometries(plots: Sequence[PlotFolder], speed: float | None) -> dict[str, dict[str, float] | None]:
    """Read the distances driven at the pairs of each plot, m, by the plot's and the pair's name.

    Args:
        plots: Plots, whose folders may hold ``odometry.csv`` or one of the alternatives, see `odometry_file`.
        speed: Speed of the robot, m/s, for files that hold only times.

    Returns:
        Plot -> pair -> distance; pairs that no row matches are missing. None for a plot without a file, or with only times but
        no speed, see `odometry_fault`.

    Raises:
        RequestError: A file cannot be read, states neither distances nor times, or has rows that cannot be matched with pairs;
            or a speed is given but none of the files needs it.
    """
    tables = {plot.name: _read(odometry_file(plot.folder)) for plot in plots}
    if speed is not None and not any(table and table.distances is None for table in tables.values()):
        raise RequestError("--speed goes with an odometry.csv that holds times (time_s) and no distance_m: leave it out")
    return {plot.name: _pair_distances(plot, tables[plot.name], speed) for plot in plots}


def odometry_fault(plot: PlotFolder, distances: Mapping[str, float] | None, pairs: Sequence[PairFiles]) -> str | None:
    """Return a message that states why the distance driven is unknown; None if it is known.

    Args:
        plot: The plot.
        distances: Its odometry, from `read_odometries`.
        pairs: The pairs for which it must be known.
    """
    path = odometry_file(plot.folder)
    if distances is None:
        return f"{path} holds times only: give the robot's speed with --speed" if path.exists() else f"there is no {path}"
    unknown = [pair.name if pair.left is None else readable(pair.left.name) for pair in pairs if pair.name not in distances]
    if not unknown:
        return None
    others = f" and {len(unknown) - 3} others" if len(unknown) > 3 else ""
    return f"{path} has no row for {', '.join(unknown[:3])}{others}: its column left must name them"


def _pair_distances(plot: PlotFolder, table: _Table | None, speed: float | None) -> dict[str, float] | None:
    if table is None:
        return None
    if table.distances is not None:
        values = table.distances
    elif speed is None or table.times is None:
        return None
    else:
        values = (table.times + table.start) * speed if abs(table.start) < 1e6 else table.times * speed
    if table.names is not None:
        return _distances_by_name(plot, table.names, values)
    if len(values) == len(plot.pairs):
        return {pair.name: float(value) for pair, value in zip(plot.pairs, values)}
    by_time = _distances_by_time(plot, table, values)
    if by_time is None:
        raise RequestError(
            f"{table.path} has {len(values)} rows for {len(plot.pairs)} pairs, so nobody can tell which is which: "
            "add a column left with the names of the left images"
        )
    return by_time


def _distances_by_name(plot: PlotFolder, names: list[str], values: np.ndarray) -> dict[str, float]:
    """Return the distances of rows that name a left image, with or without its path and suffix, in any case if unambiguous."""
    exact: dict[str, str] = {}
    loose: dict[str, set[str]] = {}
    for pair in plot.pairs:
        if pair.left:
            name = readable(pair.left.name)
            exact[name] = pair.name
            for other in (name.lower(), readable(pair.left.stem).lower()):
                loose.setdefault(other, set()).add(pair.name)
    driven: dict[str, float] = {}
    for written, value in zip(names, values):
        name = re.split(r"[/\\]", written)[-1]
        alike = loose.get(name.lower(), set())
        pair = exact.get(name) or (next(iter(alike)) if len(alike) == 1 else None)
        if pair is not None:
            driven[pair] = float(value)
    return driven


def _distances_by_time(plot: PlotFolder, table: _Table, values: np.ndarray) -> dict[str, float] | None:
    """Interpolate distances at the timestamps in the names of the left images; None if there are none, or no usable times.

    Images more than the median interval before the first or after the last row are left out.
    """
    taken = {pair.name: parse_timestamp(readable(pair.left.stem)) for pair in plot.pairs if pair.left}
    times = table.times
    if times is None or len(times) < 2 or (np.diff(times) < 0).any() or not taken or None in taken.values():
        return None
    period = float(np.median(np.diff(times)))
    moments = {name: float(moment - table.start) for name, moment in taken.items() if moment is not None}
    inside = {name: moment for name, moment in moments.items() if -period <= moment <= times[-1] + period}
    return {name: float(np.interp(moment, times, values)) for name, moment in inside.items()} if inside else None


def _read(path: Path) -> _Table | None:
    """Read the odometry in a file; return None if there is no such file.

    Raises:
        RequestError: The file cannot be read, or holds no odometry.
    """
    if not path.exists():
        return None
    text = read_table_text(path, _MAX_ODOMETRY)
    return _parse_printed(path, text) or _parse_table(path, text)


def _parse_printed(path: Path, text: str) -> _Table | None:
    """Parse printed ROS messages with odometry or GPS fixes; return None if the text holds none.

    Raises:
        RequestError: A position is not finite.
    """
    messages = re.split(r"^---\s*$", text, flags=re.MULTILINE)
    for pattern in (_PRINTED_PLACE, _PRINTED_GLOBE):
        matches = [(_PRINTED_STAMP.search(message), pattern.search(message)) for message in messages]
        rows = [(stamp, place) for stamp, place in matches if place is not None]
        if not rows:
            continue
        places = np.array([[float(number) for number in place.groups()] for _, place in rows])
        if not np.isfinite(places).all():
            raise RequestError(f"{path} holds something that is not a number: distances and times must be finite numbers")
        stamps = [int(stamp[1]) + int(stamp[2]) * 1e-9 for stamp, _ in rows if stamp is not None]
        times = np.array(stamps) - stamps[0] if len(stamps) == len(rows) else None
        metres = places if pattern is _PRINTED_PLACE else _project_to_plane(places)
        return _Table(path, None, times, stamps[0] if times is not None else 0.0, _distances_along_line(metres))
    return None


def _parse_table(path: Path, text: str) -> _Table:
    """Parse odometry from a table.

    Raises:
        RequestError: A column or a number is missing.
    """
    columns, rows, comma = split_cells(path, text)
    columns = [name.lower() for name in columns]
    metres = [(place, _METRES[match[1]]) for place, name in enumerate(columns) if (match := _DISTANCE.fullmatch(name))]
    time = _time_column(columns)
    places = next((names for names in (*_POSITIONS, *_GLOBE) if set(names[:2]) <= set(columns)), None)
    left = next((columns.index(name) for name in _LEFT if name in columns), None)
    if not metres and time is None and places is None:
        unitless_column = next((name for name in columns if name in ("distance", "dist", "odometer")), None)
        hint = f" (its column {unitless_column} does not state its unit)" if unitless_column else ""
        raise RequestError(f"{path} needs a column distance_m, or time_s and --speed{hint}")

    def column(index: int) -> np.ndarray:
        return np.array([_parse_number(row[index] if index < len(row) else "", path, line, comma) for line, row in rows], float)

    names = None if left is None else [unescape_cell(row[left].strip()) if left < len(row) else "" for _, row in rows]
    distances: np.ndarray | None = None
    if metres:
        distances = column(metres[0][0]) * metres[0][1]
    elif places is not None:
        values = np.stack([column(columns.index(name)) for name in places if name in columns], axis=1)
        distances = (
            _distances_along_line(_project_to_plane(values) if places in _GLOBE else values) if len(values) else np.zeros(0)
        )
    times, start = None, 0.0
    if time is not None and (distances is None or names is None):
        times, start = _parse_seconds(column(time), columns[time], path)
    return _Table(path, names, times, start, distances)


def _time_column(columns: list[str]) -> int | None:
    named = [index for index, name in enumerate(columns) if _TIME.fullmatch(name) or name in (*_ROS_TIMES, *_PLAIN_TIMES)]
    return named[0] if named else None


def _parse_seconds(values: np.ndarray, name: str, path: Path) -> tuple[np.ndarray, float]:
    """Convert times to s; return them relative to the first one, and the first one.

    Args:
        values: Times, [N].
        name: Name of their column, which may state the unit; otherwise it is inferred from the magnitude.
        path: The file, for messages.

    Raises:
        RequestError: The name states s, but the numbers are too large for that.
    """
    match = _TIME.fullmatch(name)
    largest = float(np.abs(values).max(initial=0.0))
    if match and match[1] == "s" and largest > _MAX_SECONDS:
        unit = "ns" if largest > 1e17 else "us" if largest > 1e14 else "ms"
        raise RequestError(f"{path}: {name} holds {largest:.0f}, too large for seconds: name the column time_{unit} or mend it")
    if match:
        factor = _SECONDS[match[1]]
    elif name in _ROS_TIMES:
        factor = 1e-9
    else:
        factor = next((factor for limit, factor in ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3)) if largest > limit), 1.0)
    start = float(values[0]) if len(values) else 0.0
    return (values - start) * factor, start * factor


def _project_to_plane(degrees: np.ndarray) -> np.ndarray:
    """Project latitudes and longitudes [N, 2], degrees, to positions [N, 2] in m relative to the first one."""
    turned = np.radians(degrees - degrees[:1])
    return _EARTH_RADIUS * np.stack([turned[:, 0], turned[:, 1] * np.cos(np.radians(degrees[:1, 0]))], axis=1)


def _distances_along_line(positions: np.ndarray) -> np.ndarray:
    """Return distances [N] along the straight line fitted to positions [N, 2 or 3], from the first one; NaN if any is invalid.

    Lateral deviations from the line do not count. The direction of travel is positive.
    """
    if not np.isfinite(positions).all() or np.abs(positions).max(initial=0.0) > 1e9:
        return np.full(len(positions), np.nan)
    centred = positions - positions.mean(axis=0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0] if len(positions) > 1 else np.eye(positions.shape[1])[0]
    along = centred @ direction
    along = along if along[-1] >= along[0] else -along
    return along - along[0]


def _parse_number(cell: str, path: Path, line: int, comma: bool) -> float:
    text = unescape_cell(cell.strip())
    try:
        value = float(text.replace(",", ".") if comma else text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        shown = readable(text)[:40]
        raise RequestError(
            f"{path} holds something that is not a number in line {line} ('{shown}'): distances and times must be finite"
        )
    return value
