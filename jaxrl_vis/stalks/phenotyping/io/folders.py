"""Folders of stereo pairs: which images belong together, and how far the robot had driven.

left_000.png  right_000.png          or  anything with left and right, or L and R, as a word of its name
left/000.png  right/000.png          or  the same in two folders, which may also be called L and R
disparity_000.pfm, disparity/000.png optional: disparities of the left images, in place of our own
odometry.csv                         distance_m, or time_s, with the name of the left image (left) or in order
"""

import csv
import dataclasses
import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.spreadsheets import unescape_cell
from jaxrl_vis.stalks.phenotyping.io.names import check_length, readable
from jaxrl_vis_envs.documents import read_text

_IMAGES = {".png", ".jpg", ".jpeg", ".tif", ".tiff"}
SAMPLE = Path(__file__).parents[1] / "sample_row"
"""A short synthetic row that comes with the package."""
_MAX_ODOMETRY = 8_000_000  # bytes
_DISPARITIES = {".pfm", ".png", ".tif", ".tiff"}
_WORD = re.compile(r"(?<![a-z])(left|right)(?![a-z])", re.IGNORECASE)
_LETTER = re.compile(r"(?<![a-z])[lr](?![a-z])", re.IGNORECASE)
_OTHER = {"left": "right", "right": "left", "l": "r", "r": "l"}


@dataclasses.dataclass(frozen=True)
class PairFiles:
    """One pair; a side of which there is no file is None.

    Attributes:
        name: Common to both, fit for a file name.
        left, right: The images.
        disparity: Disparities of the left image, if somebody computed them before; they are used in place of the right image.
    """

    name: str
    left: Path | None
    right: Path | None
    disparity: Path | None = None


@dataclasses.dataclass(frozen=True)
class PlotFolder:
    """One plot.

    Attributes:
        name: Name of its folder.
        folder: Its path.
        pairs: In the order of their names.
    """

    name: str
    folder: Path
    pairs: tuple[PairFiles, ...]


def find_plots(folder: Path) -> list[PlotFolder]:
    """The plots in a folder: the folder itself if it holds pairs, else its subfolders that do.

    Raises:
        RequestError: There is no such folder, there are no pairs in it, or two files could be meant.
    """
    if not folder.is_dir():
        raise RequestError(f"there is no folder {folder}: name one with stereo pairs")
    own = _pairs(folder)
    folders = {folder.resolve(): own} if own else {}
    if not own:
        folders = {path: _pairs(path) for path in sorted(path for path in folder.iterdir() if path.is_dir())}
    plots: dict[str, PlotFolder] = {}
    for path, pairs in folders.items():
        if pairs:
            check_length(path)
            name = readable(path.name) or "plot"
            if name in plots:
                raise RequestError(f"{readable(str(folder))} holds two plots called {name}: rename one of them")
            plots[name] = PlotFolder(name, folder if own else path, pairs)
    if not plots:
        raise RequestError(
            f"{folder} holds no stereo pairs: name images left_000.png and right_000.png, or put them into left/ and right/"
        )
    return list(plots.values())


_Sides = dict[str, dict[str, Path]]
"""Files by the name of their pair and what they are of it: left, right or disparity."""


def _pairs(folder: Path) -> tuple[PairFiles, ...]:
    sides = _by_folder(folder) or {}
    for name, files in _by_name(folder).items():
        for side, path in files.items():
            _put(sides, name, side, path)
    stored = _find_folder(folder, ("disparity",))
    inside = [] if stored is None else _images(stored, _DISPARITIES)
    for path in [*inside, *_images(folder, _DISPARITIES)]:
        beside = path.parent == folder
        stem = readable(path.stem)
        name = re.sub("disparity", "", stem, flags=re.IGNORECASE).strip("_-. ") if beside else stem
        if name in sides and (not beside or "disparity" in stem.lower()):
            _put(sides, name, "disparity", path)
    files = [
        PairFiles(name, by_side.get("left"), by_side.get("right"), by_side.get("disparity")) for name, by_side in sides.items()
    ]
    return tuple(sorted(files, key=lambda pair: _natural(pair.name)))


def _put(sides: _Sides, name: str, side: str, path: Path) -> None:
    """Notes a file.

    Raises:
        RequestError: There is another one in its place, or its name is too long.
    """
    check_length(path)
    other = sides.setdefault(name, {}).setdefault(side, path)
    if other != path:
        both = " and ".join(readable(str(file)) for file in (other, path))
        what = "disparity" if side == "disparity" else f"{side} image"
        raise RequestError(f"{both} are both the {what} of pair {name}: rename one of them, or move it elsewhere")


def _by_folder(folder: Path) -> _Sides:
    """Images in two folders, one for each side, by the name of their pair and their side."""
    nested = {side: _find_folder(folder, (side, side[0])) for side in ("left", "right")}
    sides: _Sides = {}
    if all(nested.values()):
        for side, path in nested.items():
            assert path is not None
            # A folder L that holds whole pairs is a plot of that name, and no side.
            if any(len(by_side) == 2 for by_side in _by_name(path).values()):
                return {}
            for image in _images(path):
                _put(sides, readable(image.stem), side, image)
    return sides


def _by_name(folder: Path) -> _Sides:
    """Images that say in their names which side they show, by the name of their pair and their side."""
    images = {path: readable(path.stem) for path in _images(folder)}
    images = {path: stem for path, stem in images.items() if "disparity" not in stem.lower()}
    stems = {stem.lower() for stem in images.values()}
    sides: _Sides = {}
    for image, stem in images.items():
        word = _side_in(stem, stems)
        if word is not None:
            name = (stem[: word.start()] + stem[word.end() :]).strip("_-. ") or "pair"
            _put(sides, name, "left" if word.group().lower().startswith("l") else "right", image)
    return sides


def _side_in(stem: str, stems: set[str]) -> re.Match[str] | None:
    """The word of an image's name that says which side it shows; None if there is none.

    Names of rows and repetitions hold such letters, too, as in R2_left_000 or plot_R1_L_000. So words go before letters, and
    what makes another image's name, if exchanged, before what does not; of several the last, as plots are mostly named first.

    Args:
        stem: Stem of its name.
        stems: Those of all images of its folder, in small letters.
    """
    words = list(_WORD.finditer(stem)) or list(_LETTER.finditer(stem))
    paired = [
        word for word in words if (stem[: word.start()] + _OTHER[word.group().lower()] + stem[word.end() :]).lower() in stems
    ]
    return (paired or words or [None])[-1]


def _find_folder(folder: Path, names: tuple[str, ...]) -> Path | None:
    """The folder in a folder that has one of some names, whatever their case; the first name goes before the others."""
    folders = [path for path in sorted(folder.iterdir()) if path.name.lower() in names and path.is_dir()]
    return min(folders, key=lambda path: names.index(path.name.lower()), default=None)


def _images(folder: Path, suffixes: set[str] = _IMAGES) -> list[Path]:
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes and path.is_file())
    return [path for path in paths if not path.name.startswith(".")]  # beside each image, macOS leaves ._ and its name


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sort 2 before 10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]


def read_odometries(plots: Sequence[PlotFolder], speed: float | None) -> dict[str, dict[str, float] | None]:
    """Read the odometry of each plot with `read_odometry`: a dictionary by the plot's name.

    Raises:
        RequestError: A file cannot be used, or none of them needs the speed.
    """
    driven = {plot.name: read_odometry(plot, speed) for plot in plots}
    if speed is not None and not any(_holds_times_only(plot) for plot in plots):
        raise RequestError("--speed goes with an odometry.csv that holds times (time_s) and no distance_m: leave it out")
    return driven


def read_odometry(plot: PlotFolder, speed: float | None = None) -> dict[str, float] | None:
    """Read the distance that the robot had driven at each pair, by the pair's name, m; None if unknown, see `why_no_odometry`.

    Args:
        plot: With ``odometry.csv``.
        speed: Speed of the robot, m/s: for files that hold times only.

    Raises:
        RequestError: The file cannot be read, states neither distances nor times, or its rows cannot be matched with the pairs.
    """
    path = plot.folder / "odometry.csv"
    if not path.exists():
        return None
    columns, rows = _read_table(path)
    if "distance_m" not in columns and "time_s" not in columns:
        raise RequestError(f"{path} needs a column distance_m, or time_s and --speed")
    if "distance_m" not in columns and speed is None:
        return None
    wanted = {readable(pair.left.name): pair.name for pair in plot.pairs if pair.left}
    where = columns.index("distance_m" if "distance_m" in columns else "time_s")
    named = columns.index("left") if "left" in columns else None
    driven: dict[str, float] = {}
    values: list[float] = []
    count = 0
    try:
        for row in rows:
            value = float(row[where]) * (1.0 if "distance_m" in columns else speed or 0.0)
            if not math.isfinite(value):
                raise ValueError
            count += 1
            if named is not None:
                name = re.split(r"[/\\]", unescape_cell(row[named].strip()) if named < len(row) else "")[-1]
                if name in wanted:
                    driven[wanted[name]] = value
            elif count <= len(plot.pairs):
                values.append(value)
    except csv.Error as error:
        raise RequestError(f"{path} is no table: save it as CSV in UTF-8 ({error})") from error
    except (ValueError, IndexError) as error:
        raise RequestError(f"{path} holds something that is no number: distances and times must be finite numbers") from error
    if named is None and count != len(plot.pairs):
        raise RequestError(
            f"{path} has {count} rows for {len(plot.pairs)} pairs, so nobody can tell which is which: "
            "add a column left with the names of the left images"
        )
    return driven if named is not None else {pair.name: value for pair, value in zip(plot.pairs, values)}


def why_no_odometry(plot: PlotFolder, driven: Mapping[str, float] | None, pairs: Sequence[PairFiles]) -> str | None:
    """Say in words what is missing to know the distance that the robot had driven; None if nothing is.

    Args:
        plot: The plot.
        driven: Its odometry, from `read_odometry`.
        pairs: Those of its pairs for which it must be known.
    """
    path = plot.folder / "odometry.csv"
    if driven is None:
        return f"{path} holds times only: give the robot's speed with --speed" if path.exists() else f"there is no {path}"
    unknown = [pair.name if pair.left is None else readable(pair.left.name) for pair in pairs if pair.name not in driven]
    if not unknown:
        return None
    others = f" and {len(unknown) - 3} others" if len(unknown) > 3 else ""
    return f"{path} has no row for {', '.join(unknown[:3])}{others}: its column left must name them"


def _holds_times_only(plot: PlotFolder) -> bool:
    path = plot.folder / "odometry.csv"
    columns = _read_table(path)[0] if path.exists() else []
    return "time_s" in columns and "distance_m" not in columns


def _read_table(path: Path) -> tuple[list[str], Iterator[list[str]]]:
    """The columns of a CSV file, and its rows, which raise a `csv.Error` where they are none.

    Raises:
        RequestError: It cannot be read.
    """
    try:
        # Spreadsheets write a mark of the byte order before the first column's name.
        reader = csv.reader(io.StringIO(read_text(path, _MAX_ODOMETRY), newline=""), skipinitialspace=True)
        return [unescape_cell(name.strip()) for name in next(reader, [])], (row for row in reader if row)
    except OSError as error:
        raise RequestError(f"cannot read {path}: {error.strerror or error}") from error
    except (csv.Error, ValueError) as error:
        raise RequestError(f"{path} is no table: save it as CSV in UTF-8 ({error})") from error
