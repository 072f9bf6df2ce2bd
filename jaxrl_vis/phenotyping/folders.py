"""Folders of stereo pairs: which images belong together, and how far the robot had driven.

left_000.png  right_000.png          or  anything with left and right, or L and R, as a word of its name
left/000.png  right/000.png          or  the same in two folders
disparity_000.pfm, disparity/000.png optional: disparities of the left images, in place of our own
odometry.csv                         distance_m, or time_s, with the name of the left image (left) or in order
"""

import csv
import dataclasses
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.files import write_atomically

_IMAGES = {".png", ".jpg", ".jpeg", ".tif", ".tiff"}
SAMPLE = Path(__file__).with_name("sample_row")
"""A short synthetic row that comes with the package."""
_DISPARITIES = {".pfm", ".png", ".tif", ".tiff"}
_SIDE = re.compile(r"(?<![a-z])(left|right|l|r)(?![a-z])", re.IGNORECASE)


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
        name: Of its folder.
        folder: Where.
        pairs: In the order of their names.
    """

    name: str
    folder: Path
    pairs: tuple[PairFiles, ...]


def find_plots(folder: Path) -> list[PlotFolder]:
    """The plots in a folder: the folder itself if it holds pairs, else its subfolders that do.

    Raises:
        RequestError: There is no such folder, or there are no pairs in it.
    """
    if not folder.is_dir():
        raise RequestError(f"there is no folder {folder}: name one with stereo pairs")
    own = _pairs(folder)
    plots = [PlotFolder(folder.resolve().name, folder, own)] if own else []
    if not own:
        for each in sorted(path for path in folder.iterdir() if path.is_dir()):
            pairs = _pairs(each)
            if pairs:
                plots.append(PlotFolder(each.name, each, pairs))
    if not plots:
        raise RequestError(
            f"{folder} holds no stereo pairs: name images left_000.png and right_000.png, or put them into left/ and right/"
        )
    return plots


def _pairs(folder: Path) -> tuple[PairFiles, ...]:
    sides: dict[str, dict[str, Path]] = {}
    nested = [folder / side for side in ("left", "right")]
    if all(path.is_dir() for path in nested):
        for path in nested:
            for image in _images(path):
                sides.setdefault(image.stem, {})[path.name] = image
    for image in _images(folder):
        words = _SIDE.findall(image.stem)
        if words:
            name = _SIDE.sub("", image.stem, count=1).strip("_-. ") or "pair"
            sides.setdefault(name, {})["left" if words[0].lower().startswith("l") else "right"] = image
    for path in [*_images(folder / "disparity", _DISPARITIES), *_images(folder, _DISPARITIES)]:
        beside = path.parent == folder
        name = re.sub("disparity", "", path.stem, flags=re.IGNORECASE).strip("_-. ") if beside else path.stem
        if name in sides and (not beside or "disparity" in path.stem.lower()):
            sides[name]["disparity"] = path
    found = [PairFiles(name, each.get("left"), each.get("right"), each.get("disparity")) for name, each in sides.items()]
    return tuple(sorted(found, key=lambda pair: _natural(pair.name)))


def _images(folder: Path, suffixes: set[str] = _IMAGES) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes and path.is_file())


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sorts 2 before 10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]


def read_odometry(plot: PlotFolder, speed: float | None = None) -> dict[str, float] | None:
    """How far the robot had driven for each pair, by the pair's name, m; None if nothing says so.

    Args:
        plot: With ``odometry.csv``.
        speed: Of the robot, m/s: for files that hold times only.

    Raises:
        RequestError: The file cannot be read, or does not say how far or when.
    """
    path = plot.folder / "odometry.csv"
    if not path.exists():
        return None
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        columns = set(rows[0]) if rows else set()
        if "distance_m" in columns:
            values = [float(row["distance_m"]) for row in rows]
        elif "time_s" in columns and speed is not None:
            values = [speed * float(row["time_s"]) for row in rows]
        elif "time_s" in columns:
            return None
        else:
            raise RequestError(f"{path} needs a column distance_m, or time_s and --speed")
        if not np.isfinite(values).all():
            raise ValueError
    except RequestError:
        raise
    except OSError as error:
        raise RequestError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, TypeError) as error:
        raise RequestError(f"{path} holds something that is no number: distances and times must be finite numbers") from error
    if "left" in columns:
        of_file = {row["left"]: value for row, value in zip(rows, values)}
        return {pair.name: of_file[pair.left.name] for pair in plot.pairs if pair.left and pair.left.name in of_file}
    return {pair.name: value for pair, value in zip(plot.pairs, values)}


def claim(out: Path, about: Mapping[str, Any]) -> None:
    """Writes down in a folder of results what they are results of, or checks that it is the same as before.

    Raises:
        RequestError: The folder holds the results of another request.
    """
    text = json.dumps(about, indent=2) + "\n"
    path = out / "run.json"
    if path.exists() and path.read_text(encoding="utf-8") != text:
        raise RequestError(f"{out} holds the results of another request: choose another folder, or remove it")
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(path, text)
