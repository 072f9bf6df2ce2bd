"""Tests of `grasp run` on good and bad input."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from phenotype_plots import table
from PIL import Image

from jaxrl_vis import cli
from jaxrl_vis.host.worker_pool import replace_non_finite
from jaxrl_vis.stalks.cli.options import PlantOptions
from jaxrl_vis.stalks.grasping.evaluation.records import Conditions, evaluate_run
from jaxrl_vis.stalks.grasping.evaluation.scoring import draw_scene, score_scene, summarize_scores
from jaxrl_vis.stalks.grasping.evaluation.truth_on_disk import find_truth
from jaxrl_vis.stalks.grasping.perception.cloud import Mount
from jaxrl_vis.stalks.grasping.perception.perceive import DEFAULT_VARIANT, THESIS_VARIANT, Variant
from jaxrl_vis.stalks.grasping.pipeline import Request, run
from jaxrl_vis.stalks.grasping.report.perception_figure import draw_figure
from jaxrl_vis.stalks.grasping.report.reach_figures import draw_reach
from jaxrl_vis.stalks.phenotyping.io.calibration import read_calibration
from jaxrl_vis.stalks.phenotyping.io.folders import find_plots
from jaxrl_vis_envs.plants import draw, read
from jaxrl_vis_envs.plants.grasping import GRASPING_FAMILIES

WIDTH = ["--width", "256", "--frames", "3"]
FEW = {
    "layout": {"rows_behind": 0, "stalks_mean": 7, "stalks_sd": 0, "tillers": 0, "spacing_minimum": 0.08, "plot_length": 1.0},
    "leaves": {"density": 0.4, "litter": 10},
    "stalks": {"diameter_mean": 0.024, "diameter_sd": 0.002, "lean_sd": [1, 1]},
    "imaging": {"samples": 1},
}


@pytest.fixture(scope="module")
def spec(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("grasp") / "few.json"
    path.write_text(json.dumps(FEW))
    return path


@pytest.fixture(scope="module")
def runs(spec) -> Path:
    """Folder of two synthetic runs of three small pairs."""
    folder = spec.parent / "runs"
    assert cli.main(["grasp", "synth", str(folder), "--spec", str(spec), *WIDTH, "--runs", "2"]) == 0
    return folder


def grasp(folder: Path, out: Path, *words: str) -> int:
    return cli.main(["grasp", "run", str(folder), "--out", str(out), "--masks", "truth", *words])


def test_synth_writes_exact_truth(runs):
    truth = json.loads((runs / "plot_0000" / "plot.json").read_text())
    plot = draw(read(runs.parent / "few.json", GRASPING_FAMILIES), 0)
    assert truth["count"] == len(plot.measured) == 7
    for stalk, told in zip(plot.measured, truth["stalks"]):
        x, y, z, diameter = np.array(told["middle_line_x_y_z_diameter_mm"]).T
        middle, _ = stalk.at_height(0.75)
        assert np.interp(0.75, z, x) == pytest.approx(middle[0], abs=1e-3)
        assert np.interp(0.75, z, y) == pytest.approx(middle[1], abs=1e-3)
        assert diameter[15] == pytest.approx(1e3 * stalk.diameter(z[15]), abs=0.01)
    assert len(list((runs / "plot_0000" / "truth").glob("instance_*.png"))) == 3


def test_run_finds_the_stalks_and_goes_on_where_it_was(runs, tmp_path, capsys):
    out = tmp_path / "out"
    assert grasp(runs, out) == 0
    rows, points = table(out / "runs.csv"), table(out / "points.csv")
    assert [row["run"] for row in rows] == ["plot_0000", "plot_0001"]
    for row in rows:
        own = [each for each in points if each["run"] == row["run"]]
        assert row["flag"] == "ok" and row["pairs"] == "3" and row["stitches"] == "2"
        assert 3 <= int(row["reachable"]) <= int(row["grasp_points"])
        assert int(row["grasp_points"]) == len(own) >= 4
        assert [int(each["point"]) for each in own] == list(range(1, len(own) + 1))
        assert all(0.35 < float(each["y_m"]) < 0.8 and 0.4 < float(each["z_m"]) < 1.1 for each in own)
        assert np.median([float(each["diameter_mm"]) for each in own]) == pytest.approx(21.0, abs=6.0)
    assert (out / "overlays" / "plot_0001.png").exists()
    before = {name: (out / name).read_bytes() for name in ("runs.csv", "points.csv")}
    (out / "runs.csv").unlink()
    assert grasp(runs, out) == 0
    assert {name: (out / name).read_bytes() for name in before} == before
    assert grasp(runs, out, "--thesis") == 2
    assert "holds the results of another request" in capsys.readouterr().err


def test_missing_pairs_and_missing_odometry_are_reported_and_the_run_goes_on(runs, tmp_path, capsys):
    folder = tmp_path / "runs"
    shutil.copytree(runs, folder)
    (folder / "plot_0000" / "right_001.png").unlink()
    (folder / "plot_0001" / "odometry.csv").unlink()
    assert grasp(folder, tmp_path / "out") == 3
    first, second = table(tmp_path / "out" / "runs.csv")
    assert first["pairs_skipped"] == "1" and "pairs skipped: 1" in first["flag"] and int(first["grasp_points"]) > 2
    assert second["flag"] == "no odometry: only the last pair was used" and int(second["grasp_points"]) > 2
    assert "skipped plot_0000/001: there is no right image" in capsys.readouterr().err
    # Once they are back, even under another name, the same command uses them.
    shutil.copy(runs / "plot_0000" / "right_001.png", folder / "plot_0000")
    text = (runs / "plot_0001" / "odometry.csv").read_text()
    (folder / "plot_0001" / "odometry.txt").write_text(text.replace(",", "\t"))
    assert grasp(folder, tmp_path / "out") == 0
    assert [(row["flag"], row["pairs"], row["stitches"]) for row in table(tmp_path / "out" / "runs.csv")] == [
        ("ok", "3", "2")
    ] * 2
    for number in range(3):
        (folder / "plot_0000" / f"left_00{number}.png").write_bytes(b"")
    assert grasp(folder / "plot_0000", tmp_path / "none") == 3
    (row,) = table(tmp_path / "none" / "runs.csv")
    assert row["flag"] == "no usable pairs" and row["grasp_points"] == "0"


def test_clouds_that_do_not_stitch_and_an_arm_that_reaches_nothing_are_reported(runs, tmp_path):
    folder = tmp_path / "plot_0000"
    shutil.copytree(runs / "plot_0000", folder)
    text = (folder / "odometry.csv").read_text().splitlines()
    far = [",".join([*line.split(",")[:-1], f"{0.4 * number}"]) for number, line in enumerate(text[1:])]
    (folder / "odometry.csv").write_text("\n".join([text[0], *far]) + "\n")
    calibration = read_calibration(folder / "calibration.yaml")

    def find(image, plot, pair):
        return np.zeros(image.shape[:2], bool)

    request = Request(
        tmp_path / "out",
        DEFAULT_VARIANT,
        "nothing",
        {"plot_0000": calibration},
        Mount(),
        None,
        lambda points, stops: points[:, 0] > 9,
    )
    run(find_plots(folder), find, request)
    (row,) = table(tmp_path / "out" / "runs.csv")
    assert "does not stitch to the next, odometry was used" in row["flag"] and "no stalk was found" in row["flag"]
    assert int(row["stitches_refused"]) >= 1 and row["reachable"] == "0"
    shutil.copy(runs / "plot_0000" / "odometry.csv", folder)
    truth = {
        path.name[9:12]: find_truth(None, find_plots(folder)[0], pair)
        for path, pair in zip(sorted((folder / "truth").glob("instance_*")), find_plots(folder)[0].pairs)
    }
    request = dataclasses.replace(request, out=tmp_path / "far")
    run(find_plots(folder), lambda image, plot, pair: truth[pair.name], request)
    (row,) = table(tmp_path / "far" / "runs.csv")
    assert row["flag"] == "no stalk is within reach" and row["reachable"] == "0" and int(row["grasp_points"]) > 2


def test_eval_of_rows_and_of_an_empty_one(spec, tmp_path, capsys):
    out = tmp_path / "eval.json"
    words = ["grasp", "eval", "--masks", "truth", *WIDTH, "--runs", "2", "--reach"]
    assert cli.main([*words, "--json", str(out), "--spec", str(spec), "--workers", "2", "--wind", "0", "5"]) == 0
    figures = json.loads(out.read_text())
    assert figures["f1"] > 0.9 and figures["point_median_mm"] < 10.0 and figures["stitch_median_mm"] < 10.0
    assert figures["synthetic"] is True and figures["masks"] == "truth" and figures["stitches"] == 4
    for wind in ("0", "5"):
        shares = figures["reaches"][f"again, wind {wind} mm"]["shares"]
        targets = sum(len(each["plan"]["targets"]) for each in figures["each"])
        assert shares["all stalks"]["of"] == figures["stalks"] and shares["attempts: success"]["of"] == targets
        assert shares["all stalks"]["count"] >= figures["stalks"] - 2
    said = capsys.readouterr().out
    assert "simulated runs of family few" in said and "the arm, again, wind 5 mm:" in said
    # A run is the same in this process, and is not evaluated again.
    family = PlantOptions(spec=spec, width=256, frames=3).read_family("grasping")
    here = json.loads(json.dumps(replace_non_finite(evaluate_run(Conditions(family), 1))))
    there = figures["each"][1]
    assert here["plan"]["stalks"] == there["plan"]["stalks"] and here["hits"] == there["hits"]
    np.testing.assert_allclose(here["plan"]["targets"], there["plan"]["targets"], atol=2e-6)
    before = out.stat().st_mtime_ns
    assert cli.main([*words, "--json", str(out), "--spec", str(spec), "--wind", "5"]) == 0
    said = capsys.readouterr().out
    assert "evaluated before: 2 of 2 runs" in said and "run 1" not in said
    assert json.loads(out.read_text()) == figures and out.stat().st_mtime_ns >= before
    figure = ["grasp", "figure", "4.6", "--evaluation", str(out), "--out", str(tmp_path / "figure.png")]
    assert cli.main([*figure, "--wind", "5"]) == 0 and (tmp_path / "figure.png").stat().st_size > 20_000
    assert cli.main([*figure, "--wind", "7"]) == 2
    assert "holds no reaches of the kind `again, wind 7 mm`" in capsys.readouterr().err
    assert cli.main([*words, "--json", str(out), "--spec", str(spec), "--thesis"]) == 2
    assert 'another evaluation (method: "default", not "thesis")' in capsys.readouterr().err
    empty = tmp_path / "empty.json"
    layout = {**FEW["layout"], "stalks_mean": 0}
    empty.write_text(json.dumps({**FEW, "layout": layout, "leaves": {"density": 0, "litter": 30}}))
    assert cli.main([*words, "--json", str(tmp_path / "none.json"), "--spec", str(empty), "--runs", "1"]) == 0
    figures = json.loads((tmp_path / "none.json").read_text())
    assert figures["stalks"] == figures["grasp_points"] == 0 and figures["f1"] is None
    assert "no stalk was found" in capsys.readouterr().out


def test_masks_are_compared_with_the_truth_and_the_figure_is_drawn(spec, tmp_path):
    family = dataclasses.replace(read(spec, GRASPING_FAMILIES))
    family = dataclasses.replace(family.at_width(256), rig=dataclasses.replace(family.at_width(256).rig, frames=3))
    scene = draw_scene(family, 0)
    score, perception = score_scene(scene, lambda image, number: np.roll(scene.masks[number], 1, axis=1))
    assert score.mask is not None and 0.3 < score.mask.boundary < 1.5
    assert 0.6 < 2.0 * score.mask.hits / (score.mask.painted + score.mask.true) < 0.97
    assert summarize_scores([score])["mask_f1"] < 1.0 and len(perception.clouds) == 3
    thesis, _ = score_scene(scene, None, THESIS_VARIANT)
    assert thesis.mask is None and np.median(thesis.stitches) > np.median(score.stitches)
    mixed, _ = score_scene(scene, None, Variant(points=True))
    np.testing.assert_allclose(mixed.stitches, score.stitches, atol=1e-9)
    assert [str(each) for each in (DEFAULT_VARIANT, THESIS_VARIANT, Variant(True), Variant(False, True))] == [
        "default",
        "thesis",
        "stitches of the thesis",
        "grasp points of the thesis",
    ]
    out = tmp_path / "new" / "figure.png"
    draw_figure(out, family, 0, None, "truth")
    assert out.stat().st_size > 50_000
    draw_reach(tmp_path / "reach.png", family, 0, None, 5.0, tmp_path / "arm.gif", size=48)
    assert (tmp_path / "reach.png").stat().st_size > 20_000
    with Image.open(tmp_path / "arm.gif") as shown:
        assert shown.n_frames % 60 == 0 and shown.n_frames > 60


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["synth", "out", "--runs", "0"], "--runs must be at least 1"),
        (["synth", "out", "--shift", "lien"], "there is no shift of 'lien'; did you mean lean"),
        (["train", "weights.bin"], "ends in .safetensors"),
        (["train", "weights.safetensors", "--minutes", "0"], "--minutes must be more than 0"),
        (["train", "weights.safetensors", "--crop", "100"], "--crop must be a multiple of 64"),
        (["train", "weights.safetensors", "--loss", "dice"], "--loss cannot be 'dice'"),
        (["eval", "--seed", "-1"], "--seed must be at least 0"),
        (["eval", "--weights", "missing.safetensors"], "cannot read the weights"),
        (["eval", "--masks", "truth", "--weights", "w.safetensors"], "leave out --weights"),
        (["eval", "--masks", "gan"], "train them on a GPU with `jaxrl-vis grasp train gan.safetensors --loss gan"),
        (["eval", "--wind", "5"], "--wind goes with --reach"),
        (["eval", "--loops", "open"], "--loops goes with --reach"),
        (["eval", "--thesis", "--points", "default"], "leave out --thesis or --points default"),
        (["eval", "--reach", "--wind", "0", "-5"], "--wind must be from 0 to 100 mm, not -5"),
        (["eval", "--workers", "0"], "--workers must be at least 1"),
        (["run", "missing"], "there is no folder"),
        (["run", ".", "--pitch", "99"], "--pitch must be from -60 to 60"),
        (["run", ".", "--height", "0"], "--height must be from 0.05 to 3"),
        (["run", ".", "--speed", "0"], "--speed must be more than 0"),
        (["figure"], "grasp figure what? Choose one of 4.4, 4.5, 4.6"),
        (["figure", "4.9"], "unknown command 'grasp figure 4.9'"),
        (["figure", "4.4", "--video", "a.gif"], "unknown option --video"),
        (["figure", "4.5", "--wind", "101"], "--wind must be from 0 to 100 mm, not 101"),
        (["figure", "4.6", "--out", "a.txt"], "a figure is a file that ends in .png, .pdf or .svg"),
    ],
)
def test_wrong_requests(tmp_path, monkeypatch, capsys, words, part):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["grasp", *words]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and part in lines[0], lines


def test_no_calibration_no_metres(runs, tmp_path, capsys):
    folder = tmp_path / "plot_0000"
    shutil.copytree(runs / "plot_0000", folder)
    (folder / "calibration.yaml").unlink()
    assert grasp(folder, tmp_path / "out") == 2
    assert "plot_0000 has no calibration" in capsys.readouterr().err
    (folder / "plot.json").unlink()
    shutil.copy(runs / "plot_0000" / "calibration.yaml", folder)
    assert grasp(folder, tmp_path / "out") == 2
    assert "holds no true masks" in capsys.readouterr().err
