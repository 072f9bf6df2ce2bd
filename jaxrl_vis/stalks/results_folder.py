"""A folder of results that a command can continue: what it was asked for, and records that hold as long as their sources do.

OUT/run.json    the request: a folder holds the results of one
records         JSON files, each with the state of the files that it was made from
"""

import dataclasses
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jaxrl_vis
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles, PlotFolder
from jaxrl_vis_envs.documents import read_json
from jaxrl_vis_envs.plants import Calibration

_SOURCES = "of"


def file_state(path: Path | None) -> list[int] | None:
    """Return the size in bytes of a file and the time of its last change in ns; None where there is no file."""
    try:
        status = None if path is None else path.stat()
    except OSError:
        return None
    return None if status is None else [status.st_size, status.st_mtime_ns]


def pair_state(pair: PairFiles) -> dict[str, list[int] | None]:
    """Return the `file_state` of each file of a pair."""
    return {"left": file_state(pair.left), "right": file_state(pair.right), "disparity": file_state(pair.disparity)}


def write_record(path: Path, record: Mapping[str, Any], sources: Any) -> None:
    """Write a record as JSON.

    Args:
        path: The file.
        record: Contents.
        sources: State of everything that the record was made from, read before that was.

    Raises:
        OSError: The file cannot be written.
    """
    write_atomically(path, json.dumps({**record, _SOURCES: sources}) + "\n")


def is_current(path: Path, sources: Any, is_whole: Callable[[dict[str, Any]], bool]) -> bool:
    """Return True if a record was made from these sources and is whole.

    Args:
        path: The file.
        sources: State of what it should have been made from.
        is_whole: From the record to True if it need not be made again; it may raise what reading an unknown record raises.
    """
    try:
        record = read_json(path)
        return is_whole(record) and record[_SOURCES] == sources
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError):
        return False


def claim(
    out: Path,
    noun: str,
    folders: Iterable[PlotFolder],
    calibrations: Mapping[str, Calibration | None],
    about: Mapping[str, Any],
    begun: bool,
) -> None:
    """Write a request into its folder of results, or check that it is the one before.

    A folder that holds no results yet may be claimed for another request, and a plot that had no calibration may get one:
    that is what messages advise.

    Args:
        out: The folder; made if it is missing.
        noun: Word for the folders of pairs, in the plural.
        folders: Folders of pairs.
        calibrations: Calibration of each folder by its name; None where there is none.
        about: Anything else that results depend on, as JSON.
        begun: The folder holds results.

    Raises:
        RequestError: The folder holds the results of another request.
    """
    request = {
        "version": jaxrl_vis.__version__,
        **about,
        "calibrations": {
            name: None if calibration is None else dataclasses.asdict(calibration) for name, calibration in calibrations.items()
        },
        noun: {folder.name: str(folder.folder.resolve()) for folder in folders},
    }
    request = json.loads(json.dumps(request))
    path = out / "run.json"
    if begun and path.exists():
        try:
            differing = _differences(read_json(path), request)
        except (ValueError, AttributeError):
            differing = "run.json cannot be read"
        if differing:
            raise RequestError(
                f"{out} holds the results of another request ({differing}): choose another folder with --out, or remove it"
            )
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps(request, indent=2) + "\n")


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Return the differences of two requests that matter, in words; empty if there are none."""
    differences = []
    for name in dict.fromkeys([*now, *before]):
        old, new = before.get(name), now.get(name)
        if name == "calibrations" and isinstance(old, dict) and isinstance(new, dict):
            # Records state the calibration that they were made with, so one that comes later makes them again.
            old = {plot: new.get(plot) if calibration is None else calibration for plot, calibration in old.items()}
        if old == new:
            continue
        if isinstance(old, dict) or isinstance(new, dict):
            old, new = old or {}, new or {}
            parts = [part for part in dict.fromkeys([*old, *new]) if old.get(part) != new.get(part)]
            differences.append(f"{name}: other values of {', '.join(parts[:3])}{' and others' if len(parts) > 3 else ''}")
        else:
            differences.append(f"{name}: {json.dumps(old)}, not {json.dumps(new)}")
    return "; ".join(differences)
