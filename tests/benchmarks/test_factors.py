"""Leave-one-out trainings of the stalk detector: their families, and the table of their records."""

import dataclasses
import json
from pathlib import Path

import pytest

from benchmarks.ledger.tables.factors import factors_table
from benchmarks.stalks import factors
from jaxrl_vis_envs import plants

FAMILIES = Path(factors.__file__).with_name("families")


def scene_values(path: Path) -> dict[str, object]:
    return dataclasses.asdict(plants.read(path).scene)


@pytest.mark.parametrize("group", factors.WITHOUT)
def test_a_family_lacks_its_group_alone(group: str, tmp_path: Path) -> None:
    spec = tmp_path / "spec.json"
    spec.write_text(json.dumps(factors.spec(group)))
    everything, without = scene_values(FAMILIES / "daylight.toml"), scene_values(spec)
    assert {name for name in everything if everything[name] != without[name]} == set(factors.WITHOUT[group])
    for name in factors.WITHOUT[group]:
        value = without[name]
        assert value[0] == value[1] if isinstance(value, tuple) else value == 0.0, f"{name} still varies"


def test_rows_are_in_the_order_of_the_groups(tmp_path: Path) -> None:
    assert factors_table(tmp_path) is None
    folder = tmp_path / "factors"
    folder.mkdir()
    about = {"updates": 4000, "revision": "abcdef0123", "device": "A GPU"}
    for name, group, found in (("a", "walls", "2 of 4"), ("b", factors.NOTHING, "4 of 4")):
        record = {**about, "group": group, "cells": {"plants found": found, "control": "0 of 24"}}
        (folder / f"{name}.json").write_text(json.dumps(record))
    assert factors_table(tmp_path) == (
        "| trained without | updates | plants found | control |\n|---|---|---|---|\n"
        "| nothing | 4,000 | 4 of 4 | 0 of 24 |\n| walls | 4,000 | 2 of 4 | 0 of 24 |\n\nMade by abcdef0 on A GPU."
    )
