"""Extraction of the code blocks of the README and docs/, and checks of the commands in their shell blocks."""

import importlib.util
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LANGUAGES = {"python", "sh", "toml"}
# What begins a line of a shell block; a block without a language that begins otherwise is a drawing.
PROGRAMS = {"cd", "git", "jaxrl-vis", "make", "pip", "python", "source", "uv"}


class Block(NamedTuple):
    """Block of code: its language ("" for a drawing), the number of its first line in the page, and its text."""

    language: str
    line: int
    text: str

    @property
    def mark(self) -> str:
        """Text of a first line `# needs ...` or `# after ...`, the reason why the block cannot run as it is; empty if none."""
        found = re.match(r"# ((?:needs|after) .*)\n", self.text)
        return found[1] if found else ""


def blocks(page: Path) -> list[Block]:
    """Return the code blocks of a page: fenced, or indented by four spaces after an empty line."""
    found, lines = [], [*page.read_text().splitlines(), ""]
    fence, start, inside = None, 0, []
    for number, line in enumerate(lines, 1):
        if fence is not None:
            if line == "```":
                found.append(Block(fence, start, "\n".join([*inside, ""])))
                fence, inside = None, []
            else:
                inside.append(line)
        elif line.startswith("```"):
            fence, start = line[3:], number
        elif line.startswith("    ") and (inside or not lines[number - 2]):
            start, inside = start if inside else number, [*inside, line[4:]]
        elif inside:
            text = "\n".join([*inside, ""])
            language = "sh" if text.split(maxsplit=1)[0] in PROGRAMS else ""
            found.append(Block(language, start, text))
            inside = []
    assert fence is None, f"{page}: a block is not closed"
    return found


def pages_with(language: str) -> list[Path]:
    """Return the pages that contain blocks of a language."""
    return [page for page in PAGES if any(block.language == language for block in blocks(page))]


def commands(block: Block) -> Iterator[list[str]]:
    """Yield the words of each command of a shell block, without comments and preceding assignments (`NAME=value`)."""
    for line in block.text.replace("\\\n", " ").splitlines():
        for part in shlex.join(shlex.split(line.replace("<", "'<").replace(">", ">'"), comments=True)).split("'&&'"):
            words = shlex.split(part)
            while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
                words.pop(0)
            if words:
                yield words


def check_command(words: list[str]) -> None:
    """Check that the targets, extras, modules, scripts and options named by a command other than `jaxrl-vis` exist."""
    program, *rest = words
    assert program in PROGRAMS, f"{program}: say here how to check it"
    if program == "make":
        text = (ROOT / "Makefile").read_text()
        for word in rest:
            name, equals, _ = word.partition("=")
            assert re.search(rf"^{name} \?=" if equals else rf"^{name}:", text, re.MULTILINE), f"make {word}"
    elif program == "pip":
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        assert rest[0] == "install"
        for word in rest[1:]:
            found = re.fullmatch(r"\.(?:\[([\w,]+)\])?", word)
            assert found, f"pip install {word}: there is no such package in an index"
            assert set((found[1] or next(iter(extras))).split(",")) <= set(extras), word
    elif program == "python" and rest[0] == "-m":
        assert importlib.util.find_spec(rest[1]) is not None, f"there is no module {rest[1]}"
    elif program == "python" and not rest[0].startswith("-"):
        script = (ROOT / rest[0]).read_text()
        for word in rest:
            option = word.partition("=")[0]
            assert not option.startswith("--") or f'"{option}"' in script, f"{rest[0]} has no {option}"
