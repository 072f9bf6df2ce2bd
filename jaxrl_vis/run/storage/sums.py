"""Checksums of a finished folder's files, in the file ``SHA256SUMS``, for ``sha256sum -c SHA256SUMS`` as well."""

import hashlib
from pathlib import Path

from jaxrl_vis.host.files import replacing

FILE_NAME = "SHA256SUMS"


def _files(folder: Path) -> list[str]:
    """Return the paths of all files below a folder, relative to it and sorted, except the checksum file."""
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return sorted(name for name in names if name not in (FILE_NAME, f"{FILE_NAME}.tmp"))


def _sum(file: Path) -> str:
    with file.open("rb") as contents:
        return hashlib.file_digest(contents, "sha256").hexdigest()


def write_sums(folder: Path) -> None:
    """Write the checksums of all files below a folder, which must be complete.

    Raises:
        OSError: A file cannot be read, or the checksums cannot be written.
    """
    text = "".join(f"{_sum(folder / name)}  {name}\n" for name in _files(folder))
    with replacing(folder / FILE_NAME) as file:  # does not create the folder, which may have been deleted meanwhile
        file.write(text.encode())


def compare_sums(folder: Path) -> list[str] | None:
    """List differences between a folder and its checksums, such as ``rest/d/6e55 has changed``; None if it has no checksums.

    Raises:
        OSError: A file cannot be read.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return None
    recorded: dict[str, str] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        digest, _, name = line.partition("  ")
        recorded[name] = digest
    present = _files(folder)
    changed = [f"{name} has changed" for name in present if name in recorded and _sum(folder / name) != recorded[name]]
    added = [f"{name} does not belong to it" for name in present if name not in recorded]
    return changed + added + [f"{name} is missing" for name in recorded if name not in present]
