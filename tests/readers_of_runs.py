"""How the files of a run's folder are read, for `readers_worker`."""

from readers_worker import Reader

READERS: dict[str, Reader] = {}
"""By name."""
