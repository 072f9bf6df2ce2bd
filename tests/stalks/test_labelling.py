"""Tests of proposed annotations: outlines, COCO and LabelMe, and existing files, which are never lost."""

import json

import cv2
import jax
import numpy as np
import pytest
from tiny_detector import IMAGE, TINY

from jaxrl_vis import cli
from jaxrl_vis.stalks.phenotyping.detector.detect import init_detector
from jaxrl_vis.stalks.phenotyping.detector.detector_networks import Segmenter
from jaxrl_vis.stalks.phenotyping.detector.finder import Detection
from jaxrl_vis.stalks.phenotyping.detector.weights import write_weights
from jaxrl_vis.stalks.phenotyping.io.annotations import read_annotations
from jaxrl_vis.stalks.phenotyping.io.masks import rasterize_polygons
from jaxrl_vis.stalks.phenotyping.report.proposals import outline, write_coco, write_labelme

SIZE = (120, 100)


@pytest.fixture
def leaning() -> tuple[Detection, np.ndarray]:
    """Return a detection of a leaning strip 9 pixels wide, whose crop extends beyond its box, and its mask within the box."""
    mask = np.zeros(SIZE, bool)
    for row in range(SIZE[0]):
        mask[row, 40 + row // 5 : 49 + row // 5] = True
    part = mask[5:115, 30:90].astype(np.float32)
    shown = np.zeros(SIZE, bool)
    shown[20:100] = mask[20:100]
    return Detection((43.5, 19.5, 68.5, 99.5), (48.0, 64.0), 0.9, part, (5, 30)), shown


def test_outlines_enclose_the_pixels_of_masks(leaning):
    found, mask = leaning
    corners = outline(found)
    assert len(corners) < 80  # not one for each row
    drawn = rasterize_polygons([corners], SIZE)
    assert (drawn & mask).sum() / (drawn | mask).sum() > 0.94
    assert abs(int(drawn.sum()) - int(mask.sum())) < 0.02 * mask.sum()
    empty = Detection((9.5, 19.5, 19.5, 99.5), (14.0, 14.0), 0.9, np.zeros((10, 10), np.float32), (30, 8))
    assert outline(empty) == [10, 20, 20, 20, 20, 100, 10, 100]


def test_proposals_are_read_as_annotations(leaning, tmp_path):
    found, mask = leaning
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((*SIZE, 3), np.uint8))
    write_coco(tmp_path / "annotations.json", [(tmp_path / "a.png", SIZE, [found]), (tmp_path / "b.png", SIZE, [])], "tried")
    read = read_annotations(tmp_path)
    (annotation,) = read["annotations"]
    assert len(read["images"]) == 2 and "stalk (1)" in read["summary"]
    np.testing.assert_allclose(annotation["bbox"], [44, 20, 24, 80], atol=1.1)
    assert (rasterize_polygons(annotation["segmentation"], SIZE) & mask).sum() > 0.96 * mask.sum()
    written = json.loads((tmp_path / "annotations.json").read_text())
    assert {"id", "image_id", "category_id", "bbox", "area", "iscrowd", "segmentation"} <= written["annotations"][0].keys()
    assert written["annotations"][0]["area"] == pytest.approx(mask.sum(), rel=0.02)
    (tmp_path / "annotations.json").unlink()
    write_labelme(tmp_path / "a.png", SIZE, [found])
    (of_labelme,) = read_annotations(tmp_path)["annotations"]
    assert of_labelme["segmentation"] == annotation["segmentation"]


def test_label_writes_beside_the_images_and_keeps_what_is_there(tmp_path, capsys):
    detector, segmenter = jax.random.split(jax.random.key(3))
    blank = np.zeros((1, 32, 32, 3), np.float32)
    params = {"detector": init_detector(TINY, detector), "segmenter": Segmenter(TINY.segmenter).init(segmenter, blank)}
    weights, images = tmp_path / "tiny.safetensors", tmp_path / "images"
    write_weights(weights, params, TINY, {"origin": "nothing"})
    images.mkdir()
    words = ["phenotype", "label", str(images), "--weights", str(weights), "--min-score", "0"]
    assert cli.main(words) == 2
    assert "there are no images in" in capsys.readouterr().err
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(images / name), np.random.default_rng(0).integers(0, 255, (*IMAGE, 3)).astype(np.uint8))
    (images / "broken.png").write_bytes(b"nothing")
    assert cli.main(words) == 3
    assert "skipped" in capsys.readouterr().out
    first = (images / "annotations.json").read_text()
    assert len(json.loads(first)["images"]) == 2
    assert cli.main(words) == 2
    assert "is there already: move it away" in capsys.readouterr().err
    assert (images / "annotations.json").read_text() == first
    (images / "a.json").write_text("mine")
    (images / "broken.png").unlink()
    assert cli.main([*words, "--format", "labelme"]) == 0
    assert "left alone: 1 images" in capsys.readouterr().out
    assert (images / "a.json").read_text() == "mine" and json.loads((images / "b.json").read_text())["imagePath"] == "b.png"
