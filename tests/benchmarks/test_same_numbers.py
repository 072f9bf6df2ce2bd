"""Comparison of the numbers of two revisions: `same_numbers.py`."""

import json
import sys

import pytest

from benchmarks import same_numbers


def test_runs_that_the_other_file_lacks_are_named_before_anything_is_trained(tmp_path, monkeypatch, capsys):
    before = tmp_path / "before.json"
    before.write_text(json.dumps({"reacher_states": []}))
    monkeypatch.setattr(same_numbers, "train", lambda name, folder: pytest.fail(f"{name} was trained"))
    monkeypatch.setattr(sys, "argv", ["same_numbers.py", "--compare", str(before), "--only", "reacher", "hand"])
    assert same_numbers.main() == 2
    assert capsys.readouterr().err == f"{before} has no numbers of hand: write it with the same --only\n"
    monkeypatch.setattr(same_numbers, "train", lambda name, folder: [])
    monkeypatch.setattr(sys, "argv", ["same_numbers.py", "--compare", str(before), "--only", "reacher"])
    assert same_numbers.main() == 0
