"""Figures 5.4 to 5.7 and their tables, from invented runs, and once from trained ones."""

import csv
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxrl_vis import cli
from jaxrl_vis.config import validate
from jaxrl_vis.host.spreadsheets import to_csv
from jaxrl_vis.run.storage.folder import SCHEMA
from jaxrl_vis.studies import indicator
from jaxrl_vis.studies.engine.cells import Cell, contradiction, is_finished
from jaxrl_vis.studies.engine.results import Line, StepsToLevel, find_steps, mean_weight
from jaxrl_vis.studies.engine.study import Scope, make_cells
from jaxrl_vis.studies.figures import indicator_figures
from jaxrl_vis.studies.figures.authors import mean_difference, released_curves
from jaxrl_vis.studies.figures.make import make_figure
from jaxrl_vis.studies.figures.show import Request
from jaxrl_vis.studies.figures.tables import LabelledLine, steps_table, weights_table
from jaxrl_vis.studies.ol_aux import AUX_TASKS, FETCH, FINGER, HAND, LEVELS, STUDIES, VARIANTS
from jaxrl_vis_envs import registry

STEPS_PER_EVALUATION = 20_000


def write_run(cell: Cell, runs: Path, success: Callable[[int], float], every: int = STEPS_PER_EVALUATION, **extra) -> None:
    """Write a finished run whose seeds differ by a hundredth."""
    folder = runs / cell.name
    folder.mkdir(parents=True)
    record = {
        "schema": SCHEMA,
        "git_revision": "a" * 40,
        "device": {"kind": "made up"},
        "config": dataclasses.asdict(cell.config),
    }
    (folder / "config.json").write_text(json.dumps(record))
    rows = [
        {"seed": seed, "iteration": n, "env_steps": n * every, "updates": n * every // 100}
        | {"eval/success": min(1.0, max(0.0, success(n * every) + 0.01 * (seed - 2)))}
        | {f"train/weight/{name}": extra.get(name, 1.0) * (1 + n / 100) for name in cell.config.auxiliary.aux_tasks}
        for n in range(1, -(-cell.config.run.env_steps // every) + 1)
        for seed in cell.seeds
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def slope(speed: float) -> Callable[[int], float]:
    return lambda steps: speed * steps / 250_000


def all_cells(figure: str, tasks=(), variants=(), **scope) -> dict[tuple[str, str], list[Cell]]:
    study = STUDIES[figure]
    return make_cells(study, tasks or tuple(study.steps), variants or (*study.extra_variants, *study.variants), Scope(**scope))


def test_the_cells_are_those_of_the_issue() -> None:
    cells = all_cells("5.4")
    assert len(cells) == 12 and all(len(parts) == 1 for parts in cells.values())
    budgets = {(task, variant): parts[0].config.run.env_steps for (task, variant), parts in cells.items()}
    assert {budgets[FETCH, name] for name in ("none", "balance", "cosine", "ol_aux_5")} == {250_000}
    assert {budgets[HAND, name] for name in ("none", "balance", "cosine", "ol_aux_5")} == {2_000_000}
    assert [budgets[FINGER, name] for name in ("none", "balance", "cosine", "ol_aux_5")] == [
        2_500_000,
        1_500_000,
        1_500_000,
        2_500_000,
    ]
    config = cells[FINGER, "ol_aux_5"][0].config
    assert (config.run.preset, config.run.seed, config.run.seeds, config.environment.frame_stack) == ("paper", 0, 5, 1)
    assert (config.auxiliary.weighting, config.auxiliary.weighting_interval, config.auxiliary.aux_tasks) == (
        "ol_aux",
        5,
        AUX_TASKS,
    )
    assert cells[FINGER, "none"][0].config.auxiliary.aux_tasks == ()
    alone = all_cells("5.5")
    assert alone[HAND, "egomotion"][0].config.auxiliary.aux_tasks == ("egomotion",)
    assert {parts[0].config.run.env_steps for (task, _), parts in alone.items() if task != FETCH} == {1_000_000}
    ablations = all_cells("5.7")
    assert {(task, parts[0].config.run.env_steps) for (task, _), parts in ablations.items()} == {
        (FETCH, 250_000),
        (HAND, 600_000),
    }
    assert ablations[HAND, "ol_aux_1"][0].config.auxiliary.weighting_interval == 1
    assert ablations[HAND, "ol_aux_5_ablation"][0].config.auxiliary.weighting == "ol_aux_ablation"


@pytest.mark.parametrize("preset", ["paper", "fast", "cpu", "debug"])
def test_every_variant_can_be_made_with_every_preset(preset: str) -> None:
    for parts in all_cells("5.4", variants=tuple(VARIANTS), preset=preset).values():
        config = parts[0].config
        assert config.run.updates_per_iteration % config.auxiliary.weighting_interval == 0
        assert bool(config.auxiliary.aux_tasks) == (config.auxiliary.weighting not in ("none", "none_log"))


def test_families_keep_configurations_apart() -> None:
    """Cells of the same name have the same configuration."""
    cells_by_name: dict[str, Cell] = {}
    for preset in ("paper", "fast"):
        for options in ((), ("view=fingertips",), ("view=fingertips", "tip_marks=faint")):
            for figure in STUDIES:
                changes = {"env_options": options}
                for parts in all_cells(figure, variants=tuple(VARIANTS), preset=preset, changes=changes).values():
                    assert parts[0].config.environment.env_options == options
                    assert cells_by_name.setdefault(parts[0].name, parts[0]) == parts[0]


def test_settings_of_an_environment_are_shown_and_name_one_folder(tmp_path: Path) -> None:
    scope = Scope(seeds=2, env_steps=100_000, changes={"env_options": ("depth_encoding=zbuffer", "clip_range=0.1/9")})
    ((cell,),) = make_cells(STUDIES["5.4"], (FETCH,), ("none",), scope).values()
    write_run(cell, tmp_path, slope(1.0))
    assert [folder.name for folder in tmp_path.iterdir()] == [cell.name]
    request = Request("5.4", STUDIES["5.4"], tmp_path / "f.png", tmp_path, (FETCH,), ("none",), scope, draw_only=True)
    assert make_figure(request, lambda line: None)
    assert "depth_encoding=zbuffer, clip_range=0.1/9; preset paper, one" in request.out.with_suffix(".md").read_text()
    plain = dataclasses.replace(request, scope=dataclasses.replace(scope, changes={}))
    assert not make_figure(plain, lambda line: None)  # these would be other runs


def test_what_the_authors_released_is_shipped() -> None:
    curves = released_curves()
    assert set(curves) == {(task, variant) for task in (FETCH, HAND, FINGER) for variant in ("none", "ol_aux_5")}
    assert curves[FETCH, "none"][4] == (100_000, pytest.approx(0.745, abs=0.006))
    assert curves[HAND, "ol_aux_5"][-1][0] == 4_000_000 and curves[FINGER, "ol_aux_5"][-1][0] == 3_360_000


def test_differences_of_curves_are_taken_where_both_are_known() -> None:
    ours = [(20, 0.0), (40, 0.2), (80, 0.4)]
    theirs = [(10, 9.0), (20, 0.1), (40, 0.1), (60, 0.3), (100, 9.0)]
    assert mean_difference(ours, theirs) == pytest.approx((0.1 + 0.1 + 0.0) / 3)
    assert mean_difference(ours, [(100, 1.0)]) is None and mean_difference([], theirs) is None


def line(values: list[list[float]], task: str = FETCH, variant: str = "ol_aux_5") -> Line:
    """Return a line with evaluations every 20 k steps; ``values`` are [S][P]."""
    rows = [
        {"seed": seed, "env_steps": STEPS_PER_EVALUATION * place, "updates": 200 * place, "eval/success": value}
        for seed, row in enumerate(values)
        for place, value in enumerate(row, 1)
    ]
    return Line(task, variant, rows)


def test_levels_are_reached_by_the_rule_of_three() -> None:
    result = find_steps(line([[0.1, 0.6, 0.4, 0.6, 0.7, 0.8]] * 3), 0.5)
    assert result == StepsToLevel(0.5, 80_000, 80_000.0, 80_000.0, 120_000) and str(result) == "80 k (80 k to 80 k)"
    # The last two evaluations have nothing after them.
    assert str(find_steps(line([[0.1, 0.1, 0.1, 0.1, 0.9, 0.9]]), 0.5)) == "> 120 k"
    one_never = find_steps(line([[0.9] * 6, [0.1, 0.9, 0.9, 0.9, 0.9, 0.9], [0.1] * 6]), 0.5)
    # Of three seeds the middle one counts, and one that never gets there is not averaged with the others.
    assert (one_never.steps, one_never.low, one_never.high) == (40_000, 20_000.0, None)
    assert str(one_never) == "40 k (20 k to > 120 k)"


def test_ratios_are_numbers_or_bounds() -> None:
    fast, slow, never = (StepsToLevel(0.5, steps, None, None, 250_000) for steps in (50_000, 100_000, None))
    assert [fast.ratio(slow), fast.ratio(never), never.ratio(slow), never.ratio(never)] == ["2.0", "> 5.0", "< 0.4", "–"]


def test_the_table_compares_with_the_baseline_of_the_same_source() -> None:
    ramp = [0.1 * place for place in range(1, 11)]
    twice = [min(1.0, 2 * value) for value in ramp]
    named = [
        LabelledLine("no auxiliary losses", line([ramp], variant="none")),
        LabelledLine("OL-AUX-5", line([twice])),
        LabelledLine("no auxiliary losses", line([twice], variant="none"), "authors"),
        LabelledLine("OL-AUX-5", line([twice]), "authors"),
    ]
    text, rows = steps_table({FETCH: named}, {FETCH: (0.5, 0.99)})
    body = [row for row in text if row.startswith("| ") and "---" not in row]
    assert len(body) == 5 and "60 k | 1.7" in body[2] and "(authors)" in body[4] and "60 k | 1.0" in body[4]
    assert "> 200 k" in body[1] and "> 2.0" in body[2]  # of 0.99
    read = list(csv.DictReader(to_csv(rows).splitlines()))
    assert len(read) == 8 and read[2]["method"] == "ol_aux_5" and read[2]["steps"] == "60000" and read[2]["speed_up"] == "1.7"
    assert read[1]["steps"] == "" and read[1]["budget"] == "200000"


def test_weights_are_compared_with_gains() -> None:
    names = {name: name for name in AUX_TASKS}
    base = line([[0.1] * 5], variant="none")
    alone = {(FETCH, name): line([[0.2 + 0.1 * place] * 5], variant=name) for place, name in enumerate(AUX_TASKS)}
    weighted = line([[0.5] * 5] * 3)
    for row in weighted.rows:
        row.update({f"train/weight/{name}": 10.0 * place + row["seed"] for place, name in enumerate(AUX_TASKS)})
    assert mean_weight(weighted, AUX_TASKS[1]) == pytest.approx(11.0)
    text, rows = weights_table({FETCH: weighted}, alone, {FETCH: base}, names)
    assert "+1.00 (of 5 losses)" in text[-2]
    assert [row["gain_alone"] for row in rows] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5])
    text, _ = weights_table({FETCH: weighted}, {}, {FETCH: base}, names)
    assert "not known before all runs of figure 5.5" in text[-2]


def has_colour(path: Path, colour: str) -> bool:
    wanted = [int(colour[place : place + 2], 16) for place in (1, 3, 5)]
    return int((np.abs(np.asarray(Image.open(path).convert("RGB"), int) - wanted).max(-1) <= 6).sum()) > 100


def test_a_figure_shows_what_is_finished_and_lists_the_rest(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs, out = tmp_path / "runs", tmp_path / "new" / "f.png"
    cells = all_cells("5.4")
    for (task, variant), (cell,) in cells.items():
        if (task, variant) != (HAND, "cosine") and task != FINGER:
            write_run(cell, runs, slope({"none": 1.0, "ol_aux_5": 2.0}.get(variant, 1.5)))
    words = ["figure", "5.4", "--draw-only", "--runs", str(runs), "--out", str(out)]
    assert cli.main(words) == 3
    printed = capsys.readouterr().out.splitlines()
    assert printed[:5] == [
        "not drawn: VisualHandReach-cosine-paper-seeds0to4-2M: not begun",
        *(f"not drawn: {cells[FINGER, name][0].name}: not begun" for name in STUDIES["5.4"].variants),
    ]
    assert printed[5:] == [str(out), str(out.with_suffix(".md")), str(out.with_suffix(".csv"))]
    assert all(has_colour(out, VARIANTS[name].colour) for name in STUDIES["5.4"].variants)
    text = out.with_suffix(".md").read_text()
    assert "preset paper, one gradient step per 100 environment steps; seeds 0 to 4" in text
    assert "| OL-AUX-5 | 80 k (80 k to 80 k) | 1.8 |" in text and "### VisualHandReach" in text
    assert "VisualFingerTurn" not in text.partition("Not finished")[0]
    ours = [(steps, min(1.0, slope(1.0)(steps))) for steps in range(STEPS_PER_EVALUATION, 260_001, STEPS_PER_EVALUATION)]
    difference = mean_difference(ours, released_curves()[FETCH, "none"])
    assert difference is not None and f"mean absolute difference to the authors' curve {difference:.3f}" in text
    assert "Revision: " + "a" * 40 in text and "Device: made up." in text
    read = list(csv.DictReader(out.with_suffix(".csv").read_text().splitlines()))
    assert {row["source"] for row in read} == {"here", "authors' release"}
    assert {float(row["level"]) for row in read if row["task"] == HAND} == set(LEVELS[HAND])

    # Figures share runs: 5.6 needs one of these, and the other tasks alone for its correlation.
    assert make_figure(Request("5.6", STUDIES["5.6"], tmp_path / "w.pdf", runs, tasks=(FETCH,), draw_only=True))
    assert "not known before all runs" in (tmp_path / "w.md").read_text()
    for place, name in enumerate(AUX_TASKS):
        (cell,) = all_cells("5.5")[FETCH, name]
        write_run(cell, runs, slope(1.1 + place / 10))
    assert make_figure(Request("5.6", STUDIES["5.6"], tmp_path / "w.pdf", runs, tasks=(FETCH,), draw_only=True))
    assert (tmp_path / "w.pdf").read_bytes().startswith(b"%PDF")
    assert "not defined" in (tmp_path / "w.md").read_text()  # all weights were alike
    shorter = Request("5.6", STUDIES["5.6"], tmp_path / "w.pdf", runs, (FETCH,), scope=Scope(env_steps=120_000), draw_only=True)
    assert make_figure(shorter)
    assert "not there yet" not in (tmp_path / "w.md").read_text()  # gains are those of figure 5.5, at its own budget
    assert make_figure(Request("5.5", STUDIES["5.5"], tmp_path / "alone.png", runs, tasks=(FETCH,), draw_only=True))
    assert all(has_colour(tmp_path / "alone.png", VARIANTS[name].colour) for name in AUX_TASKS)


def test_the_title_of_weights_names_their_method(tmp_path: Path) -> None:
    (cell,) = all_cells("5.6", (FETCH,), ("ol_aux_1",))[FETCH, "ol_aux_1"]
    write_run(cell, tmp_path, slope(1.0))
    request = Request("5.6", STUDIES["5.6"], tmp_path / "w.png", tmp_path, (FETCH,), ("ol_aux_1",), draw_only=True)
    assert make_figure(request)
    title = request.out.with_suffix(".md").read_text().splitlines()[0]
    assert title == "# Figure 5.6: Weights of the auxiliary losses in OL-AUX-1"


def test_rewards_with_and_without_ground_truth_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs, out = tmp_path / "runs", tmp_path / "f.png"
    study = indicator.STUDIES["5.1"]
    cells = make_cells(study, tuple(study.steps), study.variants, Scope("fast"))
    assert {(cell.config.reward.method, cell.config.environment.image_size) for (cell,) in cells.values()} == {
        (method, size) for method in study.variants for size in (64, 100)
    }
    for (task, variant), (cell,) in cells.items():
        if (task, variant) == ("VisualReacher", "autoencoder"):
            continue
        write_run(cell, runs, slope({"oracle": 4.0, "indicator": 1.0}.get(variant, 2.0)))
        file = runs / cell.name / "metrics.jsonl"
        rows = [json.loads(row) for row in file.read_text().splitlines()]
        drops = 0.2 if variant == "indicator_balance_filter" else 0.0
        for place, row in enumerate(rows):
            share = drops * (1 + place // len(cell.seeds))
            row |= {"eval/goal_distance": 0.05 * (1 - row["eval/success"]), "train/value_at_goals": 3.0}
            row |= {"train/positive_share": 0.5, "train/false_positive_share": 0.0, "train/false_negative_share": 0.1}
            row |= {"train/filtered_share": share, "train/filtered_false_share": share / 4, "train/filter_precision": 0.25}
        file.write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert cli.main(["figure", "5.1", "--draw-only", "--runs", str(runs), "--out", str(out)]) == 3
    printed = capsys.readouterr().out.splitlines()
    assert printed == ["not drawn: VisualReacher-autoencoder-fast-seeds0to4-100k: not begun"] + [
        str(tmp_path / name) for name in ("f.png", "f_rewards.png", "f.md", "f.csv")
    ]
    assert all(has_colour(out, study.family.variants[name].colour) for name in study.variants)
    text = out.with_suffix(".md").read_text()
    ours = next(row for row in text.splitlines() if row.startswith("| indicator, balanced and filtered"))
    assert ours.split(" | ")[1:2] == ["0.800 (0.790 to 0.810)"] and ours.endswith("| 0.600 | 0.250 | 3.000 |")
    assert next(row for row in text.splitlines() if row.startswith("| indicator | ")).endswith("| 0.000 | – | 3.000 |")
    assert "the oracle itself" not in text  # it reaches 1.0 at 100 k steps, but for a hundredth of its slowest seed
    read = list(csv.DictReader(out.with_suffix(".csv").read_text().splitlines()))
    assert len(read) == 7 and float(read[0]["final_distance"]) < 0.001 and read[1]["filter_precision"] == ""


def test_panels_say_no_more_about_an_inactive_filter_than_tables(tmp_path: Path) -> None:
    """Regression test: one dropped negative, which was false, was a dot at 100 %, although the table gave no precision."""
    study = indicator.STUDIES["5.2"]
    variant = "indicator_balance_filter"
    ((cell,),) = make_cells(study, ("VisualSawyerReach",), (variant,), Scope("fast")).values()
    write_run(cell, tmp_path, slope(1.0))
    for share, titles in ((0.009, 3), (0.011, 4)):
        file = tmp_path / cell.name / "metrics.jsonl"
        rewards = {"train/positive_share": 0.5, "train/false_negative_share": 0.1, "eval/goal_distance": 0.2}
        rewards |= {"train/filtered_share": share, "train/filtered_false_share": share, "train/filter_precision": 1.0}
        file.write_text("".join(json.dumps(json.loads(row) | rewards) + "\n" for row in file.read_text().splitlines()))
        line = Line("VisualSawyerReach", variant, [json.loads(row) for row in file.read_text().splitlines()])
        request = Request("5.2", study, tmp_path / "f.png", tmp_path)
        shown = indicator_figures.make_content(request, {(line.task, variant): line}, [line.task], [variant])
        curves, panels = shown.pictures[0].rows, [panel for row in shown.pictures[1].rows for panel in row]
        assert len(panels) == titles and all(panel.has_values for panel in panels)
        assert curves[1][0].title == "VisualSawyerReach: final distance to the goal (m)"


def test_distances_of_figures_are_in_metres() -> None:
    assert {registry.make(task).distance_unit for task in indicator.FAMILY.tasks} == {"m"}


def test_what_is_asked_for_twice_is_shown_once(tmp_path: Path) -> None:
    (cell,) = all_cells("5.4", (FETCH,), ("none",))[FETCH, "none"]
    write_run(cell, tmp_path, slope(1.0))
    words = ["figure", "5.4", "--draw-only", "--runs", str(tmp_path), "--out", str(tmp_path / "f.png")]
    assert cli.main([*words, "--tasks", FETCH, FETCH, "--methods", "none", "none"]) == 0
    assert (tmp_path / "f.md").read_text().count(f"### {FETCH}") == 1


def test_a_comparison_with_an_oracle_that_fails_does_not_count(tmp_path: Path) -> None:
    study = indicator.STUDIES["5.2"]
    ((cell,),) = make_cells(study, ("VisualSawyerReach",), ("oracle",), Scope("fast")).values()
    write_run(cell, tmp_path, slope(1.0))
    file = tmp_path / cell.name / "metrics.jsonl"
    rows = [json.loads(row) | {"eval/goal_distance": 0.2} for row in file.read_text().splitlines()]
    file.write_text("".join(json.dumps(row) + "\n" for row in rows))
    request = Request("5.2", study, tmp_path / "f.png", tmp_path, variants=("oracle",), scope=Scope("fast"), draw_only=True)
    assert make_figure(request)
    assert (
        "VisualSawyerReach: the oracle itself ends at a success of 0.640, where at least 0.9 is"
        in (tmp_path / "f.md").read_text()
    )


def test_runs_of_other_settings_are_drawn_only_where_nothing_is_trained_and_named(tmp_path: Path) -> None:
    (cell,) = all_cells("5.4")[FETCH, "none"]
    # Which logarithm the actor learns makes no difference where nothing is weighted.
    older = dataclasses.replace(cell, config=cell.config.replace(random_shift=3, actor_log="loss"))
    write_run(older, tmp_path, slope(1.0))
    assert contradiction(cell, tmp_path) and not is_finished(cell, tmp_path)
    request = Request("5.4", STUDIES["5.4"], tmp_path / "f.png", tmp_path, (FETCH,), ("none",), draw_only=True)
    assert make_figure(request)
    text = request.out.with_suffix(".md").read_text()
    assert "no auxiliary losses: not as it would be trained now, with random_shift (saved 3, asked 0)." in text


@pytest.mark.parametrize("preset", ["paper", "fast", "cpu", "debug"])
def test_every_figure_of_rewards_can_be_made_with_every_preset(preset: str) -> None:
    family = indicator.FAMILY
    for study in indicator.STUDIES.values():
        for parts in make_cells(study, family.tasks, study.variants, Scope(preset)).values():
            for cell in parts:
                validate(cell.config)


def test_a_run_that_lost_its_replay_is_owned_up_to(tmp_path: Path) -> None:
    (cell,) = all_cells("5.4")[FETCH, "none"]
    write_run(cell, tmp_path, slope(1.0))
    file = tmp_path / cell.name / "metrics.jsonl"
    rows = [json.loads(row) for row in file.read_text().splitlines()]
    file.write_text("".join(json.dumps(row | {"resume/replay_lost_at": 20}) + "\n" for row in rows))
    request = Request("5.4", STUDIES["5.4"], tmp_path / "f.png", tmp_path, (FETCH,), ("none",), draw_only=True)
    assert make_figure(request) and "went on without its replay" in (tmp_path / "f.md").read_text()


def test_seeds_of_several_runs_are_one_line(tmp_path: Path) -> None:
    scope = Scope(seeds_per_run=2)
    parts = make_cells(STUDIES["5.4"], (FETCH,), ("none",), scope)[FETCH, "none"]
    assert len(parts) == 3
    request = Request("5.4", STUDIES["5.4"], tmp_path / "f.png", tmp_path, (FETCH,), ("none",), scope, draw_only=True)
    for cell in parts[:2]:
        write_run(cell, tmp_path, slope(1.0))
    assert not make_figure(request) and not request.out.exists()
    write_run(parts[2], tmp_path, slope(1.0))
    assert make_figure(request) and "seeds 0 to 4" in request.out.with_suffix(".md").read_text()


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["5.4", "--tasks", "VisualFetch"], ["unknown task 'VisualFetch'", "VisualFetchReach"]),
        (["5.4", "--methods", "sums"], ["unknown method 'sums'", "sum"]),
        (["5.4", "--preset", "papr"], ["unknown preset 'papr'", "paper"]),
        (["5.4", "--quick", "--preset", "fast"], ["--quick", "--preset"]),
        (["5.4", "--seeds", "0"], ["--seeds must be at least 1"]),
        (["5.4", "--minutes", "0"], ["--minutes must be positive"]),
        (["5.4", "--minutes", "3", "--draw-only"], ["leave out --minutes"]),
        (["5.6", "--methods", "ol_aux_5", "ol_aux_1"], ["weights of one method", "ol_aux_1"]),
        (["5.6", "--methods", "sum"], ["weights of one method that learns them", "ol_aux_5"]),
        (["5.4", "--runs", "nowhere", "--draw-only"], ["--runs nowhere is not a folder", "--draw-only draws trained runs"]),
        (["5.4", "--runs", "/proc/x"], ["cannot write --runs /proc/x"]),
        (["5.4", "--out", "x.gif"], ["--out x.gif", ".png"]),
        (["quadratic", "--tasks", FETCH], ["--tasks", "not with quadratic"]),
        (["5.3"], ["unknown figure '5.3'"]),
    ],
)
def test_bad_requests_get_one_line(words: list[str], parts: list[str], here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["figure", *words]) == 2
    output = capsys.readouterr()
    assert output.out == "" and len(output.err.splitlines()) == 1 and not list(here.iterdir())
    for part in parts:
        assert part in output.err


def test_runs_that_end_before_the_authors_first_evaluation_are_drawn(tmp_path: Path) -> None:
    scope = Scope("cpu", seeds=1, env_steps=6_400)
    ((cell,),) = make_cells(STUDIES["5.4"], (FETCH,), ("none",), scope).values()
    write_run(cell, tmp_path, slope(1.0), every=3_200)
    request = Request("5.4", STUDIES["5.4"], tmp_path / "f.png", tmp_path, (FETCH,), ("none",), scope)
    said: list[str] = []
    assert make_figure(request, said.append)  # nothing is left to train
    assert said == [str(request.out.with_suffix(end)) for end in (".png", ".md", ".csv")]
    text = request.out.with_suffix(".md").read_text()
    assert "preset cpu" in text and "; seed 0." in text and "authors" not in text
