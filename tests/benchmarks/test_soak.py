"""Sample of the soak (benchmarks/soak): real runs, interrupted by a few faults and resumed, and the storage of its records."""

import dataclasses
import json
import math

import pytest

from benchmarks.ledger import pages
from benchmarks.ledger.markers import fill
from benchmarks.soak import run_process
from benchmarks.soak.record import GUARANTEES, Record, add_records
from benchmarks.soak.soak import Soak

FAULTS, SEED = 2, 156  # SIGKILL during a save, then SIGTERM


@pytest.mark.slow
def test_a_minute_of_faults(tmp_path, monkeypatch):
    options = list(run_process.OPTIONS)
    options[options.index("--env-steps") + 1] = str(80 * run_process.STEPS)  # a third of a soak's runs
    monkeypatch.setattr(run_process, "OPTIONS", options)
    soak = Soak(tmp_path, FAULTS, SEED, math.inf, note=lambda record: None, alone=False)
    soak.train_reference()
    soak.work(0)
    assert not soak.record.broken
    assert soak.record.total == FAULTS and len([count for count in soak.record.faults.values() if count]) == FAULTS
    assert soak.record.runs >= 1 and 0 < soak.record.done <= soak.record.begun and soak.record.resumes >= FAULTS - 1


def record(seed: int, **changes) -> Record:
    machine = {"commit": "abc", "versions": {}, "cores": 16, "root": True}
    faults = dict.fromkeys(GUARANTEES, 1) | {"SIGKILL": 10}
    base = Record(machine, seed, 9.0, faults, runs=6, exact=5, done=1000, begun=1010, resumes=48, replays_lost=1)
    return dataclasses.replace(base, **changes)


def test_pieces_are_added(tmp_path):
    for seed in (1, 2):
        record(seed).write(tmp_path / "soak" / f"{seed}.json")
    total = add_records([Record.read(piece) for piece in sorted((tmp_path / "soak").iterdir())])
    assert total.faults["SIGKILL"] == 20 and total.total == 2 * (len(GUARANTEES) - 1 + 10) and len(GUARANTEES) >= 15
    assert (total.minutes, total.runs, total.exact, total.resumes, total.replays_lost) == (18.0, 12, 10, 96, 2)
    table = total.table()
    assert "| SIGKILL | 20 |" in table and "goodput 0.990 over 96 resumptions; replay lost 2 times" in table
    begin, end = "<!-- soak: begin -->\n", "<!-- soak: end -->\n"
    assert fill(f"before\n{begin}old\n{end}after\n", "soak", table) == f"before\n{begin}{table}{end}after\n"
    assert pages.soak(tmp_path) == table and pages.soak(tmp_path / "soak") is None
    assert json.loads((tmp_path / "soak" / "1.json").read_text())["machine"]["commit"] == "abc"


def test_what_cannot_be_added_is_refused():
    with pytest.raises(ValueError, match="different commits"):
        add_records([record(1), record(2, machine={"commit": "def"})])
    with pytest.raises(ValueError, match="same piece twice"):
        add_records([record(1), record(1)])


def test_a_violated_guarantee_is_in_the_table():
    assert "**violations: 1**" in record(1, broken=["run3, ['SIGKILL']: rows were lost"]).table()
