"""Tests of training on a few annotated images: split by photograph, frozen layers, early stopping, and the report."""

import dataclasses
import itertools
import json
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
from tiny_detector import IMAGE, TINY

from jaxrl_vis import cli
from jaxrl_vis.stalks.phenotyping.detector.detect import init_detector, padded_shape
from jaxrl_vis.stalks.phenotyping.detector.detector_networks import Segmenter
from jaxrl_vis.stalks.phenotyping.detector.sections import NOTHING, STALK, UNCLEAR
from jaxrl_vis.stalks.phenotyping.detector.weights import read_weights, write_weights
from jaxrl_vis.stalks.phenotyping.training.annotated import annotated_examples, fit_settings
from jaxrl_vis.stalks.phenotyping.training.detector_training import OUTPUTS, batch_images, init_state, update_networks
from jaxrl_vis.stalks.phenotyping.training.examples import Example, crop_randomly, resize_crops
from jaxrl_vis.stalks.phenotyping.training.held_out import ImageDetections, match_to_annotations, score_detections
from jaxrl_vis.stalks.phenotyping.training.photographs import group_by_photograph, split_images
from jaxrl_vis.stalks.phenotyping.training.tuning import FROZEN, Tuning, tune

SETTINGS = dataclasses.replace(TINY, pixels_per_metre=0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of seven photographs of one bright stalk each, one of them twice, with outlines."""
    folder = tmp_path_factory.mktemp("labelled")
    rng = np.random.default_rng(0)
    images, annotations, images_drawn = [], [], []
    for number in range(8):
        noise = rng.integers(0, 120, (6, 6, 3)).astype(np.uint8)
        image = cv2.resize(noise, IMAGE[::-1], interpolation=cv2.INTER_LINEAR)
        left = 6 + 6 * number
        image[:, left : left + 8] = 220
        name = f"{number}.png"
        if number == 7:  # a copy of the first, as labelling programs export them
            image, left, name = images_drawn[0], 6, "0.rf.00ff00ff00ff.png"
        images_drawn.append(image)
        cv2.imwrite(str(folder / name), image)
        images.append({"id": number, "file_name": name, "width": IMAGE[1], "height": IMAGE[0]})
        outline = [left, 15, left + 8, 15, left + 8, 45, left, 45]
        box = [left, 15, 8, 30]
        annotations.append({"id": number, "image_id": number, "category_id": 1, "bbox": box, "segmentation": [outline]})
    data = {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "stalk"}]}
    (folder / "annotations.json").write_text(json.dumps(data))
    return folder


@pytest.fixture(scope="module")
def params() -> dict:
    detector, segmenter = jax.random.split(jax.random.key(3))
    blank = np.zeros((1, 32, 32, 3), np.float32)
    return {"detector": init_detector(SETTINGS, detector), "segmenter": Segmenter(SETTINGS.segmenter).init(segmenter, blank)}


@pytest.fixture(scope="module")
def tuned(folder, params):
    """Split, progress lines and result of a training that cannot improve, as its learning rate is 0."""
    settings = dataclasses.replace(fit_settings(folder, SETTINGS), anchor_widths=TINY.anchor_widths)
    examples = list(annotated_examples(folder, settings))
    names = [f"{number}.png" for number in range(8)]
    parts = split_images(group_by_photograph(names, [example.image for example in examples]), 0)
    lines: list[str] = []
    plan = Tuning(steps=50, minutes=None, batch=4, crops=4, rate=0.0, evaluation_interval=1, patience=3)
    return parts, lines, tune(examples, parts, settings, plan, params, lines.append)


def test_copies_of_a_photograph_are_one(folder):
    rng = np.random.default_rng(1)
    one, other = (cv2.resize(rng.integers(0, 255, (9, 9, 3)).astype(np.uint8), (90, 70)) for _ in range(2))
    darker = np.round(0.6 * one).astype(np.uint8)
    numbers = group_by_photograph(["a.jpg", "b.jpg", "c.jpg", "d.jpg"], [one, darker, one[:, ::-1], other])
    assert numbers[0] == numbers[1] == numbers[2] != numbers[3]
    names = ["row_1_jpg.rf.0a1b2c3d4e.jpg", "row_1_jpg.rf.ffffffffff.jpg", "row_2_jpg.rf.0a1b2c3d4e.jpg"]
    images = [cv2.resize(rng.integers(0, 255, (9, 9, 3)).astype(np.uint8), (90, 70)) for _ in range(3)]
    assert group_by_photograph(names, images).tolist() == [0, 0, 2]


def test_no_photograph_is_on_two_sides_of_a_split():
    photographs = np.repeat(np.arange(20), 3)
    parts = split_images(photographs, 4)
    sides = [{int(photographs[place]) for place in part} for part in (parts.train, parts.stop, parts.test)]
    assert [len(side) for side in sides] == [13, 3, 4] and len(set.union(*sides)) == 20
    assert split_images(photographs, 4) == parts != split_images(photographs, 5)
    few = split_images(np.array([0, 1, 2, 3, 3]), 0)
    assert few.train == (0, 1, 2, 3, 4) and not few.stop and not few.test


def test_scores_of_finds():
    truth = np.array([[0, 0, 10, 100, 5, 5], [50, 0, 60, 100, 55, 55], [80, 0, 90, 100, 85, 85], [0] * 6], np.float32)
    kinds = np.array([STALK, STALK, UNCLEAR, NOTHING])
    stalks = np.array(
        [[1, 0, 11, 100, 6, 6], [0, 0, 10, 100, 5, 5], [80, 0, 90, 100, 85, 85], [20, 0, 30, 100, 25, 25]], np.float32
    )
    scores = np.array([0.9, 0.8, 0.95, 0.3])
    right, ignored = match_to_annotations(stalks, scores, truth, kinds)
    assert right.tolist() == [True, False, False, False] and ignored.tolist() == [False, False, True, False]
    result = score_detections([ImageDetections(stalks, scores, right, ignored, 2)])
    assert (result.detections, result.true_positives, result.labels) == (2, 1, 2)
    assert result.precision == result.recall == result.f1 == 0.5
    assert result.soft == pytest.approx(2 * 0.9 / (0.9 + 0.8 + 0.3 + 2))
    # As good with a higher threshold; F1 does not see that the wrong one became less sure.
    better = score_detections([ImageDetections(stalks, np.array([0.9, 0.6, 0.95, 0.1]), right, ignored, 2)])
    assert better.f1 == result.f1 and better.soft > result.soft


def test_training_ends_where_held_out_images_do_not_become_better(tuned):
    parts, lines, result = tuned
    assert parts.photographs == 7 and {0, 7} <= {*parts.train} | {*parts.stop} | {*parts.test}
    assert any({0, 7} <= set(part) for part in (parts.train, parts.stop, parts.test))
    assert result.updates == 3 and result.best_step == 0 and "has not become better" in result.stop_reason
    assert len(result.before) == len(result.after) == len(parts.test)
    said = [line for line in lines if not line.endswith(" s")]  # but for signs of life of what takes long
    assert said[0].startswith("compiling") and said[0].endswith("...") and "--minutes count from here" in said[1]


def test_first_layers_stay_and_a_report_shows_held_out_images(folder, params, tmp_path, capsys):
    start, out = tmp_path / "start.safetensors", tmp_path / "mine.safetensors"
    write_weights(start, params, SETTINGS, {"origin": "nothing"}, bits=32)
    words = ["--start", str(start), "--minutes", "0.001", "--batch", "4", "--crops", "4", "--rate", "0.3"]
    assert cli.main(["phenotype", "train", str(out), "--data", str(folder), *words]) == 0
    said = capsys.readouterr().out
    assert said.splitlines()[0].endswith(f"reading the annotations in {folder} ...")
    assert "8 images of 7 photographs" in said and "before on " in said and "after  on " in said
    assert "step 1 " in said  # at least one: compilation is not counted
    page = (tmp_path / "mine.html").read_text()
    assert page.count("<img") % 2 == 0 and page.count("<img") >= 2 and "AP50" in page
    before, (after, settings, about) = read_weights(start)[0], read_weights(out)
    assert settings.section and "sections found" in said
    for layers in (before["detector"]["params"], after["detector"]["params"]):
        for name in OUTPUTS:  # they start anew
            del layers[name]
    changes = differences(before, after)
    held = {name: change for name, change in changes.items() if name.split("/")[2].startswith(FROZEN)}
    assert held and max(held.values()) < 1e-3  # they are written with 16 bits
    assert about["steps"] == 0 or max(changes.values()) > 3e-3


def test_frozen_layers_do_not_decay(folder, params):
    settings = dataclasses.replace(fit_settings(folder, SETTINGS), anchor_widths=TINY.anchor_widths)
    (example,) = itertools.islice(annotated_examples(folder, settings), 1)
    batch = batch_images([example] * 4, padded_shape(IMAGE)), None
    rates = np.float32(0.5), np.float32(0.0)
    state, parts = update_networks(
        init_state(params), batch, jax.random.key(0), rates, settings, np.float32, (*FROZEN, "segmenter")
    )
    changes = differences(params, state[0])
    held = {
        name: change for name, change in changes.items() if name.startswith("segmenter") or "/stem" in name or "/fine" in name
    }
    assert max(held.values()) == 0.0 and "masks" not in parts
    assert all(change > 0 for name, change in changes.items() if name not in held and name.endswith("kernel"))


def differences(before: dict, after: dict) -> dict[str, float]:
    """Return the maximum absolute change of each array, by its path."""
    changes = jax.tree.map(lambda a, b: float(np.abs(a - b).max()), before, after)
    named = jax.tree_util.tree_flatten_with_path(changes)[0]
    return {"/".join(str(step.key) for step in path): change for path, change in named}


def test_images_are_resized_so_that_boxes_are_as_tall_as_the_band(folder):
    settings = fit_settings(folder, dataclasses.replace(SETTINGS, band_height=60.0))
    assert settings.width == 2 * IMAGE[1] and settings.band_height == 60.0 and settings.full_width == 2 * IMAGE[1]
    example = next(iter(annotated_examples(folder, settings)))
    assert example.image.shape == (2 * IMAGE[0], 2 * IMAGE[1], 3) and example.stalks[0, 3] == 90.0


def test_cut_examples_keep_the_stalks_that_show():
    image = np.arange(100 * 200 * 3, dtype=np.uint32).reshape(100, 200, 3).astype(np.uint8)
    stalks = np.array([[20, 30, 30, 80, 22, 28], [180, 10, 190, 90, 185, 185], [0] * 6], np.float32)
    example = Example(
        image, stalks, np.array([STALK, STALK, NOTHING]), np.zeros((2, 40, 16, 3), np.uint8), np.ones((2, 40, 16), bool)
    )
    for seed in range(20):
        cut = crop_randomly(example, (100, 60), np.random.default_rng(seed))
        assert cut.image.shape == (100, 60, 3)
        left = int(np.flatnonzero((image[0, :, 0] == cut.image[0, 0, 0]) & (image[0, :, 1] == cut.image[0, 0, 1]))[0])
        shown = [box[0] < left + 57 and box[2] > left + 3 for box in stalks[:2]]
        assert (cut.kinds[:2] == STALK).tolist() == shown
        for box, kind, whole in zip(cut.stalks, cut.kinds, stalks):
            if kind == STALK and left <= whole[0] and whole[2] <= left + 60:
                np.testing.assert_allclose(box, whole - [left, 0, left, 0, left, left])
    resized = resize_crops(example, (80, 24))
    assert resized.crops.shape == (2, 80, 24, 3) and resized.masks.shape == (2, 80, 24) and resized.masks.all()
