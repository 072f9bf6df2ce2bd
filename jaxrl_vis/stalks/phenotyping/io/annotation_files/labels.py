"""Selection of the annotations that are stalks, by their labels."""

import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.names import readable

_STALKS = {"stalk", "stalks"}
_CROPS = {"sorghum", "maize", "corn", "cane", "sugarcane", "wheat", "rice", "millet", "crop", "plant", "plants", "the", "a"}
_MAX_LISTED = 6


def select_stalks(annotations: list[dict[str, Any]], labels: Sequence[str], source: str) -> tuple[list[dict[str, Any]], str]:
    """Select the annotations whose label denotes a stalk.

    Args:
        annotations: Annotations with a label ``name`` each, which may be empty.
        labels: Labels that count as stalks, in any case; if empty, ``stalk`` and ``stalks``, optionally with the name of a crop
            and a number. If all annotations are unnamed, all are stalks.
        source: Name of the annotations, for messages.

    Returns:
        The selected annotations, and a one-line summary of the labels that were taken and left out.

    Raises:
        RequestError: No annotation has such a label.
    """
    names = Counter(_clean_name(annotation.get("name", "")) for annotation in annotations)
    if labels:
        wanted = {_clean_name(label).casefold() for label in labels}
        taken = {name for name in names if name.casefold() in wanted}
    elif set(names) <= {""}:
        taken = set(names)
    else:
        taken = {name for name in names if _names_a_stalk(name)}
    if not taken and names:
        there = _format_labels(names)
        if labels:
            raise RequestError(f"{source}: nothing is called {', '.join(labels)} there, but {there}: name one with --label")
        example = next((name for name, _ in names.most_common() if name), "stem")
        quoted = f"'{readable(example)}'" if " " in example else readable(example)
        raise RequestError(
            f"{source}: nothing is called a stalk there, but {there}: name what counts as one with --label, as --label {quoted}"
        )
    left_out = Counter({name: count for name, count in names.items() if name not in taken})
    chosen = Counter({name: count for name, count in names.items() if name in taken})
    summary = f"stalks: {_format_labels(chosen)}" + (f"; left out as none: {_format_labels(left_out)}" if left_out else "")
    return [annotation for annotation in annotations if _clean_name(annotation.get("name", "")) in taken], summary


def _names_a_stalk(name: str) -> bool:
    """Return True if a label means stalk and nothing else: ``stalk_2`` and ``sorghum stalk`` do, ``not stalk`` does not."""
    words = {word for word in re.split(r"[^a-z]+", name.casefold()) if word}
    return bool(words & _STALKS) and words <= _STALKS | _CROPS


def _clean_name(name: Any) -> str:
    return " ".join(str(name).split())[:200]


def _format_labels(names: Counter[str]) -> str:
    parts = [f"{readable(name) or 'without a name'} ({count})" for name, count in names.most_common(_MAX_LISTED)]
    return ", ".join(parts) + (f" and {len(names) - _MAX_LISTED} others" if len(names) > _MAX_LISTED else "")
