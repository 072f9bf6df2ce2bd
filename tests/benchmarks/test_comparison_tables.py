"""Tables of comparisons on goal images, from invented runs of which every cell can be counted by hand."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from test_ledger import make_run

from benchmarks.claims import contrastive_view, goals, records, weightings
from jaxrl_vis.studies.engine.study import Scope, make_cells
from jaxrl_vis.studies.goals import STUDIES

TASK, STATE_TASK = "VisualFetchReach", "FetchReach"
COMPILATION = 20.0


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Empty folder of records, instead of the checkout's."""
    monkeypatch.setattr(records, "RESULTS", tmp_path)
    records.study.cache_clear()
    yield tmp_path
    records.study.cache_clear()


def evaluations(success: list[float], seeds: range, every: int, seconds: float) -> list[dict[str, Any]]:
    """Return rows of seeds a hundredth apart whose median is ``success``, in ``seconds`` without compilation."""
    return [
        {
            "seed": seed,
            "env_steps": every * (index + 1),
            "eval/success": value + (seed - seeds[len(seeds) // 2]) / 100,
            "time/wall_s": COMPILATION + seconds * (index + 1) / len(success),
            "time/compile_s": COMPILATION,
        }
        for index, value in enumerate(success)
        for seed in seeds
    ]


def store(folder: Path, task: str, variant: str, success: list[float], seconds: float, **scope: int) -> None:
    """Store a method's runs as the figure's command names them, evaluated every 10 k steps to 10 k beyond the budget of 50 k.

    Each takes ``seconds`` and as many more as the number of its first seed.
    """
    of_seeds = dataclasses.replace(Scope("fast", seed=100, env_steps=60_000), **scope)
    for cell in make_cells(STUDIES["goals"], (task,), (variant,), of_seeds)[task, variant]:
        make_run(folder / "studies" / "goals" / cell.name, evaluations(success, cell.seeds, 10_000, seconds + cell.seeds[0]))


def rows_of(text: str) -> list[dict[str, str]]:
    """Return the rows of a table in Markdown as cells by title."""
    titles, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return [dict(zip(titles, row, strict=True)) for row in rows]


@pytest.mark.usefixtures("results")
def test_without_records_there_is_no_table() -> None:
    assert goals.tables() == weightings.tables() == contrastive_view.tables() == {}


def test_methods_are_in_the_study_s_order_and_compared_with_the_oracle(results: Path) -> None:
    good, bad = [0.5, 0.9, 0.9, 0.95, 0.95, 0.3], [0.95, 0.3, 0.4, 0.5, 0.6, 0.3]
    store(results, TASK, "contrastive", good, 1000, seeds=10, seeds_per_run=5)  # two programs
    store(results, TASK, "indicator", bad, 7)
    store(results, TASK, "oracle", good, 30)
    store(results, TASK, "oracle", [0.1] * 6, 99, seed=0)  # for tuning
    store(results, STATE_TASK, "oracle", bad, 5)
    store(results, "VisualReacher", "contrastive", bad, 5)
    ((page, tables),) = goals.tables().items()
    assert (page, set(tables)) == ("docs/algorithms.md", {TASK, STATE_TASK})
    oracle, indicator, contrastive = rows_of(tables[TASK])
    assert [row[TASK] for row in (oracle, indicator, contrastive)] == ["`oracle`", "`indicator`", "`contrastive`"]
    assert oracle["seeds"] == "100 to 104" and contrastive["seeds"] == "100 to 109"
    assert [row["steps to 0.9"] for row in (oracle, indicator, contrastive)] == ["20 k", "> 60 k", "20 k"]
    assert oracle["mean success to 50 k, IQM (95 %)"].startswith("0.840 (0.8")
    assert indicator["mean success to 50 k, IQM (95 %)"].startswith("0.550 (0.5")
    # Of 252 ways to divide ten seeds into fives, two are as extreme.
    assert [row["p against `oracle`"] for row in (oracle, indicator, contrastive)] == ["", "0.008", "1.000"]
    assert oracle["success at 60 k"] == "0.300 (0.290 to 0.310)"
    assert [row["seconds without compilation"] for row in (oracle, indicator, contrastive)] == ["130", "107", "2,205"]


def test_the_task_of_contrastive_rl_has_a_row_for_each_run(results: Path) -> None:
    curve = [0.5, 0.7, 0.92, 0.97, 0.98, 0.98]
    runs = {
        "contrastive_1M": evaluations([0.1, 0.2, 0.3, 0.4], range(100, 101), 250_000, 3000),
        "oracle": evaluations(curve, range(100, 105), 5_000, 60),
        "contrastive": evaluations([0.1] * 6, range(100, 105), 5_000, 50),
        "indicator_balance_filter": evaluations(curve[1:], range(100, 105), 5_000, 70),
    }
    for name, rows in runs.items():
        make_run(results / "contrastive_view" / name, rows)
    ((page, tables),) = contrastive_view.tables().items()
    assert (page, set(tables)) == ("docs/tasks.md", {"contrastive_view"})
    ours, oracle, contrastive, longer = rows_of(tables["contrastive_view"])
    assert list(oracle.values()) == [
        *("`oracle`", "100 to 104", "30 k", "20 k", "15 k", "0.920 (0.910 to 0.930)", "0.980 (0.970 to 0.990)"),
        *("60", "`oracle`"),
    ]
    assert (ours["method"], ours["environment steps"], ours["steps to 0.97"]) == ("`indicator_balance_filter`", "25 k", "15 k")
    assert (ours["success at 15 k"], ours["seconds without compilation"]) == ("0.970 (0.960 to 0.980)", "70")
    assert (contrastive["method"], contrastive["steps to 0.9"]) == ("`contrastive`, `stable`", "> 30 k")
    assert list(longer.values()) == [
        *("`contrastive`, `stable`", "100", "1 M", "> 1 M", "> 1 M", "", "0.400", "3,000", "`contrastive_1M`"),
    ]
