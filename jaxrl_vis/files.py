"""Writing files so that nobody ever reads half of one."""

import os
from pathlib import Path


def user_cache() -> Path:
    """The folder for what this project keeps for a user: ``jaxrl-vis`` in the user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxrl-vis"


def write_atomically(path: Path, text: str) -> None:
    """Replaces a file's contents in one step: a reader, or a power cut, sees the old contents or the new ones.

    Args:
        path: The file; folders that are missing on the way are made.
        text: The new contents, written as UTF-8.

    Raises:
        OSError: A folder cannot be made, or the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
