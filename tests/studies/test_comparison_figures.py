"""Figures ``goals`` and ``weightings``: runs have the settings that their names say, and a table is that of invented runs."""

import csv
import json
from pathlib import Path

import pytest
from test_studies_figures import has_colour, slope, write_run

from jaxrl_vis import cli
from jaxrl_vis.config import preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.studies import goals, weightings
from jaxrl_vis.studies.engine.study import Scope, make_cells
from jaxrl_vis.studies.ol_aux import AUX_TASKS
from jaxrl_vis.weighting import WEIGHTINGS

STUDY = goals.STUDIES["goals"]


def test_algorithms_of_the_figure_have_what_presets_give_them() -> None:
    ((td3,), (contrastive,)) = make_cells(STUDY, ("VisualFetchReach",), ("td3_oracle", "contrastive"), Scope("fast")).values()
    for cell, algorithm in ((td3, "td3"), (contrastive, "contrastive")):
        wanted = preset("fast", env="VisualFetchReach", algorithm=algorithm)
        names = ("algorithm", "actor_interval", "target_update_interval", "future_goals", "trivial_goals")
        names += ("relabel_probability",) if algorithm == "contrastive" else ()
        assert {name: cell.config.value(name) for name in names} == {name: wanted.value(name) for name in names}
    ((features,),) = make_cells(STUDY, ("VisualReacher",), ("features",), Scope("fast")).values()
    assert (
        features.config.reward.reward_encoder == "encoders/VisualReacher.npz" and features.config.environment.image_size == 100
    )


def test_every_run_of_the_figure_is_valid_and_untuned() -> None:
    cells = make_cells(STUDY, tuple(STUDY.steps), tuple(goals.VARIANTS), Scope("fast"))
    assert len(cells) == 6 * len(goals.VARIANTS)
    assert {cell.config.network.random_shift for (cell,) in cells.values()} == {0}
    states = make_cells(STUDY, tuple(STUDY.optional_steps), ("oracle", "contrastive", "td3_oracle"), Scope("cpu"))
    assert all(cell.config.goals.future_goals == "geometric" for (_, name), (cell,) in states.items() if name == "contrastive")
    with pytest.raises(RequestError, match="unknown method 'qrl'"):
        make_cells(STUDY, tuple(STUDY.steps), ("qrl",), Scope("fast"))


def test_the_table_has_intervals_steps_and_seconds(tmp_path: Path) -> None:
    runs, out = tmp_path / "runs", tmp_path / "goals.png"
    cells = make_cells(STUDY, ("VisualFetchReach",), STUDY.variants, Scope("fast"))
    for (_, variant), (cell,) in cells.items():
        write_run(cell, runs, slope({"oracle": 20.0, "contrastive": 2.0}.get(variant, 6.0)), every=5000)
        file = runs / cell.name / "metrics.jsonl"
        rows = [json.loads(row) for row in file.read_text().splitlines()]
        rows = [row | {"time/wall_s": 30.0 + row["env_steps"] / 1000, "time/compile_s": 20.0} for row in rows]
        file.write_text("".join(json.dumps(row) + "\n" for row in rows))
    words = ["figure", "goals", "--tasks", "VisualFetchReach", "--draw-only", "--runs", str(runs), "--out", str(out)]
    assert cli.main(words) == 0
    assert all(has_colour(out, goals.VARIANTS[name].colour) for name in STUDY.variants)
    read = {row["method"]: row for row in csv.DictReader(out.with_suffix(".csv").read_text().splitlines())}
    oracle, contrastive = read["oracle"], read["contrastive"]
    # 20 per 250 k steps: 0.4 at 5 k, 0.8 at 10 k, then 1, but for a hundredth of the slower seeds.
    assert float(oracle["mean_success"]) == pytest.approx((0.4 + 0.8 + 8.0) / 10, abs=0.005)
    assert (int(oracle["steps_to_level"]), float(oracle["seconds_to_level"])) == (15_000, 25.0)
    assert contrastive["steps_to_level"] == "" and float(contrastive["seconds"]) == 60.0
    assert float(oracle["mean_success_low"]) <= float(oracle["mean_success"]) <= float(oracle["mean_success_high"])
    line = next(row for row in out.with_suffix(".md").read_text().splitlines() if row.startswith("| contrastive |"))
    assert "> 50 k" in line and line.endswith("| – | 60 |")


def test_every_weighting_is_a_valid_run_of_the_figure_weightings() -> None:
    study = weightings.STUDIES["weightings"]
    cells = make_cells(study, tuple(study.steps), study.variants, Scope("fast"))
    used = {cell.config.auxiliary.weighting for (cell,) in cells.values()}
    assert used == set(WEIGHTINGS) - {"none_log", "fixed", "ol_aux_ablation"}
    assert all(cell.config.auxiliary.aux_tasks == AUX_TASKS for (_, name), (cell,) in cells.items() if name != "none")
    assert len({variant.colour for variant in study.family.variants.values()}) == len(study.variants)
