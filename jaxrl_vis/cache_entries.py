"""Mends XLA's cache on disk, which JAX writes in place: an entry that a kill has cut in half would be told of at every start.

JAX warns of an entry that it cannot read, compiles the program, and does not replace the entry, as there is one. So entries of
that program which are not whole are deleted when JAX warns, and it keeps what it has compiled.
"""

import contextlib
import re
import warnings
import zlib
from pathlib import Path
from typing import Any

import jax

_WARNING = "Error reading persistent compilation cache entry for '"
_SUFFIX = "-cache"
_ZSTANDARD = b"\x28\xb5\x2f\xfd"
_hooked: Any = None


def mend_damaged_entries() -> None:
    """From here on, damaged entries are deleted when JAX comes across them, and nothing is said; may be called again."""
    global _hooked
    if warnings.showwarning is _hooked:
        return
    before = warnings.showwarning

    def show(message: Any, *arguments: Any, **options: Any) -> None:
        found = re.match(f"{_WARNING}([^']+)'", str(message))
        if found is None or not _delete_damaged(found[1]):
            before(message, *arguments, **options)

    _hooked = warnings.showwarning = show
    warnings.filterwarnings("always", message=_WARNING)


def _delete_damaged(program: str) -> bool:
    """Deletes entries of a program that are not whole, or else all of that name, as one of them must be; True if it could."""
    folder = Path(str(jax.config.jax_compilation_cache_dir))
    entries = list(folder.glob(f"{program}-*{_SUFFIX}"))
    deleted = False
    for entry in [entry for entry in entries if not _is_whole(entry)] or entries:
        with contextlib.suppress(OSError):
            entry.unlink()
            deleted = True
    return deleted


def _is_whole(entry: Path) -> bool:
    """Returns whether an entry can be unpacked, by the library that JAX takes, which is there if an entry is of it."""
    try:
        contents = entry.read_bytes()
        if not contents.startswith(_ZSTANDARD):
            unpacking = zlib.decompressobj()
            unpacking.decompress(contents)
            return unpacking.eof
        import zstandard  # pyright: ignore[reportMissingImports]

        zstandard.ZstdDecompressor().decompress(contents)
    except Exception:  # whatever these libraries raise
        return False
    return True
