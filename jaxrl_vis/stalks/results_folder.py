"""Results folder of a resumable command: its request, and records that are valid while their sources are unchanged.

OUT/run.json    the request; a folder holds the results of only one
records         JSON files, each with the state of its source files
"""

import dataclasses
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jaxrl_vis
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import is_temporary, write_atomically
from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles, PlotFolder
from jaxrl_vis_envs.documents import read_json
from jaxrl_vis_envs.plants import Calibration

_SOURCES = "of"


def file_state(path: Path | None) -> list[int] | None:
    """Return the size of a file in bytes and its modification time in ns; None if there is no file."""
    try:
        status = None if path is None else path.stat()
    except OSError:
        return None
    return None if status is None else [status.st_size, status.st_mtime_ns]


def pair_state(pair: PairFiles) -> dict[str, list[int] | None]:
    """Return the `file_state` of each file of a pair."""
    return {"left": file_state(pair.left), "right": file_state(pair.right), "disparity": file_state(pair.disparity)}


def write_record(path: Path, record: Mapping[str, Any], sources: Any) -> None:
    """Write a record as JSON, atomically.

    Args:
        path: The file.
        record: Contents.
        sources: State of all sources of the record as JSON, determined before they were read.

    Raises:
        OSError: The file cannot be written.
    """
    write_atomically(path, json.dumps({**record, _SOURCES: sources}) + "\n")


def is_current(path: Path, sources: Any, is_complete: Callable[[dict[str, Any]], bool]) -> bool:
    """Return True if a record exists, is complete, and was made from the current sources.

    Args:
        path: The file.
        sources: Current state of its sources.
        is_complete: Function that returns True for a complete record; it may raise ValueError, KeyError, TypeError or
            AttributeError for a malformed one.
    """
    try:
        record = read_json(path)
        return is_complete(record) and record[_SOURCES] == sources
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError):
        return False


def claim_folder(
    out: Path,
    unit: str,
    folders: Iterable[PlotFolder],
    calibrations: Mapping[str, Calibration | None],
    about: Mapping[str, Any],
    begun: bool,
) -> None:
    """Write the request to its results folder, and check that the results there belong to the same request.

    A folder without results may be claimed for another request. A plot may get its calibration later.

    Args:
        out: The folder; created if missing.
        unit: Noun for the folders of pairs, in the plural: their key in run.json.
        folders: Folders of pairs.
        calibrations: Calibration of each folder by name; None if there is none.
        about: Everything else that results depend on, as JSON.
        begun: True if the folder holds results; if not, its request is replaced.

    Raises:
        RequestError: The folder holds the results of another request.
        OSError: The folder or file cannot be written.
    """
    request = {
        "version": jaxrl_vis.__version__,
        **about,
        "calibrations": {
            name: None if calibration is None else dataclasses.asdict(calibration) for name, calibration in calibrations.items()
        },
        unit: {folder.name: str(folder.folder.resolve()) for folder in folders},
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
    for folder in (out, out / "runs", *out.glob("pairs/*"), *out.glob("overlays/*")):  # a run may train in others
        for file in folder.glob(".*.tmp"):
            process = file.name[1:].partition("-")[0]
            if is_temporary(file.name) and not Path("/proc", process).exists():  # of a killed process
                file.unlink(missing_ok=True)
    write_atomically(path, json.dumps(request, indent=2) + "\n")


def _differences(recorded: Mapping[str, Any], current: Mapping[str, Any]) -> str:
    """Describe the relevant differences between two requests in one line; empty if there are none."""
    differences = []
    for name in dict.fromkeys([*current, *recorded]):
        old, new = recorded.get(name), current.get(name)
        if name == "calibrations" and isinstance(old, dict) and isinstance(new, dict):
            # A calibration added later is no conflict: records store theirs and are made again.
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
