"""Repair of XLA's on-disk cache, which JAX does not write atomically: a truncated entry causes a warning at every start.

If JAX cannot read an entry it warns and recompiles the program, but does not replace the entry. So damaged entries of a program
are deleted when JAX warns about them, and JAX then stores the compiled program.
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


def repair_damaged_entries() -> None:
    """Install a hook that deletes damaged entries when JAX warns of them, and suppresses the warning; idempotent."""
    global _hooked
    if warnings.showwarning is _hooked:
        return
    before = warnings.showwarning

    def show(message: Any, *arguments: Any, **options: Any) -> None:
        matched = re.match(f"{_WARNING}([^']+)'", str(message))
        if matched is None or not _delete_damaged(matched[1]):
            before(message, *arguments, **options)

    _hooked = warnings.showwarning = show
    warnings.filterwarnings("always", message=_WARNING)


def _delete_damaged(program: str) -> bool:
    """Delete the damaged entries of a program, or all of them if none can be identified; return True if any was deleted."""
    folder = Path(str(jax.config.jax_compilation_cache_dir))
    entries = list(folder.glob(f"{program}-*{_SUFFIX}"))
    deleted = False
    for entry in [entry for entry in entries if not _is_intact(entry)] or entries:
        with contextlib.suppress(OSError):
            entry.unlink()
            deleted = True
    return deleted


def _is_intact(entry: Path) -> bool:
    """Return True if an entry can be decompressed, with the library that JAX used to write it."""
    try:
        contents = entry.read_bytes()
        if not contents.startswith(_ZSTANDARD):
            unpacking = zlib.decompressobj()
            unpacking.decompress(contents)
            return unpacking.eof
        import zstandard  # pyright: ignore[reportMissingImports]

        zstandard.ZstdDecompressor().decompress(contents)
    except Exception:  # the libraries raise various types
        return False
    return True
