"""Manifest of a checkpoint: descriptions of its arrays, and the host's progress."""

from typing import Any

from jaxrl_vis.run.storage.progress import Progress

SCHEMA = 2
FILE = "manifest/metadata"
"""Path within a checkpoint's folder, as written by orbax."""


def is_manifest(value: Any) -> bool:
    """Return True if a value is a manifest of `checkpoint`, in all parts that are used."""
    if not isinstance(value, dict) or not isinstance(value.get("items"), dict) or "schema" not in value:
        return False
    arrays = [entry for item in value["items"].values() for entry in (item.values() if isinstance(item, dict) else [None])]
    are_arrays = all(
        isinstance(entry, list)
        and len(entry) in (3, 4)
        and isinstance(entry[0], list)
        and isinstance(entry[1], str)
        and all(isinstance(number, int) for number in (*entry[0], *entry[2:]))
        for entry in arrays
    )
    try:
        Progress.from_dict(value["progress"])
    except (KeyError, ValueError, AttributeError, TypeError):
        return False
    return are_arrays
