"""Checksums of a finished folder's files, in the file ``SHA256SUMS`` beside them: ``sha256sum -c SHA256SUMS`` reads it, too."""

import hashlib
from pathlib import Path

from jaxrl_vis.files import replacing

FILE_NAME = "SHA256SUMS"


def _files(folder: Path) -> list[str]:
    """Names of all files below a folder, relative to it, in order; the checksums' own is left out."""
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return sorted(name for name in names if name not in (FILE_NAME, f"{FILE_NAME}.tmp"))


def _sum(file: Path) -> str:
    with file.open("rb") as contents:
        return hashlib.file_digest(contents, "sha256").hexdigest()


def write_sums(folder: Path) -> None:
    """Notes the checksums of all files below a folder, which nobody writes into any more.

    Raises:
        OSError: A file cannot be read, or the checksums cannot be written.
    """
    text = "".join(f"{_sum(folder / name)}  {name}\n" for name in _files(folder))
    with replacing(folder / FILE_NAME) as file:  # which makes no folder: this one may have been deleted meanwhile
        file.write(text.encode())


def compare_sums(folder: Path) -> list[str] | None:
    """Differences between a folder and its checksums, such as ``rest/d/6e55 has changed``; None where it has none.

    Raises:
        OSError: A file cannot be read.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return None
    noted: dict[str, str] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        digest, _, name = line.partition("  ")
        noted[name] = digest
    there = _files(folder)
    changed = [f"{name} has changed" for name in there if name in noted and _sum(folder / name) != noted[name]]
    added = [f"{name} does not belong to it" for name in there if name not in noted]
    return changed + added + [f"{name} is missing" for name in noted if name not in there]
