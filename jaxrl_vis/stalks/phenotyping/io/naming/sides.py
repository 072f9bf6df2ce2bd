"""Names that identify the camera of a stereo pair: left and right, L and R, cam0 and cam1, infra1 and infra2, ..."""

import re
from collections.abc import Iterator
from typing import Literal

Side = Literal["left", "right"]
_WORD = re.compile(r"(?<![a-z])(left|right)(?![a-z])", re.IGNORECASE)
_LETTER = re.compile(r"(?<![a-z])[lr](?![a-z])", re.IGNORECASE)
_LAST_LETTER = re.compile(r"(?<=[a-z])[LR](?![A-Za-z])")
_CAMERAS = r"(?<![a-z])((?:cam|camera|im|infra|infrared|ir|view|sensor|stereo{})_?)(0?[0-3])(?![0-9])"
_NUMBER = re.compile(_CAMERAS.format("|image|img"), re.IGNORECASE)
_NUMBER_IN_FILES = re.compile(_CAMERAS.format(""), re.IGNORECASE)  # image_0 and image_1 may be the first two of many
_OTHER = {"left": "right", "right": "left", "l": "r", "r": "l"}


def partner_names(name: str, files: bool = False) -> Iterator[tuple[Side, str]]:
    """Yield the possible sides of a name, each with the corresponding name of the other camera; the most likely first.

    Args:
        name: Stem of a file, or name of a folder or topic.
        files: If true, the name is that of one image of many: only camera numbers and a capital L or R after a letter count.
    """
    for pattern in (_LAST_LETTER,) if files else (_WORD, _LETTER, _LAST_LETTER):
        for match in reversed(list(pattern.finditer(name))):
            word = match.group()
            other = _OTHER[word.lower()]
            other = other.upper() if word.isupper() else other.capitalize() if word.istitle() else other
            side: Side = "left" if word.lower().startswith("l") else "right"
            yield side, name[: match.start()] + other + name[match.end() :]
    for match in reversed(list((_NUMBER_IN_FILES if files else _NUMBER).finditer(name))):
        number, digits = int(match[2]), len(match[2])
        yield "left", name[: match.start(2)] + f"{number + 1:0{digits}d}" + name[match.end() :]
        if number:
            yield "right", name[: match.start(2)] + f"{number - 1:0{digits}d}" + name[match.end() :]
