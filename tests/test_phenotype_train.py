"""Training on annotated images: what it starts from, and what boxes alone do not change."""

import dataclasses
import json
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
from tiny_detector import IMAGE, TINY

from jaxrl_vis import cli
from jaxrl_vis.phenotyping.detector.detect import initial
from jaxrl_vis.phenotyping.detector.networks import Segmenter
from jaxrl_vis.phenotyping.detector.weights import read_weights, write_weights


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three images with a bright stalk in each, and a box around its middle, 30 pixels tall."""
    folder = tmp_path_factory.mktemp("annotated")
    images, annotations = [], []
    for number in range(3):
        image = np.full((*IMAGE, 3), 40, np.uint8)
        left = 10 + 14 * number
        image[:, left : left + 8] = 200
        cv2.imwrite(str(folder / f"{number}.png"), image)
        images.append({"id": number, "file_name": f"{number}.png", "width": IMAGE[1], "height": IMAGE[0]})
        annotations.append({"id": number, "image_id": number, "category_id": 1, "bbox": [left, 15, 8, 30]})
    data = {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "stalk"}]}
    (folder / "annotations.json").write_text(json.dumps(data))
    return folder


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "tiny.npz"
    detector, segmenter = jax.random.split(jax.random.key(3))
    params = {
        "detector": initial(TINY, detector),
        "segmenter": Segmenter(TINY.segmenter).init(segmenter, np.zeros((1, 32, 32, 3), np.float32)),
    }
    write_weights(path, params, dataclasses.replace(TINY, candidates=7), {"origin": "nothing"})
    return path


def differences(one: Path, other: Path) -> dict[str, float]:
    """The greatest change of any number of each network."""
    first, second = read_weights(one)[0], read_weights(other)[0]
    changes = {name: jax.tree.map(lambda a, b: float(np.abs(a - b).max()), first[name], second[name]) for name in first}
    return {name: max(jax.tree.leaves(changes[name])) for name in changes}


def train(out: Path, folder: Path, *words: str) -> int:
    return cli.main(["phenotype", "train", str(out), "--data", str(folder), "--batch", "4", "--snips", "4", *words])


def test_training_goes_on_from_weights_and_boxes_leave_masks_alone(folder, weights, tmp_path, capsys):
    assert train(tmp_path / "none.npz", folder, "--start", str(weights), "--steps", "1", "--rate", "1e-9") == 0
    assert max(differences(tmp_path / "none.npz", weights).values()) < 1e-3  # they are kept in 16 bits
    assert train(tmp_path / "more.npz", folder, "--start", str(weights), "--steps", "3", "--rate", "1") == 0
    said = capsys.readouterr().out
    assert f"from {weights}" in said and "masks stay as they are" in said
    _, settings, about = read_weights(tmp_path / "more.npz")
    assert settings == TINY  # all the candidates of a new training
    assert about["origin"] == f"annotated images, from {weights}"
    changes = differences(tmp_path / "more.npz", weights)
    assert changes["detector"] > 1e-3 and changes["segmenter"] == 0.0


def test_outlines_teach_masks(folder, weights, tmp_path):
    data = json.loads((folder / "annotations.json").read_text())
    for each in data["annotations"]:
        left, top, wide, tall = each["bbox"]
        each["segmentation"] = [[left, top, left + wide, top, left + wide, top + tall, left, top + tall]]
    outlined = tmp_path / "outlined"
    outlined.mkdir()
    for image in folder.glob("*.png"):
        (outlined / image.name).write_bytes(image.read_bytes())
    (outlined / "annotations.json").write_text(json.dumps(data))
    assert train(tmp_path / "out.npz", outlined, "--start", str(weights), "--steps", "3", "--rate", "1") == 0
    assert differences(tmp_path / "out.npz", weights)["segmenter"] > 1e-3


def test_boxes_of_another_size_start_from_random_weights_or_are_refused(folder, tmp_path, capsys):
    # So small an image is not reduced: 30 lines, where the weights that ship know 135.
    assert train(tmp_path / "out.npz", folder, "--start", "shipped", "--steps", "1") == 2
    refusal = capsys.readouterr().err
    assert "30 pixels tall" in refusal and "135" in refusal and "--start random" in refusal
    assert not (tmp_path / "out.npz").exists()
    assert cli.main(["phenotype", "train", str(tmp_path / "out.npz"), "--start", "missing.npz"]) == 2
    assert "cannot read the weights" in capsys.readouterr().err
    assert cli.main(["phenotype", "train", str(tmp_path / "out.npz"), "--rate", "0"]) == 2
    assert "--rate must be more than 0" in capsys.readouterr().err
