"""Tests of the commands that count and measure: their tables, comparison with the ground truth, and figures."""

import dataclasses
import functools
import json
import multiprocessing
import os
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from phenotype_plots import run, table
from test_worker_pool import wait_until

from jaxrl_vis import cli
from jaxrl_vis.stalks.cli.options import PlantOptions
from jaxrl_vis.stalks.phenotyping import pipeline
from jaxrl_vis.stalks.phenotyping.evaluation import scoring
from jaxrl_vis.stalks.phenotyping.io.calibration import read_calibration
from jaxrl_vis.stalks.phenotyping.io.folders import find_plots
from jaxrl_vis.stalks.phenotyping.io.images import read_image
from jaxrl_vis.stalks.phenotyping.pipeline import Request
from jaxrl_vis.stalks.phenotyping.report.overlay import draw_overlay
from jaxrl_vis.stalks.phenotyping.track.sightings import Sighting
from jaxrl_vis_envs.plants import FAMILIES, shift


def test_run_counts_and_measures(plots, results):
    rows = table(results / "plots.csv")
    assert [row["plot"] for row in rows] == ["plot_0000", "plot_0001"]
    stalks = table(results / "stalks.csv")
    for row in rows:
        truth = json.loads((plots / row["plot"] / "plot.json").read_text())
        assert int(row["stalks"]) == truth["count"] and row["flag"] == "ok" and row["pairs"] == "4"
        assert float(row["stalks_per_m"]) == pytest.approx(truth["count"] / 0.5, rel=0.05)
        own = [each for each in stalks if each["plot"] == row["plot"]]
        assert [int(each["stalk"]) for each in own] == list(range(1, truth["count"] + 1))
        true = [each["diameters"] if "diameters" in each else each["12in"]["diameter_mm"] for each in truth["stalks"]]
        assert np.mean([float(each["width_mm"]) for each in own]) == pytest.approx(np.mean(true), rel=0.1)
        assert all(float(each["width_se_mm"]) > 0 and each["method"] == "strip" for each in own)
    overlay = read_image(results / "overlays" / "plot_0000" / "000.png")
    assert overlay.shape == (338, 422, 3)
    assert (results / "skipped.csv").read_text() == "plot,pair,why\n"


def test_several_processes_write_the_same(plots, results, tmp_path):
    """Results depend neither on the number of processes, nor on which results exist already."""
    out = tmp_path / "out"
    assert run(plots, out, "--workers", "2") == 0
    written = sorted(path.relative_to(results) for path in results.rglob("*") if path.is_file())
    assert written == sorted(path.relative_to(out) for path in out.rglob("*") if path.is_file())
    same = [path for path in written if path.suffix in (".csv", ".json", ".png")]
    assert all((out / path).read_bytes() == (results / path).read_bytes() for path in same) and len(same) > 16
    for lost in ("pairs/plot_0000/001.json", "overlays/plot_0001/002.png", "stalks.csv"):
        (out / lost).unlink()
    assert run(plots, out, "--workers", "1") == 0
    assert all((out / path).read_bytes() == (results / path).read_bytes() for path in same)


@pytest.mark.parametrize("top", [-80.0, -3.0, 2.0, 150.0])
def test_labels_stay_in_the_image_and_darken_their_own_place_only(top):
    """A photograph may show a part of a stalk whose box begins above or below the image."""
    image = np.full((120, 200, 3), 100, np.uint8)
    plain = draw_overlay(image, [], [])
    sighting = Sighting((95.0, top, 105.0, top + 90.0), (100.0, 100.0), 0.9, top + 45.0, 100.0)
    changed = (draw_overlay(image, [sighting], [None]).astype(int) - plain).min(axis=-1) <= -40  # darkened, lines apart
    rows = np.flatnonzero(changed.sum(axis=1) > 15)
    assert 5 <= len(rows) <= 25 and np.ptp(rows) < 25


def sign(folder, image, pixels_per_metre, band, plot, pair):
    (folder / f"{plot.name} {pair.name}").write_text(str(os.getpid()))
    return []


def meet(folder, image, pixels_per_metre, band, plot, pair):
    """Find nothing, once pairs of two plots are processed at the same time."""
    if multiprocessing.parent_process() is not None:
        (folder / plot.name).touch()
        for _ in range(600):
            if len(list(folder.glob("plot_*"))) == 2:
                return []
            time.sleep(0.05)
        raise TimeoutError
    return []


def test_workers_do_not_wait_for_the_end_of_a_plot(plots, tmp_path):
    first, second = find_plots(plots)
    there = [dataclasses.replace(first, pairs=first.pairs[:2]), dataclasses.replace(second, pairs=second.pairs[:1])]
    calibrations = {plot.name: read_calibration(plots / plot.name / "calibration.yaml") for plot in there}
    said = []
    request = Request(tmp_path / "out", "strip", "nobody", calibrations)
    pipeline.run(there, functools.partial(meet, tmp_path), request, lambda *words: said.append(words), workers=2)
    assert sorted(said) == [(first.name, 1, 2), (first.name, 2, 2), (second.name, 1, 1)]
    again = []
    rows, _ = pipeline.run(there, functools.partial(meet, tmp_path), request, lambda *words: again.append(words), workers=2)
    assert again == [(first.name, 2, 2), (second.name, 1, 1)] and [row["plot"] for row in rows] == [first.name, second.name]


def test_this_process_compiles_for_its_workers(plots, tmp_path):
    """It processes the first pair of all, and workers the others: each of them would compile the same by itself."""
    there = find_plots(plots)
    calibrations = {plot.name: read_calibration(plots / plot.name / "calibration.yaml") for plot in there}
    request = Request(tmp_path / "out", "strip", "nobody", calibrations)
    pipeline.run(there, functools.partial(sign, tmp_path), request, workers=2)
    signed = {path.name: path.read_text() for path in tmp_path.glob("plot_*")}
    assert len(signed) == 8
    first = f"{there[0].name} {there[0].pairs[0].name}"
    assert [pair for pair, process in signed.items() if process == str(os.getpid())] == [first]


class FindsOnceAWorkerIsThere:
    """Detector of nothing that returns in the calling process once a worker has received it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ = state
        (self._folder / str(os.getpid())).touch()

    def __call__(self, image: Any, pixels_per_metre: Any, band: Any, plot: Any, pair: Any) -> list:
        if multiprocessing.parent_process() is None:
            wait_until(lambda: any(self._folder.iterdir()), 60.0)
        return []


def test_workers_start_while_this_process_compiles(plots, tmp_path):
    (there, *_), received = find_plots(plots), tmp_path / "received"
    received.mkdir()
    calibrations = {there.name: read_calibration(plots / there.name / "calibration.yaml")}
    there = dataclasses.replace(there, pairs=there.pairs[:2])
    request = Request(tmp_path / "out", "strip", "nobody", calibrations)
    pipeline.run([there], FindsOnceAWorkerIsThere(received), request, workers=8)
    assert len(list(received.iterdir())) == 1  # one pair is left, and needs no more


def test_two_pairs_are_processed_at_a_time_and_an_error_ends_both(plots, tmp_path):
    """Images of one pair are decoded while another is measured; the pairs after an error are not begun."""
    together = threading.Barrier(2, timeout=20)
    begun: list[tuple[str, str]] = []

    def find(image: Any, pixels_per_metre: Any, band: Any, plot: Any, pair: Any) -> Any:
        if (plot.name, pair.name) not in begun:
            begun.append((plot.name, pair.name))
        if len(begun) == 1:  # processed alone, and more than once, as nothing is detected
            return []
        if len(begun) <= 3:
            together.wait()
        else:
            time.sleep(0.5)
        raise ValueError("stop here")

    there = find_plots(plots)
    calibrations = {plot.name: read_calibration(plots / plot.name / "calibration.yaml") for plot in there}
    with pytest.raises(ValueError, match="stop here"):
        pipeline.run(there, find, Request(tmp_path / "out", "strip", "nobody", calibrations))
    assert 3 <= len(begun) < 8


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--workers", "0"], "--workers must be at least 1"),
        (["--min-score", "2"], "--min-score must be from 0 to 1"),
        (["--speed", "0"], "--speed must be more than 0"),
        (["--calibration", "missing.yaml"], "there is no calibration"),
        (["--masks", "network", "--weights", "missing.safetensors"], "cannot read the weights"),
        (["--weights", "missing.safetensors"], "--masks truth uses no weights: leave out --weights"),
        (["--speed", "0.05"], "--speed goes with an odometry.csv that holds times"),
    ],
)
def test_wrong_requests_of_run(plots, tmp_path, capsys, words, part):
    assert run(plots, tmp_path / "out", *words) == 2
    assert part in capsys.readouterr().err


def test_eval_compares_with_the_truth(plots, tmp_path, capsys):
    spec, out = plots.parent / "few.json", tmp_path / "eval.json"
    words = ["--spec", str(spec), "--width", "422", "--frames", "4", "--plots", "1", "--masks", "truth", "--json", str(out)]
    words += ["--thesis"]
    assert cli.main(["phenotype", "eval", *words]) == 0
    figures = json.loads(out.read_text())
    truth = json.loads((plots / "plot_0000" / "plot.json").read_text())
    assert figures["count_true"] == truth["count"] and figures["count_mae"] == 0.0 and figures["count_r2"] is None
    assert figures["f1"] > 0.9 and figures["width_mae_mm"] < 2.5 and figures["synthetic"] is True
    # The thesis's ways on the same finds: ellipses are biased, and its count depends on how many stalks an image shows.
    assert figures["thesis_width_mae_mm"] < 5 and figures["thesis_count_mae"] >= 0 and figures["width_24in_mae_mm"] is not None
    assert figures["each"][0]["widths_mm"] and figures["each"][0]["seconds_per_pair"] > 0
    said = capsys.readouterr().out
    assert "synthetic plots of family" in said and "count_mae" in said


def test_eval_looks_for_rows_elsewhere_as_run_does(monkeypatch):
    """Stalks are looked for at the usual distance, and again at the one that stereo shows."""
    family = FAMILIES["training"].at_width(422)
    family = dataclasses.replace(family, rig=dataclasses.replace(family.rig, frames=2, distance=0.6, distance_sd=0.0))
    distances = []
    true_detections = scoring._true_detections

    def find(stalks: Any, instance: Any, image: Any, pixels_per_metre: float, band: Any) -> Any:
        distances.append(family.rig.focal / pixels_per_metre)
        return true_detections(stalks, instance, image, pixels_per_metre, band)

    monkeypatch.setattr(scoring, "_true_detections", find)
    score = scoring.score_plot(family, 0, None)
    assert len(distances) == 4 and distances[::2] == pytest.approx([0.8, 0.8], rel=0.02)
    assert distances[1::2] == pytest.approx([0.6, 0.6], rel=0.1) and len(score.detections) > 4


def test_eval_in_two_processes_and_after_a_stop_is_the_same(plots, tmp_path, capsys):
    small = ["--spec", str(plots.parent / "few.json"), "--width", "211", "--frames", "2", "--masks", "truth"]

    def evaluate(name: str, *words: str) -> dict:
        assert cli.main(["phenotype", "eval", *small, "--json", str(tmp_path / name), *words]) == 0
        data = json.loads((tmp_path / name).read_text())
        for each in (data, *data["each"]):  # times are not metrics
            each.pop("seconds_per_pair")
            each.pop("workers", None)
        return data

    both = evaluate("both.json", "--plots", "2", "--workers", "2")
    assert [each["seed"] for each in both["each"]] == [0, 1] and both["finds"] > 0
    first = evaluate("one.json", "--plots", "1")
    assert first["plots"] == 1
    capsys.readouterr()
    assert evaluate("one.json", "--plots", "2") == both
    said = capsys.readouterr().out
    assert "evaluated before: 1 of 2 plots" in said and "plot 0:" not in said and "plot 1:" in said
    # What was evaluated under other conditions is neither mixed with nor lost.
    for words in (["--method", "ellipse"], ["--frames", "3"]):
        assert cli.main(["phenotype", "eval", *small, "--json", str(tmp_path / "one.json"), *words]) == 2
        assert "holds records of another evaluation" in capsys.readouterr().err
    (tmp_path / "other.json").write_text("[]")
    assert cli.main(["phenotype", "eval", *small, "--json", str(tmp_path / "other.json")]) == 2
    assert "holds no records to resume" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["train", "weights.bin"], "ends in .safetensors"),
        (["train", "weights.safetensors", "--minutes", "0"], "--minutes must be more than 0"),
        (["train", "weights.safetensors", "--data", "images", "--width", "422"], "leave out --spec, --mix and --width"),
        (["train", "weights.safetensors", "--data", "images", "--mix", "daylight.toml"], "leave out --spec, --mix"),
        (["train", "weights.safetensors", "--data", "images", "--images", "800"], "--images and --workers"),
        (["train", "weights.safetensors", "--data", "images", "--workers", "4"], "--images and --workers"),
        (["train", "weights.safetensors", "--data", "images"], "there are no annotations"),
        (["train", "weights.safetensors", "--batch", "0"], "--batch"),
        (["eval", "--seed", "-1"], "--seed must be at least 0"),
        (["eval", "--workers", "0"], "--workers"),
        (["eval", "--min-score", "2"], "--min-score must be from 0 to 1"),
        (["eval", "--weights", "missing.safetensors"], "cannot read the weights"),
        (["eval", "--masks", "truth", "--weights", "w.safetensors"], "leave out --weights"),
        (["eval", "--spec", "missing.toml"], "missing.toml"),
    ],
)
def test_wrong_requests_of_train_and_eval(tmp_path, monkeypatch, capsys, words, part):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["phenotype", *words]) == 2
    assert part in capsys.readouterr().err


# --- the thesis's ways, and figures ---


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("figures") / "eval.json"
    plots = [
        {
            "seed": seed,
            "true": 30 + seed,
            "counted": 31,
            "pairs": 34,
            "device": "a laptop",
            "seconds_per_pair": 0.5,
            "widths_mm": [[14.2, 14.0 + seed]],
        }
        for seed in range(3)
    ]
    path.write_text(json.dumps({"synthetic": True, "family": "shifted", "count_r2": 0.5, "each": plots}))
    return path


@pytest.mark.parametrize("figure", ["3.4", "3.5", "table3.1"])
def test_figures_of_chapter_3(evaluation, tmp_path, figure):
    out = tmp_path / "new" / ("table.md" if figure == "table3.1" else "figure.png")
    assert cli.main(["phenotype", "figure", figure, "--out", str(out), "--evaluation", str(evaluation)]) == 0
    text, rows = out.with_suffix(".md").read_text(), table(out.with_suffix(".csv"))
    assert "ynthetic" in text and len(rows) == 3
    if figure == "table3.1":
        # 34 pairs of half a second; both people's minutes are the thesis's, and say so.
        assert rows[2]["here, measured"] == "17.0 s" and rows[2]["person 1, quoted"] == "32.33 min"
        assert "116 times faster" in text and "quoted from Table 3.1" in text
        assert "synthetic plots of 34 pairs on a laptop" in text
    else:
        assert out.read_bytes()[1:4] == b"PNG"
        assert "thesis" in text


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["3.4", "--out", "a.txt"], "3.4 is a file that ends in .png or .pdf or .svg"),
        (["3.4", "--preset", "cpu"], "unknown option --preset"),
        (["3.4", "--evaluation", "missing.json"], "cannot read missing.json"),
        (["3.5", "--evaluation", "missing.json", "--plots", "2"], "leave out --plots and --quick"),
        (["5.4"], "unknown figure '5.4'"),
    ],
)
def test_wrong_requests_of_figures(tmp_path, monkeypatch, capsys, words, part):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["phenotype", "figure", *words]) == 2
    assert part in capsys.readouterr().err


def test_what_is_not_an_evaluation(tmp_path, capsys):
    path = tmp_path / "eval.json"
    for text in ("", "{}", '{"synthetic": true, "each": [{}]}'):
        path.write_text(text)
        assert cli.main(["phenotype", "figure", "3.4", "--out", str(tmp_path / "a.png"), "--evaluation", str(path)]) == 2
        assert "holds no evaluation" in capsys.readouterr().err


def test_a_single_factor_is_shifted_from_the_training_family():
    lean = shift(FAMILIES["training"], "lean")
    assert PlantOptions(shift=("lean",)).read_family("phenotyping", default="shifted") == lean
    assert PlantOptions(shift=("lean",)).read_family("phenotyping") == lean
    assert PlantOptions().read_family("phenotyping", default="shifted") == FAMILIES["shifted"]
    both = PlantOptions(family="shifted", shift=("lean",)).read_family("phenotyping")
    assert both == shift(FAMILIES["shifted"], "lean") != FAMILIES["shifted"]
