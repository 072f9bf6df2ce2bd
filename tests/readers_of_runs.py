"""Readers of the files in a run's folder, for `readers_worker`."""

import json
from pathlib import Path

from readers_worker import Reader

from jaxrl_vis.errors import RequestError


def read_config(folder: Path) -> None:
    from jaxrl_vis.config import Config
    from jaxrl_vis.run.storage.folder import read_config, read_log, read_record

    record = read_record(folder)
    assert isinstance(record, dict)
    assert all(isinstance(each, str) for each in read_log(folder))
    assert isinstance(read_config(folder), Config)


def read_rows(folder: Path) -> None:
    from jaxrl_vis.run.storage.metrics import read_rows, scalars

    for row in read_rows(folder / "metrics.jsonl"):
        assert type(row["iteration"]) is int and type(row["seed"]) is int
        assert all(isinstance(value, float) for value in scalars(row).values())


def _json(path: Path) -> bool:
    try:
        json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        return False
    return True


def _some_lines(path: Path) -> bool:
    lines = path.read_bytes().splitlines()
    kinds = []
    for line in lines:
        try:
            kinds.append(isinstance(json.loads(line), dict))
        except (ValueError, RecursionError):
            kinds.append(False)
    return any(kinds)


READERS: dict[str, Reader] = {
    "config": Reader(read_config, lambda folder: _json(folder / "config.json"), (RequestError,)),
    "metrics": Reader(read_rows, lambda folder: _some_lines(folder / "metrics.jsonl"), (RequestError,)),
}
"""Readers by kind of file."""
