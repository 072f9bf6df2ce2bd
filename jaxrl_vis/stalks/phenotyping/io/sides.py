"""Names that say which of two cameras something is of: left and right, L and R, cam0 and cam1, infra1 and infra2, ..."""

import re
from collections.abc import Iterator
from typing import Literal

Side = Literal["left", "right"]
_WORD = re.compile(r"(?<![a-z])(left|right)(?![a-z])", re.IGNORECASE)
_LETTER = re.compile(r"(?<![a-z])[lr](?![a-z])", re.IGNORECASE)
_LAST_LETTER = re.compile(r"(?<=[a-z])[LR](?![A-Za-z])")
_NUMBER = re.compile(
    r"(?<![a-z])((?:cam|camera|image|im|img|infra|infrared|ir|view|sensor|stereo)_?)(0?[0-3])(?![0-9])", re.IGNORECASE
)
_OTHER = {"left": "right", "right": "left", "l": "r", "r": "l"}


def partners(name: str, numbered: bool = True) -> Iterator[tuple[Side, str]]:
    """Sides that a name may say, each with the name that the other camera's would have; the likeliest first.

    Args:
        name: Stem of a file, or name of a folder.
        numbered: If false, numbers of cameras are no sides.
    """
    for pattern in (_WORD, _LETTER, _LAST_LETTER):
        for match in reversed(list(pattern.finditer(name))):
            word = match.group()
            other = _OTHER[word.lower()]
            other = other.upper() if word.isupper() else other.capitalize() if word.istitle() else other
            side: Side = "left" if word.lower().startswith("l") else "right"
            yield side, name[: match.start()] + other + name[match.end() :]
    for match in reversed(list(_NUMBER.finditer(name))) if numbered else ():
        number, digits = int(match[2]), len(match[2])
        for side, other in (("left", number + 1), ("right", number - 1)):
            if other >= 0:
                yield side, name[: match.start(2)] + f"{other:0{digits}d}" + name[match.end() :]  # pyright: ignore
