"""Stored records: which of them are stale, and the tables of README and docs that are written from them."""

import dataclasses
import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
from test_provenance import commit

from benchmarks.ledger import __main__ as ledger
from benchmarks.ledger import ablations, evidence, pages, records, staleness
from benchmarks.ledger.tables import lab_results as tables
from benchmarks.ledger.tables.comparison import RATES, comparison_table
from benchmarks.ledger.tables.lab_rows import DEVICES, LEARNING, Figure, Learning
from jaxrl_vis.cli.parsing import parse
from jaxrl_vis.cli.train import Train, training_config
from jaxrl_vis.config import preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.report import learning as curves

GENERATED = {"fields", "metrics"}
"""Names of tables that docs/tools writes from the code."""

CODE = '''"""A module."""

import math


def area(radius: float) -> float:
    """Of a disc."""
    if radius < 0:
        raise ValueError("negative")
    return math.pi * radius**2
'''
# Another name of file, other words, no annotations, another import: the same computation.
REWORDED = '''"""Discs."""

from math import pi  # noqa
import math


def area(radius):
    # A comment.
    """What a disc covers."""
    if radius < 0:
        raise ValueError(f"a radius cannot be negative: {radius}")
    return math.pi * radius**2
'''


def kept(value: float = 1.0, **changes: Any) -> dict[str, Any]:
    return {
        "schema": 1,
        "name": "disc/speed",
        "value": value,
        "unit": "discs/s",
        "config": {"discs": 8},
        "details": {},
        "device": "A processor, 2 cores",
        "versions": {},
        "revision": "0" * 12,
        "date": "2026-01-01T00:00:00+00:00",
        **changes,
    }


@pytest.fixture
def discs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Checkout with one record of its current revision."""
    subprocess.run(("git", "init", "-q", str(tmp_path)), check=True)
    (tmp_path / "jaxrl_vis" / "discs").mkdir(parents=True)
    (tmp_path / "jaxrl_vis" / "discs" / "area.py").write_text(CODE)
    (tmp_path / "jaxrl_vis" / "discs" / "disc.xml").write_text("<disc/>")
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "disc.json").write_text(json.dumps([kept(revision=commit(tmp_path)[:12])]))
    monkeypatch.setattr(staleness, "MEASURED", {"disc/speed": ("jaxrl_vis/discs",)})
    return tmp_path


def complaints(checkout: Path) -> list[str]:
    return [str(stale) for stale in staleness.stale_records(checkout / "results", checkout)]


def test_a_record_lasts_as_long_as_its_code(discs: Path) -> None:
    assert complaints(discs) == []
    folder = discs / "jaxrl_vis" / "discs"
    (folder / "area.py").unlink()
    (folder / "round.py").write_text(REWORDED)
    (discs / "jaxrl_vis" / "elsewhere.py").write_text("x = 1\n")
    assert complaints(discs) == []
    (folder / "round.py").write_text(REWORDED.replace("**2", "**3"))
    (line,) = complaints(discs)
    assert line.startswith("stale: disc.json: 1 record disc/speed of ") and line.endswith("changed since: round.py (area)")


def test_other_files_count_whole(discs: Path) -> None:
    (discs / "jaxrl_vis" / "discs" / "disc.xml").write_text("<disc radius='2'/>")
    (line,) = complaints(discs)
    assert "changed since: disc.xml" in line


def test_a_constant_is_named(discs: Path) -> None:
    (discs / "jaxrl_vis" / "discs" / "area.py").write_text(CODE + "\nSIDES: int = 12\n")
    assert complaints(discs)[0].endswith("area.py (SIDES)")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"revision": "f" * 12}, "its revision is not in this repository"),
        ({"revision": "unknown"}, "its revision is not in this repository"),
        ({"revision": "0123456789ab-dirty"}, "never committed"),
        ({"name": "disc/weight"}, "which code disc/weight measures is unknown"),
    ],
)
def test_what_cannot_be_traced_is_stale(discs: Path, change: dict[str, str], why: str) -> None:
    (discs / "results" / "disc.json").write_text(json.dumps([kept(**change), kept(**change, config={"discs": 9})]))
    (line,) = complaints(discs)
    assert "2 records" in line and why in line


def test_code_of_the_other_kind_of_device_does_not_count(discs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(staleness, "_ON_GPU", ("jaxrl_vis/discs/gpu",))
    kernel = discs / "jaxrl_vis" / "discs" / "gpu_kernel.py"
    kernel.write_text("x = 1\n")
    assert complaints(discs) == []
    revision = json.loads((discs / "results" / "disc.json").read_text())[0]["revision"]
    (discs / "results" / "disc.json").write_text(json.dumps([kept(revision=revision, device="NVIDIA H100 x1")]))
    assert "gpu_kernel.py" in complaints(discs)[0]


def test_without_git_it_says_so_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "disc.json").write_text(json.dumps([kept()]))
    assert ledger.main(["stale", "--results", str(tmp_path)], checkout=tmp_path) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert "not a git checkout" in line


def test_what_was_not_looked_at_is_not_called_good(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert ledger.main(["stale", "--results", str(tmp_path)], checkout=tmp_path) == 0
    assert "every row has one" not in capsys.readouterr().out


@pytest.mark.parametrize("name", staleness.MEASURED)
def test_measured_files_are_there(name: str, checkout: Path) -> None:
    for env in ("VisualFetchReach", "VisualFetchPush"):  # the second modifies the model of the first
        for on_cpu in (True, False):
            assert list(staleness.measured_files(name, env, on_cpu, checkout))


def test_every_kept_record_has_a_list_of_files() -> None:
    assert {entry["name"] for _, entry in records.read_all(records.RESULTS)} <= set(staleness.MEASURED)


@pytest.mark.parametrize("page", pages.PAGES)
def test_a_page_says_what_the_records_say(page: str) -> None:
    text = (records.CHECKOUT / page).read_text()
    assert pages.fill_page(text, pages.PAGES[page]) == text, "make tables"


def test_every_table_between_markers_has_a_writer() -> None:
    writers = pages.writers(records.RESULTS)
    for page in [records.CHECKOUT / "README.md", *sorted((records.CHECKOUT / "docs").rglob("*.md"))]:
        names = set(re.findall(r"<!-- ([\w ]+): begin", page.read_text()))
        assert names - GENERATED == set(writers.get(page.relative_to(records.CHECKOUT).as_posix(), {})), page


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The page of results of an otherwise empty checkout, which is the only page with tables."""
    monkeypatch.setattr(pages, "PAGES", {tables.PAGE: pages.PAGES[tables.PAGE]})
    page = tmp_path / tables.PAGE
    page.parent.mkdir(parents=True)
    page.write_text("before\n<!-- results table: begin -->\nold\n<!-- results table: end -->\nbetween\n")
    return page


def test_tables_go_between_their_markers(page: Path, tmp_path: Path) -> None:
    folder = tmp_path
    with pytest.raises(RequestError, match="speed table: begin"):
        list(pages.write_pages(folder, folder))
    assert list(pages.outdated_page_messages(folder, folder))[0].startswith(f"{tables.PAGE}: there are no markers")
    with page.open("a") as file:
        file.write("<!-- speed table: begin (so) -->\n<!-- speed table: end -->\nafter\n")
    assert list(pages.write_pages(folder, folder)) == [(page, True)]
    text = page.read_text()
    assert "old" not in text and text.count(tables.MISSING) >= len(LEARNING)
    assert text.startswith("before\n<!-- results") and "-->\nbetween\n<!--" in text and text.endswith("-->\nafter\n")
    assert list(pages.write_pages(folder, folder)) == [(page, False)]
    missing = list(tables.missing_rows(folder))
    assert any("has no evidence" in line for line in missing) and any("has no record" in line for line in missing)


def test_a_figure_takes_the_best_record_or_the_hardest() -> None:
    device = DEVICES["H200"]
    records = [
        kept(2000.0, device=device, config={"discs": 8, "pixels": "rgbd"}, details={"ratio": 3.0}),
        kept(1000.0, device=device, config={"discs": 4, "pixels": "rgbd"}, details={"ratio": 2.0}),
        kept(9000.0, config={"discs": 64, "pixels": "rgbd"}),
    ]
    best = Figure("disc/speed", {}, "{value} of {discs:,} in {pixels}")
    assert tables.speed_cell((best,), device, records) == "2.00 k of 8 in RGB-D"
    hardest = dataclasses.replace(best, text="{ratio} times", minimum_of="ratio")
    assert tables.speed_cell((hardest, dataclasses.replace(best, config={"discs": 4})), device, records) == (
        "2.0 times; 1.00 k of 4 in RGB-D"
    )
    assert tables.speed_cell((Figure("disc/weight", {}, ""),), device, records) == tables.MISSING


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1_729_909.8, "1.73 M"),
        (999_600, "1.00 M"),
        (175_810, "176 k"),
        (3940, "3.94 k"),
        (999.7, "1.00 k"),
        (73.2, "73.2"),
        (0.5, "0.50"),
    ],
)
def test_figures_have_three_digits(value: float, text: str) -> None:
    assert tables.format_short(value) == text


def test_the_comparison_takes_the_variant_that_is_hardest_for_us(tmp_path: Path) -> None:
    device = DEVICES["H200"]
    scene = {"scene": "primitives", "image_size": 64, "pixels": "rgbd"}
    stored = []
    for poses, ours, ratio in (("start", 2000.0, 2.0), ("scattered", 9000.0, 9.0)):
        config = {**scene, "poses": poses}
        stored += [
            kept(ours, name="render/scene", device=device, config={**config, "images": 4}),
            kept(
                1000.0,
                name="render/peer_warp",
                device=device,
                config={**config, "images": 8},
                details={"ours_over_peer": ratio},
            ),
        ]
    (tmp_path / "render.json").write_text(json.dumps(stored))
    rows = comparison_table(tmp_path).splitlines()[2:]
    assert len(rows) == len(RATES) + 1
    (row,) = [row for row in rows if tables.MISSING not in row]
    assert row.endswith("| 2.00 k images/s | MuJoCo Warp: 1.00 k images/s | 2 times |")


def rows_of(success: list[float], seed: int = 0, every: int = 1000) -> list[dict[str, Any]]:
    return [
        {
            "iteration": index,
            "seed": seed,
            "env_steps": every * (index + 1),
            "updates": index,
            "eval/success": value,
            "train/loss": 1.0,
            "time/wall_s": 10.0 * (index + 1),
            "time/compile_s": 7.0,
        }
        for index, value in enumerate(success)
    ]


def make_run(folder: Path, rows: list[dict[str, Any]], **overrides: Any) -> Path:
    folder.mkdir(parents=True)
    about = {
        "schema": 2,
        "preset": "debug",
        "git_revision": "a" * 40,
        "versions": {"jax": "1"},
        "device": {"platform": "cpu", "kind": "cpu", "count": 1, "cpu_count": 2},
        "config": dataclasses.asdict(preset("debug", **overrides)),
    }
    (folder / "config.json").write_text(json.dumps(about))
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def test_a_run_is_kept_small(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_run(tmp_path / "run", rows_of([0.5, 0.9]), seeds=3, hidden_sizes=(8, 8), clip_targets_above=False)
    assert ledger.main(["keep", str(run), "discs", "--results", str(tmp_path)]) == 0
    assert [Path(line).name for line in capsys.readouterr().out.splitlines()] == ["discs.json", "discs.metrics.jsonl"]
    stored = evidence.load("discs", tmp_path)
    assert stored is not None
    assert set(stored.rows[0]) == {"seed", "env_steps", "updates", "eval/success", "time/wall_s", "time/compile_s"}
    assert stored.record["revision"] == "a" * 40
    assert set(stored.record) == {"schema", "name", "config", "command", "device", "versions", "revision", "date"}
    assert stored.record["command"] == (
        "jaxrl-vis train VisualFetchReach --preset debug --seeds 3 --no-clip-targets-above --hidden-sizes 8 8"
    )
    words = stored.record["command"].split()
    assert training_config(parse(Train, words[2:])) == preset("debug", seeds=3, hidden_sizes=(8, 8), clip_targets_above=False)
    assert [entry["name"] for _, entry in records.read_all(tmp_path) if entry.get("name")] == ["learning"]


def test_a_run_without_evaluations_is_not_kept(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="no evaluation"):
        evidence.keep_run(make_run(tmp_path / "run", []), "discs", tmp_path)
    with pytest.raises(RequestError, match="no config.json"):
        evidence.keep_run(tmp_path / "none", "discs", tmp_path)


def test_a_value_is_reached_when_the_next_two_evaluations_confirm_it() -> None:
    points = [(1, 0.9), (2, 0.5), (3, 0.9), (4, 0.95), (5, 0.9), (6, 0.9)]
    assert curves.steps_to(points, 0.9) == 3
    assert curves.steps_to(points, 0.95) is None
    # Of the last two evaluations nobody knows what comes after.
    assert curves.steps_to(points[:4], 0.9) is None
    assert curves.steps_to([(steps, -value) for steps, value in points], -0.9, lower_is_better=True) == 3


def test_curves_are_medians_over_all_seeds() -> None:
    rows = rows_of([0.1, 0.5]) + rows_of([0.3, 0.7], seed=1) + rows_of([0.2, 0.9, 1.0], seed=2)
    assert curves.curve(rows, "eval/success") == [(1000, 0.2), (2000, 0.7)]
    with pytest.raises(ValueError, match="seed 1 appears twice at 1000 steps"):
        curves.curve(rows + rows_of([0.3], seed=1), "eval/success")


def test_a_row_says_what_its_runs_reached(tmp_path: Path) -> None:
    for seed, success in ((0, [0.5, 0.9, 1.0, 1.0]), (1, [0.7, 0.9, 0.96, 0.98])):
        evidence.keep_run(make_run(tmp_path / f"run{seed}", rows_of(success, seed), seed=seed), f"discs{seed}", tmp_path)
    runs = {f"discs{seed}": preset("debug", seed=seed) for seed in (0, 1)}
    row = Learning("discs", runs, targets=(0.9, 0.97), steps=(2500,))
    text = tables.learning_text(row, tables.load_runs(row, tmp_path))
    assert text == (
        "success 0.90 by 2.00 k steps; success 0.97 not reached; success 0.90 at 2.00 k steps; success 0.99 (0.98 to 1) at the "
        "end, 4.00 k steps (median of 2 seeds); 40 s each, of which 7 s compiling"
    )
    other = dataclasses.replace(row, runs={**runs, "discs1": preset("debug", seed=1, batch_size=8)})
    with pytest.raises(RequestError, match="evidence discs1 was made by .*--batch-size 8"):
        tables.load_runs(other, tmp_path)
    assert tables.load_runs(dataclasses.replace(row, runs={**runs, "discs2": preset("debug")}), tmp_path) == []


def test_rows_ask_for_five_seeds_on_a_gpu() -> None:
    for row in LEARNING:
        assert sum(config.run.seeds for config in row.runs.values()) == (3 if "cpu" in next(iter(row.runs)) else 5)


@pytest.mark.usefixtures("page")
def test_the_command_line_checks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert ledger.main(["stale", "--results", str(tmp_path)], checkout=tmp_path) == 1
    assert "has no evidence fetch_reach_oracle" in capsys.readouterr().out


def test_tables_are_not_written_from_a_folder_that_is_not_there(
    page: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Regression test: with a misspelt name, every figure of the page was replaced by `MISSING`."""
    before = (records.CHECKOUT / tables.PAGE).read_text()
    page.write_text(before)
    for action in ("tables", "stale"):
        assert ledger.main([action, "--results", str(tmp_path / "nowhere")], checkout=tmp_path) == 2
        assert "there is no folder of records" in capsys.readouterr().err
    assert page.read_text() == before


@pytest.mark.usefixtures("page")
def test_a_damaged_file_of_records_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "env.json").write_text('[{"schema": 1,')
    assert ledger.main(["stale", "--results", str(tmp_path)], checkout=tmp_path) == 2
    line = capsys.readouterr().err
    assert "env.json is not JSON" in line and line.count("\n") == 1
    evidence.keep_run(make_run(tmp_path / "run", rows_of([0.5])), "discs", tmp_path)
    with (tmp_path / "learning" / "discs.metrics.jsonl").open("a") as file:
        file.write('{"seed": 0, "env_')
    with pytest.raises(RequestError, match="discs.metrics.jsonl has a line that is not JSON"):
        evidence.load("discs", tmp_path)


def test_curves_of_ablations_have_an_origin_and_whole_rows() -> None:
    stored = ablations.read_curves()
    assert len(stored) == 144 and sum(len(curve.rows) for curve in stored.values()) == 16_522
    for name, curve in stored.items():
        assert curve.name == name and curve.stored
        assert curve.page is None or (records.CHECKOUT / curve.page).exists()
        points = success_curve(curve.rows)
        assert points and all(0.0 <= value <= 1.0 for _, value in points)
    hand = stored["hand_shared"]
    assert dict(success_curve(hand.rows))[300_000] == pytest.approx(0.49, abs=0.005)  # docs/learner.md
    assert hand.command is not None and hand.command.startswith("jaxrl-vis train VisualHandReach --preset fast --seeds 3 ")
    assert stored["fetch_s"].command is None
    row = next(line for line in ablations.index_table().splitlines() if line.startswith("| fetch_s |"))
    assert row.count("unknown") == 3


def success_curve(rows: list[dict[str, Any]]) -> list[tuple[int, float]]:
    return curves.curve(rows, "eval/success")
