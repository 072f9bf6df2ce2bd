"""Tests of bad files and interrupted commands: each gives one line, and nothing is lost."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from phenotype_plots import run, table

from jaxrl_vis import cli
from jaxrl_vis.stalks.phenotyping.detector.finder import Detection
from jaxrl_vis.stalks.phenotyping.evaluation.truth_on_disk import find_truth
from jaxrl_vis.stalks.phenotyping.io.calibration import read_calibration
from jaxrl_vis.stalks.phenotyping.io.folders import find_plots
from jaxrl_vis.stalks.phenotyping.io.images import read_image, write_image
from jaxrl_vis.stalks.phenotyping.measure.lens import LensRange
from jaxrl_vis.stalks.phenotyping.pipeline import Request
from jaxrl_vis.stalks.phenotyping.pipeline import run as pipeline_run
from jaxrl_vis.stalks.phenotyping.track.pairing import pair_fault
from jaxrl_vis.stalks.phenotyping.track.sightings import measure_pair
from jaxrl_vis_envs.plants import Calibration

BLANK = np.full((12, 16, 3), 80, np.uint8)


def test_bad_files_are_listed_and_skipped(plots, tmp_path, capsys):
    plot = tmp_path / "plot_0000"
    shutil.copytree(plots / "plot_0000", plot)
    (plot / "right_000.png").unlink()
    (plot / "left_001.png").write_bytes((plot / "left_001.png").read_bytes()[:200])
    assert run(plot, tmp_path / "two") == 3
    (row,) = table(tmp_path / "two" / "plots.csv")
    assert row["pairs_skipped"] == "2" and row["flag"] == "pairs skipped; few frames" and int(row["stalks"]) > 0
    write_image(plot / "right_002.png", BLANK)
    assert run(plot, tmp_path / "out") == 3
    told = {row["pair"]: row["why"] for row in table(tmp_path / "out" / "skipped.csv")}
    assert told.keys() == {"000", "001", "002"}
    assert "no right image" in told["000"] and "left_001.png" in told["001"] and "16 x 12" in told["002"]
    (row,) = table(tmp_path / "out" / "plots.csv")
    assert row["pairs_skipped"] == "3" and row["flag"] == "a single pair"
    assert "skipped plot_0000/000: there is no right image" in capsys.readouterr().err


def test_swapped_and_unrectified_pairs_are_reported():
    """The right image of six textured stalks is unchanged, exchanged for the left one, too low, and too high."""
    rng = np.random.default_rng(0)
    camera = Calibration(844, 400, 542.0, (421.5, 199.5), 0.1)
    disparity = 68
    left, right = np.zeros((400, 844, 3), np.uint8), np.zeros((400, 844, 3), np.uint8)
    columns = range(120, 720, 100)
    for column in columns:
        texture = rng.integers(60, 255, (400, 14, 1)).astype(np.uint8)
        left[:, column : column + 14] = texture
        right[:, column - disparity : column - disparity + 14] = texture

    def told(left: np.ndarray, right: np.ndarray, offset: int = 0) -> str | None:
        mask = np.zeros((200, 24), bool)
        mask[:, 5:19] = True
        finds = [
            Detection((each, 100.0, each + 13.0, 300.0), (each + 6.5, each + 6.5), 1.0, mask, (100, each - 5))
            for each in (column - offset for column in columns)
        ]
        return pair_fault(finds, measure_pair(finds, left, right, camera), left, right, camera)

    assert told(left, right) is None
    assert told(right, left, disparity) == "left and right are swapped: exchange their names"
    assert told(left, np.roll(right, 6, axis=0)) == "the right image lies about 6 rows too low: rectify the pair"
    assert told(left, np.roll(right, -12, axis=0)) == "the right image lies about 12 rows too high: rectify the pair"
    assert told(left, np.zeros_like(right)) is None


def test_without_calibration_no_millimetres_and_without_odometry_no_count(plots, tmp_path, capsys):
    plot = tmp_path / "plot_0000"
    shutil.copytree(plots / "plot_0000", plot)
    (plot / "odometry.csv").unlink()
    assert run(plot, tmp_path / "a") == 0
    (row,) = table(tmp_path / "a" / "plots.csv")
    assert row["flag"] == "no odometry" and row["stalks"] == row["stalks_per_m"] == "" and float(row["width_mean_mm"]) > 10
    (plot / "calibration.yaml").unlink()
    assert run(plot, tmp_path / "b") == 0
    (row,) = table(tmp_path / "b" / "plots.csv")
    assert row["flag"] == "no calibration" and row["width_mean_mm"] == row["stalks"] == ""
    assert table(tmp_path / "b" / "stalks.csv") == []
    assert "no millimetres" in capsys.readouterr().err


def test_black_images_and_calibrations_of_another_size_are_reported(plots, tmp_path):
    plot = tmp_path / "plot_0000"
    shutil.copytree(plots / "plot_0000", plot)
    write_image(plot / "left_000.png", np.zeros((338, 422, 3), np.uint8))
    for number in range(1, 4):
        for side in ("left", "right"):
            write_image(plot / f"{side}_{number:03d}.png", BLANK)
    assert run(plot, tmp_path / "out") == 3
    told = [row["why"] for row in table(tmp_path / "out" / "skipped.csv")]
    assert "the left image is black" in told[0] and "calibration is for 422 x 338" in told[1]
    (row,) = table(tmp_path / "out" / "plots.csv")
    assert row["flag"] == "no usable pairs"


def test_true_masks_are_wanted_of_what_has_none(plots, tmp_path, capsys):
    plot = tmp_path / "plot_0000"
    shutil.copytree(plots / "plot_0000", plot)
    (plot / "plot.json").unlink()
    assert run(plot, tmp_path / "out") == 2
    assert "holds no true masks" in capsys.readouterr().err


def test_a_run_that_was_stopped_gives_the_same_tables(plots, results, tmp_path, capsys):
    again = tmp_path / "out"
    shutil.copytree(results, again)
    (again / "pairs" / "plot_0001" / "002.json").unlink()
    (again / "pairs" / "plot_0001" / "003.json").unlink()
    for name in ("stalks.csv", "plots.csv"):
        (again / name).unlink()
    assert run(plots, again) == 0
    for name in ("stalks.csv", "plots.csv", "skipped.csv"):
        assert (again / name).read_bytes() == (results / name).read_bytes()
    assert run(plots, again, "--method", "ellipse") == 2
    assert "holds the results of another request" in capsys.readouterr().err


def test_what_is_put_back_is_counted_and_drawn(plots, results, tmp_path, capsys):
    """Once a missing image and the odometry are added, tables and overlays are as if they had never been missing."""
    plot, out = tmp_path / "plot_0000", tmp_path / "out"
    shutil.copytree(plots / "plot_0000", plot)
    (plot / "right_001.png").unlink()
    (plot / "odometry.csv").unlink()
    assert run(plot, out) == 3
    assert "plot_0000: no odometry (there is no" in capsys.readouterr().err
    kept = (out / "pairs" / "plot_0000" / "000.json").read_bytes()
    for name in ("right_001.png", "odometry.csv"):
        shutil.copy(plots / "plot_0000" / name, plot)
    assert run(plot, out) == 0
    (row,), (own, _) = table(out / "plots.csv"), table(results / "plots.csv")
    assert row == own and (out / "pairs" / "plot_0000" / "000.json").read_bytes() == kept
    for number in range(4):
        name = f"overlays/plot_0000/{number:03d}.png"
        assert (out / name).read_bytes() == (results / name).read_bytes()
    # What changes is computed again, and an overlay of what cannot be used goes.
    shutil.copy(plots / "plot_0001" / "left_002.png", plot)
    (plot / "right_003.png").write_bytes(b"")
    before = (out / "pairs" / "plot_0000" / "002.json").read_bytes()
    assert run(plot, out) == 3
    assert (out / "pairs" / "plot_0000" / "002.json").read_bytes() != before
    assert not (out / "overlays" / "plot_0000" / "003.png").exists()


def test_what_messages_advise_may_follow_in_the_same_folder(plots, tmp_path, capsys):
    """A calibration may be added after a run without one, and a request without results may be changed."""
    plot, out = tmp_path / "plot_0000", tmp_path / "out"
    shutil.copytree(plots / "plot_0000", plot)
    shutil.move(plot / "calibration.yaml", tmp_path)
    assert run(plot, out) == 0
    assert table(out / "plots.csv")[0]["flag"] == "no calibration"
    assert run(plot, out, "--calibration", str(tmp_path / "calibration.yaml")) == 0
    (row,) = table(out / "plots.csv")
    assert row["flag"] == "ok" and float(row["width_mean_mm"]) > 10
    assert run(plot, out, "--calibration", str(tmp_path / "calibration.yaml"), "--method", "ellipse") == 2
    assert 'another request (method: "strip", not "ellipse")' in capsys.readouterr().err
    (plot / "truth").rename(tmp_path / "truth")
    other = tmp_path / "other"
    assert run(plot, other) == 2 and (other / "run.json").exists()
    (tmp_path / "truth").rename(plot / "truth")
    assert run(plot, other, "--calibration", str(tmp_path / "calibration.yaml"), "--method", "ellipse") == 0


def test_synth_adds_the_truth_that_is_missing(plots, tmp_path, capsys):
    small = ["--spec", str(plots.parent / "few.json"), "--width", "211", "--frames", "1"]
    words = ["phenotype", "synth", str(tmp_path), *small, "--truth"]
    assert cli.main([*words, "boxes", "--format", "jpeg"]) == 0
    assert cli.main([*words, "all"]) == 0
    assert "there already" not in capsys.readouterr().out
    assert (tmp_path / "plot_0000" / "truth" / "instance_000.png").exists()
    assert [path.name for path in sorted((tmp_path / "plot_0000").glob("left_*"))] == ["left_000.png"]
    annotations = json.loads((tmp_path / "plot_0000" / "annotations.json").read_text())["annotations"]
    assert annotations and all("segmentation" in each for each in annotations)
    # What holds more than is required stays.
    assert cli.main([*words, "boxes"]) == 0
    assert "1 there already" in capsys.readouterr().out


def test_odometry_that_contradicts_the_images_gives_no_count(plots, results, tmp_path, capsys):
    (own, _) = table(results / "plots.csv")
    for factor, flag in ((100.0, "odometry does not fit the images"), (-1.0, "ok")):
        plot = tmp_path / str(factor) / "plot_0000"
        shutil.copytree(plots / "plot_0000", plot)
        rows = table(plot / "odometry.csv")
        lines = [f"{row['left']},{factor * float(row['distance_m'])}" for row in rows]
        (plot / "odometry.csv").write_text("\n".join(["left,distance_m", *lines]) + "\n")
        assert run(plot, tmp_path / str(factor) / "out") == 0
        (row,) = table(tmp_path / str(factor) / "out" / "plots.csv")
        assert row["flag"] == flag and row["stalks"] == (own["stalks"] if factor < 0 else "")
        assert (row["width_mean_mm"] == "") == (factor > 0)  # which of the two units is wrong, nobody knows
    told = capsys.readouterr().err
    assert "plot_0000: odometry does not fit the images (its distances, or the baseline of the calibration, may" in told


def test_stalks_without_a_single_width_are_reported(plots, results, tmp_path, capsys):
    """A plot is flagged if, by the records of its pairs, no stalk could be measured."""
    out = tmp_path / "out"
    shutil.copytree(results, out)
    for path in (out / "pairs" / "plot_0000").glob("*.json"):
        record = json.loads(path.read_text())
        for each in record["sightings"]:
            each.update(diameter_mm=None, upper_mm=None, reason="unclear")
        path.write_text(json.dumps(record))
    assert run(plots, out) == 0
    row = table(out / "plots.csv")[0]
    assert row["flag"] == "no widths" and int(row["stalks"]) > 0 and row["width_mean_mm"] == ""
    assert "plot_0000: no width" in capsys.readouterr().err


def test_a_run_that_was_killed_gives_the_same_tables(plots, results, tmp_path, clean_environment):
    """The command is killed by SIGKILL after the first pairs, and run again."""
    out = tmp_path / "out"
    words = ["phenotype", "run", str(plots), "--out", str(out), "--masks", "truth"]
    program = subprocess.Popen([sys.executable, "-m", "jaxrl_vis", *words], env=clean_environment, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 120.0
    while not list(out.glob("pairs/*/*.json")):
        assert program.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    os.kill(program.pid, signal.SIGKILL)
    assert program.wait() == -signal.SIGKILL
    assert not (out / "plots.csv").exists() or len(list(out.glob("pairs/*/*.json"))) < 8
    for folder in ("pairs/plot_0000", "."):
        (out / folder / f".{program.pid}-0123456789abcdef.tmp").touch()  # as if killed while writing
    training = tmp_path / "out" / "runs" / "seed0" / ".1-0123456789abcdef.tmp"
    training.parent.mkdir(parents=True)
    training.touch()
    writing = out / f".{os.getpid()}-0123456789abcdef.tmp"
    writing.touch()
    assert run(plots, out) == 0
    training.unlink()  # another program's, which may be writing it
    if sys.platform == "linux":
        assert writing.exists()  # a living process's
        writing.unlink()
    for name in ("stalks.csv", "plots.csv", "skipped.csv", "qc.html"):
        assert (out / name).read_bytes() == (results / name).read_bytes()
    assert not list(out.rglob("*.tmp"))


def test_a_plot_whose_name_is_not_utf8_is_measured_to_the_end(plots, results, tmp_path, capsys):
    """Archives of other systems contain such names; OpenCV, which writes them on overlays, would crash."""
    plot = tmp_path / os.fsdecode(b"=t\xe9t\xe9")
    shutil.copytree(plots / "plot_0000", plot)
    os.rename(plot / "right_003.png", plot / os.fsdecode(b"r\xe9.png"))
    assert run(plot, tmp_path / "out") == 3
    (row,), (whole, _) = table(tmp_path / "out" / "plots.csv"), table(results / "plots.csv")
    assert row["plot"] == "'=tété" and float(row["width_mean_mm"]) == pytest.approx(float(whole["width_mean_mm"]), rel=0.05)
    assert "skipped =tété/003: there is no right image" in capsys.readouterr().err
    assert "=tété" in (tmp_path / "out" / "qc.html").read_text(encoding="utf-8")
    assert (tmp_path / "out" / "overlays" / "=tété" / "000.png").exists()


def test_widths_without_ground_say_so(plots, tmp_path, capsys):
    """With everything below 8 inches black, stalks are counted, but the heights of widths are unknown."""
    plot = tmp_path / "plot_0000"
    shutil.copytree(plots / "plot_0000", plot)
    for path in [*plot.glob("left_*.png"), *plot.glob("right_*.png")]:
        image = read_image(path)
        image[230:] = 0
        write_image(path, image)
    assert run(plot, tmp_path / "out") == 0
    (row,) = table(tmp_path / "out" / "plots.csv")
    stalks = table(tmp_path / "out" / "stalks.csv")
    assert row["flag"] == "no visible ground" and int(row["stalks"]) == len(stalks) > 0
    assert {each["height_in"] for each in stalks} == {""} and {each["width_24in_mm"] for each in stalks} == {""}
    assert float(row["width_mean_mm"]) > 10
    assert "plot_0000: the ground is not seen, so nobody knows at what height" in capsys.readouterr().err
    page = (tmp_path / "out" / "qc.html").read_text()
    assert "mm thick, no visible ground" in page and "thick at 12 inches" not in page


def test_nothing_seen_gives_no_count(plots, tmp_path, capsys):
    """The plot may be empty, or its camera may be unfamiliar to the networks."""
    plot = tmp_path / "plot_0000"
    shutil.copytree(plots / "plot_0000", plot)
    for path in (plot / "truth").glob("instance_*.png"):
        write_image(path, np.zeros_like(read_image(path)))
    assert run(plot, tmp_path / "out") == 0
    (row,) = table(tmp_path / "out" / "plots.csv")
    assert row["flag"] == "nothing like a row seen" and row["stalks"] == row["stalks_per_m"] == row["width_mean_mm"] == ""
    assert "nothing like a row seen" in (tmp_path / "out" / "qc.html").read_text()
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("plot_0000: ")]
    assert line.startswith("plot_0000: nothing like a row seen (0 detections in 4 pairs") and line.endswith(", so no count")


def test_a_lens_that_was_not_tried_gives_no_numbers(plots, tmp_path):
    """There is neither a count nor a width, but a line with the reason, also in the page; with true masks, any lens will do."""
    (plot,) = find_plots(plots / "plot_0000")
    calibration = {plot.name: read_calibration(plots / "plot_0000" / "calibration.yaml")}
    said = {}

    def count(tried: LensRange | None) -> str:
        request = Request(tmp_path / "out", "strip", "truth", calibration, lens_range=tried)
        (row,), _ = pipeline_run([plot], find_truth, request, echo=said.__setitem__)
        assert (row["width_mean_mm"] == "") == (row["stalks"] == "") and (row["stalks"] == "") == (row["flag"] != "ok")
        return row["flag"]

    assert count(LensRange(pixels_per_metre=300.0, view=0.9)) == "ok" and not said
    assert count(LensRange(pixels_per_metre=400.0, view=0.9)) == "untried lens"
    assert said[plot.name].startswith("untried lens (339 pixels per metre of a row 0.8") and "400" in said[plot.name]
    assert "No count: 339 pixels per metre" in (tmp_path / "out" / "qc.html").read_text()
    assert len((tmp_path / "out" / "stalks.csv").read_text().splitlines()) == 1
    assert count(None) == "ok"


def test_disparities_of_ones_own_take_the_right_images_place(plots, results, tmp_path):
    """With PFM files, or PNG of 16 bits, widths are as from our own matching, and no right image is needed."""
    true = plots / "plot_0000" / "truth"
    for kind in ("pfm", "png"):
        plot = tmp_path / kind / "plot_0000"
        shutil.copytree(plots / "plot_0000", plot)
        (plot / "disparity").mkdir()
        for number in range(4):
            stored = read_image(true / f"disparity_{number:03d}.png")
            if kind == "png":
                write_image(plot / "disparity" / f"{number:03d}.png", stored)
            else:
                values = np.where(stored > 0, stored / 64.0, np.inf).astype(np.float32)
                assert cv2.imwrite(str(plot / f"disparity_{number:03d}.pfm"), values)
            (plot / f"right_{number:03d}.png").unlink()
        words = ["--disparity-scale", "64"] if kind == "png" else []
        assert run(plot, tmp_path / f"{kind}_out", *words) == 0
        (row,), (own, _) = table(tmp_path / f"{kind}_out" / "plots.csv"), table(results / "plots.csv")
        assert row["stalks"] == own["stalks"] and row["flag"] == "ok"
        assert float(row["width_mean_mm"]) == pytest.approx(float(own["width_mean_mm"]), rel=0.02)
    write_image(plot / "disparity" / "001.png", np.zeros((12, 16), np.uint16))
    assert run(plot, tmp_path / "bad") == 3
    (row,) = table(tmp_path / "bad" / "skipped.csv")
    assert row["why"] == "the left image has 422 x 338 pixels and its disparities 16 x 12"


def test_the_page_holds_its_pictures_and_what_was_rejected(plots, results, tmp_path):
    """The page needs no other file or network, has a row for each stalk, states skipped pairs, and escapes names."""
    page = (results / "qc.html").read_text()
    stalks = table(results / "stalks.csv")
    assert page.count('<img class="stalk"') >= len(stalks) and page.count('<img class="pair"') == 8
    assert "http" not in page and " src=" in page and page.count(" src=") == page.count('src="data:image/jpeg;base64,')
    for row in stalks:
        assert f"<td>{float(row['width_mm']):.1f}</td>" in page
    plot = tmp_path / "a<b"
    shutil.copytree(plots / "plot_0000", plot)
    (plot / "right_001.png").unlink()
    assert run(plot, tmp_path / "out") == 3
    page = (tmp_path / "out" / "qc.html").read_text()
    assert "a&lt;b" in page and "a<b" not in page and "there is no right image" in page


def test_images_of_twelve_bits_in_sixteen(plots, results, tmp_path):
    """TIFF images of 12 bits yield the same table of stalks as images of 8 bits."""
    plot = tmp_path / "plot_0000"
    shutil.copytree(plots / "plot_0000", plot)
    for path in [*plot.glob("left_*.png"), *plot.glob("right_*.png")]:
        write_image(path.with_suffix(".tiff"), read_image(path).astype(np.uint16) << 4)
        path.unlink()
    odometry = (plot / "odometry.csv").read_text().replace(".png", ".tiff")
    (plot / "odometry.csv").write_text(odometry)
    assert run(plot, tmp_path / "out") == 0
    assert (tmp_path / "out" / "stalks.csv").read_text() == "".join(
        line for line in (results / "stalks.csv").read_text().splitlines(True) if not line.startswith("plot_0001")
    )
