"""The manifest of a checkpoint: what it says of its arrays, and what the host has to remember."""

from collections.abc import Mapping
from typing import Any

from jaxrl_vis.run.progress import Progress

SCHEMA = 2
READABLE = (1, 2)
FILE = "manifest/metadata"
"""In a checkpoint's folder, where orbax writes it."""


def progress_in(manifest: Mapping[str, Any]) -> Any:
    """Progress in a manifest, as `Progress.from_dict` takes it; schema 1 called it "memo"."""
    return manifest.get("progress", manifest.get("memo", {}))


def is_manifest(value: Any) -> bool:
    """Returns whether a value is what `checkpoint` saves as a manifest, as far as it is relied on."""
    if not isinstance(value, dict) or not isinstance(value.get("items"), dict) or "schema" not in value:
        return False
    arrays = [each for item in value["items"].values() for each in (item.values() if isinstance(item, dict) else [None])]
    are_arrays = all(
        isinstance(each, list)
        and len(each) in (3, 4)
        and isinstance(each[0], list)
        and isinstance(each[1], str)
        and all(isinstance(number, int) for number in (*each[0], *each[2:]))
        for each in arrays
    )
    try:
        Progress.from_dict(progress_in(value))
    except (ValueError, AttributeError, TypeError):
        return False
    return are_arrays
