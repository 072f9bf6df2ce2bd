"""Tests of training on annotated images: initial weights, networks that boxes alone leave unchanged, sizes, and masks."""

import dataclasses
import itertools
import json
import shutil
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
from tiny_detector import IMAGE, TINY

from jaxrl_vis import cli
from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.detector.detect import init_detector
from jaxrl_vis.stalks.phenotyping.detector.detector_networks import Segmenter
from jaxrl_vis.stalks.phenotyping.detector.weights import SHIPPED, read_weights, write_weights
from jaxrl_vis.stalks.phenotyping.io.annotations import read_annotations
from jaxrl_vis.stalks.phenotyping.io.calibration import write_calibration
from jaxrl_vis.stalks.phenotyping.io.masks import encode_mask, rasterize_polygons
from jaxrl_vis.stalks.phenotyping.training import detector_training, examples
from jaxrl_vis.stalks.phenotyping.training.annotated import annotated_examples, fit_settings
from jaxrl_vis.stalks.phenotyping.training.detector_training import OUTPUTS
from jaxrl_vis_envs.plants import Calibration


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of three images with one bright stalk each, and a box 30 pixels tall around its middle."""
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
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    detector, segmenter = jax.random.split(jax.random.key(3))
    params = {
        "detector": init_detector(TINY, detector),
        "segmenter": Segmenter(TINY.segmenter).init(segmenter, np.zeros((1, 32, 32, 3), np.float32)),
    }
    write_weights(path, params, dataclasses.replace(TINY, candidates=7), {"origin": "nothing"})
    return path


def differences(one: Path, other: Path) -> dict[str, float]:
    """Return the maximum change of any parameter of each network, without the output layers, which sections initialise anew."""
    first, second = read_weights(one)[0], read_weights(other)[0]
    for params in (first, second):
        params["detector"]["params"] = {
            name: part for name, part in params["detector"]["params"].items() if name not in OUTPUTS
        }
    changes = {name: jax.tree.map(lambda a, b: float(np.abs(a - b).max()), first[name], second[name]) for name in first}
    return {name: max(jax.tree.leaves(changes[name])) for name in changes}


def train(out: Path, folder: Path, *words: str) -> int:
    return cli.main(["phenotype", "train", str(out), "--data", str(folder), "--batch", "4", "--crops", "4", *words])


def test_training_goes_on_from_weights_and_boxes_leave_masks_alone(folder, weights, tmp_path, capsys):
    assert train(tmp_path / "none.safetensors", folder, "--start", str(weights), "--steps", "1", "--rate", "1e-9") == 0
    assert max(differences(tmp_path / "none.safetensors", weights).values()) < 1e-3  # they are kept in 16 bits
    assert train(tmp_path / "more.safetensors", folder, "--start", str(weights), "--steps", "3", "--rate", "1") == 0
    said = capsys.readouterr().out
    assert f"from {weights}" in said and "masks stay as they are" in said and "stalks: stalk (3)" in said
    assert "3 photographs, fewer than 5: none is held out" in said and not (tmp_path / "more.html").exists()
    _, settings, about = read_weights(tmp_path / "more.safetensors")
    # Of an unknown camera: sections, and images resized so that stalks of 8 pixels are 18 pixels wide.
    assert said.count("weights for stalks in the band; the backbone is kept") == 2
    assert settings == dataclasses.replace(TINY.for_sections(), pixels_per_metre=0.0, width=144, full_width=144, crop_width=40)
    assert about["origin"] == f"annotated images, from {weights}"
    changes = differences(tmp_path / "more.safetensors", weights)
    assert changes["detector"] > 1e-3 and changes["segmenter"] == 0.0


def test_labels_name_stalks_of_data(folder, tmp_path, capsys):
    out = str(tmp_path / "out.safetensors")
    assert cli.main(["phenotype", "train", out, "--label", "stem"]) == 2
    assert "--label goes with --data" in capsys.readouterr().err
    assert cli.main(["phenotype", "train", out, "--data", str(folder), "--label", "stem", "leaf"]) == 2
    assert "nothing is called stem, leaf there, but stalk (3)" in capsys.readouterr().err


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
    assert train(tmp_path / "out.safetensors", outlined, "--start", str(weights), "--steps", "3", "--rate", "1") == 0
    assert differences(tmp_path / "out.safetensors", weights)["segmenter"] > 1e-3


def test_boxes_of_another_size_start_from_random_weights_or_are_refused(folder, tmp_path, capsys):
    # A calibration says how large the stalks are: 30 rows, where the shipped weights have 135.
    calibrated = tmp_path / "calibrated"
    shutil.copytree(folder, calibrated)
    pixels_per_metre = read_weights(SHIPPED)[1].pixels_per_metre
    write_calibration(
        calibrated / "calibration.yaml", Calibration(IMAGE[1], IMAGE[0], 0.8 * pixels_per_metre, (31.5, 29.5), 0.1)
    )
    assert train(tmp_path / "out.safetensors", calibrated, "--start", "shipped", "--steps", "1") == 2
    refusal = capsys.readouterr().err
    assert "30 pixels tall" in refusal and "135" in refusal and "--start random" in refusal
    assert not (tmp_path / "out.safetensors").exists()
    assert cli.main(["phenotype", "train", str(tmp_path / "out.safetensors"), "--start", "missing.safetensors"]) == 2
    assert "cannot read the weights" in capsys.readouterr().err
    assert cli.main(["phenotype", "train", str(tmp_path / "out.safetensors"), "--rate", "0"]) == 2
    assert "--rate must be more than 0" in capsys.readouterr().err


# --- what annotations say ---


def coco_folder(folder: Path, annotation: dict, image: dict | None = None) -> Path:
    """Write one image of 64 x 60 pixels and one annotation to a folder, and return it."""
    about = {"id": 1, "file_name": "row.png", "width": IMAGE[1], "height": IMAGE[0], **(image or {})}
    cv2.imwrite(str(folder / "row.png"), np.full((*IMAGE, 3), 90, np.uint8))
    data = {"images": [about], "annotations": [{"id": 7, "image_id": 1, **annotation}]}
    (folder / "annotations.json").write_text(json.dumps(data))
    return folder


BOX = [10, 4, 10, 40]
RUNS = encode_mask(np.ones((40, 10), bool), (4, 10), IMAGE)


@pytest.mark.parametrize(
    ("annotation", "part"),
    [
        ({"bbox": BOX, "image_id": 5}, "has the image_id 5, which no image has"),
        ({"bbox": BOX, "image_id": [1]}, "has the image_id [1], which no image has"),
        ({}, "has neither a bbox nor a segmentation"),
        ({"bbox": [10, 4, 10]}, "has a bbox that is not 4 numbers"),
        ({"bbox": [10, 4, None, 40]}, "has a bbox that is not 4 numbers"),
        ({"bbox": [10, 4, 0, 40]}, "has a box of 0 x 40 pixels"),
        ({"bbox": [10, 4, 10, -1]}, "has a box of 10 x -1 pixels"),
        ({"bbox": [100, 40, 100, 400]}, "outside its image of 64 x 60 pixels"),
        ({"bbox": BOX, "segmentation": [[10, 4, 20, 4, 20]]}, "has a polygon that is not column, line"),
        ({"bbox": BOX, "segmentation": [10, 4, 20, 4, 20, 44]}, "has a polygon that is not column, line"),
        ({"bbox": BOX, "segmentation": [[10, 4, 20, 44]]}, "3 corners or more"),
        ({"bbox": BOX, "segmentation": {"counts": [1]}}, "has a mask without size"),
        ({"bbox": BOX, "segmentation": {**RUNS, "size": [600, 640]}}, "a mask of 640 x 600 pixels, but its image has 64 x 60"),
        ({"bbox": BOX, "segmentation": {**RUNS, "counts": [5, 5]}}, "runs of 10 pixels do not cover an image of 64 x 60"),
        ({"bbox": BOX, "segmentation": {**RUNS, "counts": [-1, 3841]}}, "has a mask that cannot be read"),
        (
            {"bbox": BOX, "segmentation": {**RUNS, "counts": [[1], 2]}},
            "has a mask that cannot be read (counts are not numbers)",
        ),
        ({"bbox": BOX, "segmentation": {**RUNS, "counts": "`"}}, "runs of a mask end in the middle of a number"),
        ({"bbox": BOX, "segmentation": {**RUNS, "counts": [3840]}}, "has a mask without a pixel"),
    ],
)
def test_what_is_wrong_with_an_annotation_is_reported_with_its_number(tmp_path, annotation, part):
    with pytest.raises(RequestError) as error:
        read_annotations(coco_folder(tmp_path, annotation))
    message = str(error.value)
    assert part in message and "annotations.json: annotation 7 has" in message and message.endswith("mend it, or delete it")
    assert len(message.splitlines()) == 1


@pytest.mark.parametrize(
    ("image", "part"),
    [
        ({"width": None, "file_name": "a.png"}, "image a.png needs a width and a height in pixels, not None and 60"),
        ({"height": 0, "file_name": "a.png"}, "image a.png needs a width and a height in pixels, not 64 and 0"),
        ({"file_name": None}, "image number 1 needs an id and a file_name"),
    ],
)
def test_what_is_missing_of_an_image_is_reported(tmp_path, image, part):
    with pytest.raises(RequestError) as error:
        read_annotations(coco_folder(tmp_path, {"bbox": BOX}, image))
    assert part in str(error.value) and "annotations.json" in str(error.value)


def test_wrong_annotations_of_voc_and_labelme_name_their_file(tmp_path):
    box = "<bndbox><xmin>11</xmin><ymin>5</ymin><xmax>{}</xmax><ymax>44</ymax></bndbox>"
    text = "<annotation><filename>row.png</filename><size><width>{}</width><height>60</height></size>{}</annotation>"
    thing = f"<object><name>stalk</name>{box}</object>"
    for width, right, part in (
        (0, 20, "row.xml: image row.png needs a width"),
        (64, 10, "annotation 1 has a box of 0 x"),
    ):
        (tmp_path / "row.xml").write_text(text.format(width, thing.format(right)))
        with pytest.raises(RequestError, match=part):
            read_annotations(tmp_path)
    (tmp_path / "row.xml").unlink()
    shapes = [{"label": "stalk", "points": [[10, 4], [10, 44]], "shape_type": "rectangle"}]
    about = {"shapes": shapes, "imagePath": "row.png", "imageWidth": 64, "imageHeight": 60}
    (tmp_path / "row.json").write_text(json.dumps(about))
    with pytest.raises(RequestError, match="row.json: annotation 1 has a box of 0 x 40 pixels"):
        read_annotations(tmp_path)


@pytest.mark.parametrize("kind", ["coco", "voc", "labelme"])
def test_images_of_another_size_than_was_annotated_are_refused(tmp_path, kind):
    """The image was downscaled by a factor of ten after its annotation."""
    coco_folder(tmp_path, {"bbox": [100, 40, 100, 400]}, {"width": 640, "height": 600})
    if kind != "coco":
        (tmp_path / "annotations.json").unlink()
    if kind == "voc":
        box = "<bndbox><xmin>101</xmin><ymin>41</ymin><xmax>200</xmax><ymax>440</ymax></bndbox>"
        thing = f"<filename>row.png</filename><object><name>stalk</name>{box}</object>"
        size = "<size><width>640</width><height>600</height></size>"
        (tmp_path / "row.xml").write_text(f"<annotation>{thing}{size}</annotation>")
    if kind == "labelme":
        shapes = [{"label": "stalk", "points": [[100, 40], [200, 440]], "shape_type": "rectangle"}]
        about = {"shapes": shapes, "imagePath": "row.png", "imageWidth": 640, "imageHeight": 600}
        (tmp_path / "row.json").write_text(json.dumps(about))
    with pytest.raises(RequestError, match=r"row.png has 64 x 60 pixels, but .* is for 640 x 600: save the image at"):
        list(annotated_examples(tmp_path, TINY))


@pytest.mark.parametrize("segmentation", [[[10, 4, 20, 4, 20, 44, 10, 44]], RUNS])
def test_a_box_that_is_not_there_is_the_one_around_the_mask(tmp_path, segmentation):
    for annotation in ({}, {"bbox": None}):
        (found,) = read_annotations(coco_folder(tmp_path, {"segmentation": segmentation, **annotation}))["annotations"]
        assert found["bbox"] == BOX
    settings = fit_settings(tmp_path, TINY)
    assert settings.band_height == 30.0 and settings.width == 48  # the image is reduced so that the box is as tall


def test_a_calibration_gives_the_scale_of_annotated_images(tmp_path):
    """Without a calibration, images are resized to one width, in training as in detection."""
    coco_folder(tmp_path, {"bbox": BOX})
    assert fit_settings(tmp_path, TINY).pixels_per_metre == 0.0
    usual = TINY.pixels_per_metre * 0.8
    write_calibration(tmp_path / "calibration.yaml", Calibration(IMAGE[1], IMAGE[0], 0.5 * usual, (31.5, 29.5), 0.1))
    settings = fit_settings(tmp_path, TINY)
    assert settings.pixels_per_metre == TINY.pixels_per_metre and settings.band_height == 80.0
    (example,) = annotated_examples(tmp_path, settings)
    assert example.image.shape == (2 * IMAGE[0], 2 * IMAGE[1], 3) and example.stalks[0, 3] == 88.0
    without = [line for line in (tmp_path / "calibration.yaml").read_text().splitlines() if not line.startswith("image_")]
    (tmp_path / "calibration.yaml").write_text("\n".join(without))  # of images that say their size themselves
    assert fit_settings(tmp_path, TINY) == settings
    write_calibration(tmp_path / "calibration.yaml", Calibration(80, 60, usual, (39.5, 29.5), 0.1))
    with pytest.raises(RequestError, match=r"row.png has 64 x 60 pixels, but the calibration is for 80 x 60"):
        fit_settings(tmp_path, TINY)


# --- masks from outlines ---


def test_masks_of_strips_are_as_wide_as_the_strips():
    """Masks of random leaning strips are unbiased; their spread is that of rounding both edges in 100 rows."""
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(300):
        left, wide, lean = rng.uniform(60, 80), rng.uniform(8, 30), rng.uniform(-0.3, 0.3)
        top, tall = rng.uniform(5, 15), 120.0
        right = left + wide
        outline = [left, top, right, top, right + lean * tall, top + tall, left + lean * tall, top + tall]
        runs = rasterize_polygons([outline], (160, 200)).sum(axis=1)[20:120]
        errors.append(runs.mean() - wide)
    assert abs(np.mean(errors)) < 0.02 and np.std(errors) < 0.1


def test_masks_of_outlines_agree_with_boxes_and_runs(tmp_path):
    """A rectangle of 14 x 170 has the same pixels as a box of that size, and as true runs."""
    size = (200, 100)
    cv2.imwrite(str(tmp_path / "row.png"), np.full((*size, 3), 90, np.uint8))
    shapes = [{"label": "stalk", "points": [[30, 20], [44, 190]], "shape_type": "rectangle"}]
    about = {"shapes": shapes, "imagePath": "row.png", "imageWidth": 100, "imageHeight": 200}
    (tmp_path / "row.json").write_text(json.dumps(about))
    settings = dataclasses.replace(TINY, width=100, full_width=100, crop_height=192, crop_width=32)
    (of_rectangle,) = annotated_examples(tmp_path, settings)
    mask = of_rectangle.masks[0]
    assert mask.any(axis=1).sum() == 170 and set(mask.sum(axis=1)) == {0, 14}  # rows of a crop may be shifted
    data = {"images": [{"id": 1, "file_name": "row.png", "width": 100, "height": 200}]}
    for segmentation in (None, encode_mask(np.ones((170, 14), bool), (20, 30), size)):
        data["annotations"] = [{"image_id": 1, "bbox": [30, 20, 14, 170], "segmentation": segmentation}]
        (tmp_path / "annotations.json").write_text(json.dumps(data))
        (other,) = annotated_examples(tmp_path, settings)
        np.testing.assert_array_equal(other.masks, of_rectangle.masks)
        np.testing.assert_array_equal(other.stalks, of_rectangle.stalks)


def test_outlines_beyond_the_image_and_of_several_parts():
    inside = np.zeros((10, 12), bool)
    inside[:4, :5] = True
    np.testing.assert_array_equal(rasterize_polygons([[-7, -3, 5, -3, 5, 4, -7, 4]], (10, 12)), inside)
    inside[6:, 9:] = True
    parts = [[-7, -3, 5, -3, 5, 4, -7, 4], [0, 0, 3, 0, 3, 3, 0, 3], [9, 6, 30, 6, 30, 30, 9, 30]]
    np.testing.assert_array_equal(rasterize_polygons(parts, (10, 12)), inside)  # parts that overlap are not holes
    assert not rasterize_polygons([[20, 20, 30, 20, 30, 30]], (10, 12)).any()


def test_plots_of_several_families_take_turns(weights, tmp_path, monkeypatch):
    drawn = []
    for name in ("one", "two"):
        (tmp_path / f"{name}.toml").write_text(f'base = "training"\nname = "{name}"\n')
    monkeypatch.setattr(examples, "synthetic_examples", lambda family, settings, seed: [(family.name, seed)])

    def read_examples(sources, settings, plan, report, start):
        drawn.extend(itertools.islice(sources[0], 4))
        return start, 0

    monkeypatch.setattr(detector_training, "train", read_examples)
    out = tmp_path / "out.safetensors"
    words = ["--spec", str(tmp_path / "one.toml"), "--mix", str(tmp_path / "two.toml"), "--start", str(weights)]
    assert cli.main(["phenotype", "train", str(out), *words, "--workers", "1"]) == 0
    assert drawn == [("one", 100_000), ("two", 100_001), ("one", 100_002), ("two", 100_003)]
    assert read_weights(out)[2]["origin"] == f"synthetic plots of families one and two, from {weights}"
