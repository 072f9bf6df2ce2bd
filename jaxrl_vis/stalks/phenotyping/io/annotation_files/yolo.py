"""Annotations of YOLO: a text file per image, with one box, rotated box or outline per line, normalised by the image size."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.stalks.phenotyping.io.annotation_files.shapes import Annotation, from_box, from_outline
from jaxrl_vis.stalks.phenotyping.io.file_storage import parse_storage
from jaxrl_vis_envs.documents import read_text

NAMES = ("data.yaml", "data.yml", "dataset.yaml", "dataset.yml", "classes.txt", "obj.names", "_darknet.labels")
"""Names of files that list the classes, in order of preference."""
_MAX_BYTES = 1_000_000  # of such a file
_BEYOND = 0.02  # of the image: tolerance for rounding and imprecise annotation beyond its border


def read_names(path: Path) -> list[str]:
    """Read the names of the classes, in order, from one of the files in `NAMES`.

    Raises:
        OSError: The file cannot be read.
        ValueError: It holds no names, or is of key points.
    """
    text = read_text(path, _MAX_BYTES)
    if path.suffix not in (".yaml", ".yml"):
        return [line.strip() for line in text.splitlines() if line.strip()]
    store = parse_storage(text)
    names = store.get("names") if isinstance(store, dict) else None
    if isinstance(store, dict) and store.get("kpt_shape") is not None:
        raise ValueError("it is of key points, not of boxes or outlines")
    if isinstance(names, dict):
        numbered = {float(number): str(name) for number, name in names.items()}
        return [numbered.get(float(index), str(index)) for index in range(int(max(numbered, default=-1.0)) + 1)][:10_000]
    if isinstance(names, list):
        return [str(name) for name in names]
    raise ValueError("it has no names")


def is_yolo(text: str) -> bool:
    """Return True if every non-blank line has at least five words and begins with a class number of at most four digits.

    A text without such lines, which annotates nothing, is in YOLO format, too.
    """
    lines = [line.split() for line in text.splitlines() if line.strip()]
    return all(len(words) >= 5 and re.fullmatch(r"\d{1,4}", words[0]) is not None for words in lines)


def read_yolo(path: Path, text: str, names: list[str], size: tuple[int, int]) -> list[Annotation]:
    """Parse the annotations of one image.

    Args:
        path: The file, for messages.
        text: Its contents.
        names: Names of the classes; the number of a class is its name if it is not listed.
        size: Width and height of the image, pixels.

    Raises:
        ValueError: A line is not in YOLO format, or has coordinates more than 2 % outside the image.
    """
    annotations = []
    for index, words in enumerate(line.split() for line in text.splitlines() if line.strip()):
        number, source = int(words[0]), f"{path}: annotation {index + 1}"
        name = names[number] if number < len(names) else str(number)
        values = [float(word) for word in words[1:]]
        if len(values) in (4, 5):
            coordinates: list[Any] = values[:4]  # the fifth is a confidence
        elif len(values) >= 6 and len(values) % 2 == 0:
            coordinates = values
        else:
            raise ValueError(f"line {index + 1} has {len(values)} numbers")
        if not all(math.isfinite(coordinate) and -_BEYOND <= coordinate <= 1.0 + _BEYOND for coordinate in coordinates):
            raise ValueError(f"line {index + 1} holds something that is not a fraction of an image")
        if len(coordinates) == 4:
            x, y, wide, high = (coordinate * size[axis % 2] for axis, coordinate in enumerate(coordinates))
            annotations.append(from_box(name, [x - wide / 2, y - high / 2, wide, high], source))
        else:
            annotations.append(from_outline(name, np.reshape(coordinates, (-1, 2)) * size, source))
    return annotations
