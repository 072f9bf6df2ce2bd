"""The tool that compares tables and sentences of the documentation with the records of learning, and its verdict on them."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.claims import columns, pages, prose, weightings
from benchmarks.claims.markdown import Row, table
from benchmarks.claims.prose import Sentence
from benchmarks.claims.records import Record, study
from jaxrl_vis.errors import RequestError

ROOT = Path(__file__).resolve().parents[2]


def record(name: str, *seeds: list[float]) -> Record:
    """Return a record with evaluations of some seeds at 10, 20, ... environment steps."""
    rows = [
        {"seed": seed, "env_steps": 10 * (index + 1), "eval/success": value}
        for seed, values in enumerate(seeds)
        for index, value in enumerate(values)
    ]
    return Record(name, tuple(rows), frozenset({"abc on a GPU"}))


def test_every_published_figure_is_that_of_the_records():
    done = subprocess.run([sys.executable, "benchmarks/check_claims.py"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_weightings_are_ordered_by_success_and_compared_with_the_sum():
    def run(name: str, level: float) -> Record:
        time = {"time/wall_s": 50.0, "time/compile_s": 20.0}
        rows = [
            {"seed": seed, "env_steps": steps, "eval/success": level + seed / 100, **time}
            for steps in (30_000, 60_000)
            for seed in range(5)
        ]
        return Record(name, tuple(rows), frozenset({"abc on a GPU"}))

    text = weightings.task_table("VisualFetchReach", {"sum": run("a", 0.5), "uniform": run("b", 0.8)})
    first, second = (line.split(" | ") for line in text.splitlines()[2:4])
    assert (first[0], second[0]) == ("| `uniform`", "| `sum`")
    assert first[2].startswith("0.820 (") and first[3] == "0.008" and first[-1] == "30 |"
    assert second[2].startswith("0.520 (") and "0.008" not in second


def test_cells_say_what_can_be_counted_by_hand():
    slow = record("slow", *[[0.0, 0.1, 0.5, 0.5, 0.6, 0.6]] * 5)
    fast = record("fast", *[[0.5 + seed / 100, 0.5, 0.6, 0.7, 0.8, 0.9] for seed in range(5)])
    assert columns.steps_to(0.5).cell(slow) == "30"
    assert columns.steps_to(0.5, slow).cell(fast) == "10 (3.0)"
    assert columns.steps_to(0.9, slow).cell(slow) == "> 60"
    assert columns.median_at(10).cell(fast) == "0.52"
    assert columns.median_at(15).cell(fast) == ""
    assert columns.success_at(10).cell(fast) == "0.520 (0.510 to 0.530)"
    assert columns.mean_success(20).cell(slow) == "0.050 (0.050 to 0.050)"
    # Of 252 ways to divide ten seeds into fives, two are as extreme.
    assert columns.p_value_against(slow, "slow", 60).cell(fast) == f"{2 / 252:.3f}"
    assert columns.verdict(fast, slow, 60) == "better" and columns.verdict(slow, fast, 60) == "worse"
    assert columns.verdict(fast, record("again", *[[0.5 + seed / 100, 0.5] for seed in range(5)]), 20) == "level"
    with pytest.raises(ValueError, match="ends at 60"):
        slow.means(70)


def test_a_row_without_a_record_says_so():
    text = table(["run"], [Row("kept", record("kept", [0.25])), Row("lost", None)], [columns.median_at(10), columns.names()])
    assert text.splitlines()[2:4] == ["| kept | 0.25 | `` |", "| lost | no record kept | |"]
    assert text.endswith("Made by abc on a GPU.")


def test_an_edited_table_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pages, "CHECKOUT", tmp_path)
    monkeypatch.setattr(pages, "tables", lambda: {"page.md": {"one": "| 0.80 |"}})
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- one: begin (make tables) -->\n| 0.82 |\n<!-- one: end -->\nafter\n")
    assert [line for line in pages.differences() if line.startswith(("-|", "+|"))] == ["-| 0.82 |", "+| 0.80 |"]
    page.write_text(page.read_text().replace("0.82", "0.80"))
    assert not list(pages.differences())
    page.write_text("no markers")
    with pytest.raises(RequestError, match="one"):
        list(pages.differences())


def test_an_edited_sentence_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(prose, "CHECKOUT", tmp_path)
    monkeypatch.setattr(prose, "OTHER_NUMBERS", {"page.md": ("a discount of 0.98",)})
    page = tmp_path / "page.md"
    page.write_text("With a discount of 0.98 it has\n0.75 of them (`--x 0.3`).\n\n| 0.11 |\n")
    right = Sentence("page.md", "it has 0.75 of them", "a record")
    assert not list(prose.differences([right]))
    assert any("0.74" in line for line in prose.differences([Sentence("page.md", "it has 0.74 of them", "a record")]))
    assert any("does not say" in line for line in prose.differences([Sentence("page.md", right.quote, "a record", False)]))
    assert any("no record is registered for 0.75" in line for line in prose.differences([]))


def test_fresh_seeds_are_preferred_for_claims_only():
    stem = "VisualFetchReach-none-paper"
    assert study("ol_aux", stem).seeds == [0, 1, 2, 3, 4]
    fresh = study("ol_aux", stem, is_fresh=True, budget=240_000)
    assert fresh.seeds[0] >= 100 and len(fresh.seeds) % 5 == 0
    assert study("ol_aux", stem, is_fresh=True, budget=10_000_000).seeds == [0, 1, 2, 3, 4]
    assert np.isfinite(fresh.means(240_000)).all()
    with pytest.raises(LookupError):
        study("ol_aux", "NoSuchTask")
