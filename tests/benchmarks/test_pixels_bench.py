"""Benchmark of images for MuJoCo Playground's tasks, without Playground: its page of images, records, table and refusals."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from benchmarks.ledger.tables import pixels
from benchmarks.pixels import __main__ as command
from benchmarks.pixels import gallery, playground, train
from jaxrl_vis.bench.record import Measurement, keep, to_record
from jaxrl_vis.errors import RequestError

MEASURES = {"segmentation": 0.9991, "matched": 0.7, "depth": None, "bare_mean": 1.234}


class Suite:
    """Stand-in for Playground's dm_control suite, with the only attribute that the command reads before it measures."""

    ALL_ENVS = ("CartpoleBalance", "FishSwim")


@pytest.fixture
def suite(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(playground, "suite", Suite)


def test_a_missing_playground_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco_playground", None)
    assert command.main([]) == 2 and train.main(["--smoke"]) == 2
    messages = capsys.readouterr().err.splitlines()
    assert len(messages) == 2 and all("pip install playground" in message for message in messages)


def test_unknown_tasks_and_batches_that_do_not_divide_are_refused(suite: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["Cartpole"]) == 2 and train.main(["--envs", "1000"]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first == "there is no task Cartpole; there are CartpoleBalance, FishSwim" and "divisor of 2048" in second
    with pytest.raises(RequestError, match="there is no task 'Cartpole'"):
        playground.load("Cartpole")


def test_the_gallery_has_each_pair_side_by_side(tmp_path: Path) -> None:
    ours, theirs = (np.full((8, 8, 3), value, np.uint8) for value in (10, 200))
    gallery.save({f"task {number}": (ours, theirs) for number in range(gallery.COLUMNS + 1)}, tmp_path / "page.png")
    page = np.asarray(Image.open(tmp_path / "page.png"))
    width, height = 16 + 3 * gallery.GAP, 8 + gallery.TITLE + gallery.GAP
    assert page.shape == (2 * height, gallery.COLUMNS * width, 3)
    cell = page[height : height + gallery.TITLE + 8, :width]
    assert np.all(cell[gallery.TITLE :, :8] == 10) and np.all(cell[gallery.TITLE :, 8 + gallery.GAP // 2 :][:, :8] == 200)


def evaluation(env_steps: int, score: float, wall_s: float, measure: str = "return") -> dict[str, float]:
    return {"env_steps": env_steps, measure: score, "wall_s": wall_s, "training_s": wall_s / 2}


def test_the_speed_to_the_target_is_that_of_the_first_evaluation_above_it() -> None:
    below, above = evaluation(0, 120.0, 5.0), evaluation(1000, 940.0, 40.0)
    records = train.measurements("CartpoleBalance", [below, above, evaluation(2000, 990.0, 80.0)], {}, 3)
    assert [record.name for record in records] == ["pixels/return", "pixels/speed_to_900"]
    assert records[0].value == 990.0 and records[1].value == 1 / 40 and records[1].details["training_s"] == 20.0
    assert [record.name for record in train.measurements("CartpoleBalance", [below], {}, 3)] == ["pixels/return"]
    reached = train.measurements("FetchReach", [evaluation(1000, 0.81, 40.0, "success")], {}, 3)
    assert [record.name for record in reached] == ["pixels/success", "pixels/speed_to_0.8"]
    assert all(record.config["task"] == "FetchReach" for record in reached)


def test_the_table_has_camera_parity_and_speeds(tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = [
        {"task": "CartpoleBalance", "camera": "fixed", "measures": MEASURES, "failures": ["matched"]},
        {"task": "FishSwim", "camera": "eye", "measures": MEASURES, "failures": []},
    ]
    (tmp_path / "pixels_parity.json").write_text(json.dumps({"rows": rows}))
    for name, value in (("pixels/steps", 1234.5), ("pixels/steps_with_images", 56.7)):
        measurement = Measurement(name, value, "env-steps/s", {"task": "FishSwim"})
        keep(tmp_path / "pixels-amd-epyc-2-cores.json", to_record(measurement))
    table = pixels.tasks_table(tmp_path)
    assert table is not None and pixels.tasks_table(tmp_path / "empty") is None
    head, _, cartpole, fish = table.splitlines()
    assert head.endswith("| steps/s, two cores |")
    assert cartpole == "| CartpoleBalance | `fixed` | 99.91 | **0.700** |  | 1.23 |  |"
    assert fish == "| FishSwim | `eye` | 99.91 | 0.700 |  | 1.23 | 1.23 k / 56.7 |"
