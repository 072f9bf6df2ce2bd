"""Reports of the readers of files from outside in cases that corrupted files (test_readers.py) seldom reach, one by one."""

import json
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from odometry_of_plot import read_odometry

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import weights_file
from jaxrl_vis.stalks.phenotyping.io.annotations import read_annotations
from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles, PlotFolder, find_plots
from jaxrl_vis.stalks.phenotyping.io.images import read_disparity, read_image

SIZE = {"width": 20, "height": 12}
OUTLINE = [2, 3, 8, 3, 8, 9]


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


# --- plots ---
def test_there_must_be_a_folder_of_plots(tmp_path):
    with pytest.raises(RequestError, match="there is no folder .*nowhere: name one with stereo pairs"):
        find_plots(tmp_path / "nowhere")


def test_two_plots_that_read_alike_are_reported(tmp_path):
    for plot in ("a\x01", "a\x02"):
        touch(tmp_path, f"{plot}/left_0.png", f"{plot}/right_0.png")
    with pytest.raises(RequestError, match="holds two plots called a_: rename one of them"):
        find_plots(tmp_path)


def test_folders_called_l_and_r_may_be_plots_or_sides(tmp_path):
    touch(tmp_path / "plots", *(f"{plot}/{side}_0.png" for plot in "LR" for side in ("left", "right")))
    assert [(plot.name, len(plot.pairs)) for plot in find_plots(tmp_path / "plots")] == [("L", 1), ("R", 1)]
    touch(tmp_path / "sides", "L/0.png", "L/1.png", "R/0.png", "R/notes.txt", "R/2.png/none")
    (plot,) = find_plots(tmp_path / "sides")
    sides = [(pair.name, pair.left is not None, pair.right is not None) for pair in plot.pairs]
    assert plot.name == "sides" and sides == [("0", True, True), ("1", True, False)]


# --- tables ---
def odometry(folder: Path, table: str, speed: float | None = None) -> dict[str, float] | None:
    (folder / "odometry.csv").write_text(table)
    pairs = tuple(PairFiles(name, folder / f"left_{name}.png", None) for name in "01")
    return read_odometry(PlotFolder("plot", folder, pairs), speed)


def test_rows_of_odometry_are_those_of_pairs(tmp_path):
    assert odometry(tmp_path, "distance_m\n0.5\n\n0.75\n") == {"0": 0.5, "1": 0.75}
    assert odometry(tmp_path, "left, distance_m\nc:\\x\\left_1.png, 2\nleft_7.png, 3\n") == {"1": 2.0}
    assert odometry(tmp_path, "time_s\n1\n3\n") is None
    assert odometry(tmp_path, "time_s\n1\n3\n", 0.5) == {"0": 0.5, "1": 1.5}
    assert odometry(tmp_path, "distance_m,left\n1\n2,\n") == {}


@pytest.mark.parametrize(
    "table, told",
    [
        ("", "needs a column distance_m, or time_s and --speed"),
        ("left,distance\nleft_0.png,1\n", "its column distance does not state its unit"),
        ("time_s\n1608946479573159936\n1608946479673159936\n", "name the column time_ns"),
        ("distance_m\n1\n\n,\nfar\n", "not a number in line 5 ('far')"),
        ("left;distance_m\nleft_0.png;1,2,3\n", "not a number in line 2 ('1,2,3')"),
        ("left,metres\nleft_0.png,1\n", "needs a column distance_m, or time_s and --speed"),
        ("distance_m\n1\n", "has 1 rows for 2 pairs, so nobody can tell which is which"),
        ("distance_m\n1\n2\n3\n", "has 3 rows for 2 pairs, so nobody can tell which is which"),
        ("distance_m\n1\nfar\n", "holds something that is not a number"),
        ("left,distance_m\nleft_0.png\n", "holds something that is not a number"),
        ("distance_m\n" + "1" * 200_000, "is not a table: save it as CSV in UTF-8"),
    ],
)
def test_odometry_that_cannot_be_used_is_reported(tmp_path, table, told):
    with pytest.raises(RequestError, match=re.escape(told)):
        odometry(tmp_path, table)


def test_odometry_that_cannot_be_read_is_reported(tmp_path):
    (tmp_path / "odometry.csv").mkdir()
    with pytest.raises(RequestError, match="cannot read .*odometry.csv: "):
        read_odometry(PlotFolder("plot", tmp_path, ()))


# --- images ---
def encoded(end: str, image: np.ndarray) -> bytes:
    return cv2.imencode(end, image)[1].tobytes()


GREY = np.arange(240, dtype=np.uint8).reshape(12, 20)


@pytest.mark.parametrize(
    "name, data, told",
    [
        ("a.tiff", encoded(".tiff", GREY.astype(np.float32)), "holds float32 pixels: save it with 8 or 16 bits"),
        ("a.png", encoded(".png", GREY)[:60], "is not an image, or only a part of one"),
        ("a.png", encoded(".png", GREY)[:33] + b"\xff" * 40, "is not an image, or only a part of one"),
        # OpenCV reads this height otherwise, and raises an error of its own.
        ("a.pfm", b"Pf\n20 \r2\n-1\n" + bytes(160), "is not an image, or only a part of one"),
        ("a.png", b"", "is not an image, or only a part of one"),
    ],
)
def test_images_that_cannot_be_used_are_reported(tmp_path, name, data, told):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(OSError, match=f"{name} {told}"):
        read_image(tmp_path / name)


def test_images_of_all_kinds_are_read_as_they_are(tmp_path):
    colour = np.dstack([GREY, GREY + 1, GREY + 2])
    clear = np.dstack([colour, GREY])
    for image, expected in ((GREY, GREY), (GREY * np.uint16(200), GREY * np.uint16(200)), (colour, colour[..., ::-1])):
        (tmp_path / "a.png").write_bytes(encoded(".png", image))
        np.testing.assert_array_equal(read_image(tmp_path / "a.png"), expected)
    (tmp_path / "a.png").write_bytes(encoded(".png", clear))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), colour[..., ::-1])


def test_disparities_have_one_channel_and_many_bits(tmp_path):
    path = tmp_path / "d.png"
    for image in (GREY, np.dstack([GREY.astype(np.uint16)] * 3)):
        path.write_bytes(encoded(".png", image))
        with pytest.raises(OSError, match="holds no disparities: name a PFM"):
            read_disparity(path)
    path.write_bytes(encoded(".png", GREY.astype(np.uint16)))
    np.testing.assert_array_equal(read_disparity(path, 2.0), np.where(GREY > 0, GREY / 2.0, np.nan))


# --- annotations ---
def coco(folder: Path, annotation: dict, **image) -> dict:
    data = {"images": [{"id": 1, "file_name": "a.png", **SIZE, **image}], "annotations": [{"image_id": 1, **annotation}]}
    (folder / "annotations.json").write_text(json.dumps(data))
    return read_annotations(folder)


def test_boxes_are_those_around_outlines_and_masks(tmp_path):
    assert coco(tmp_path, {"segmentation": [OUTLINE, [1, 4, 2, 4, 2, 5]]})["annotations"][0]["bbox"] == [1, 3, 7, 6]
    mask = {"size": [12, 20], "counts": [12 * 3 + 2, 5, 240 - 12 * 3 - 7]}
    assert coco(tmp_path, {"segmentation": mask})["annotations"][0]["bbox"] == [3, 2, 1, 5]


@pytest.mark.parametrize(
    "annotation, image, told",
    [
        ({}, {}, "has neither a bbox nor a segmentation: mend it, or delete it"),
        ({"bbox": [1, 2, 3, 4], "image_id": 7}, {}, "has the image_id 7, which no image has"),
        ({"bbox": [1, 2, 3]}, {}, "has a bbox that is not 4 numbers"),
        ({"bbox": [1, 2, "x", 4]}, {}, "has a bbox that is not 4 numbers"),
        ({"bbox": [1, 2, 1e300, 4]}, {}, "has a bbox that lies nowhere near an image"),
        ({"bbox": [1, 2, 0, 4]}, {}, "has a box of 0 x 4 pixels"),
        ({"bbox": [21, 2, 3, 4]}, {}, "has a box from (21, 2) on, outside its image of 20 x 12 pixels"),
        ({"segmentation": [[1, 2, 3, 4]]}, {}, "has a polygon that is not column, line, column, line"),
        ({"segmentation": "x"}, {}, "has a polygon that is not column, line, column, line"),
        ({"segmentation": [[*OUTLINE[:5], 1e300]]}, {}, "has a polygon that lies nowhere near an image"),
        ({"segmentation": {"size": [12]}}, {}, "has a mask without size (height, width) and counts"),
        ({"segmentation": {"size": [20, 12], "counts": [240]}}, {}, "has a mask of 12 x 20 pixels, but its image has 20 x 12"),
        ({"segmentation": {"size": [12, 20], "counts": ["x"]}}, {}, "has a mask that cannot be read (counts are not numbers)"),
        ({"segmentation": {"size": [12, 20], "counts": [240]}}, {}, "has a mask without a pixel"),
        ({"bbox": [1, 2, 3, 4]}, {"file_name": None}, "image number 1 needs an id and a file_name"),
        ({"bbox": [1, 2, 3, 4]}, {"file_name": "../a.png"}, "has the file_name '../a.png': name a file in that folder"),
        ({"bbox": [1, 2, 3, 4]}, {"width": 2.5}, "image a.png needs a width and a height in pixels, not 2.5 and 12"),
        ({"bbox": [1, 2, 3, 4]}, {"width": 10**9}, "image a.png is said to have 1e+09 x 12, more than"),
    ],
)
def test_annotations_that_cannot_be_used_are_reported(tmp_path, annotation, image, told):
    with pytest.raises(RequestError, match=re.escape(told)):
        coco(tmp_path, annotation, **image)


def test_an_annotation_without_an_image_id_is_reported(tmp_path):
    data = {"images": [{"id": 1, "file_name": "a.png", **SIZE}], "annotations": [{"id": 5, "bbox": [1, 2, 3, 4]}]}
    (tmp_path / "annotations.json").write_text(json.dumps(data))
    with pytest.raises(RequestError, match="annotation 5 has no image_id: mend it, or delete it"):
        read_annotations(tmp_path)


def test_annotations_that_are_not_there_or_cannot_be_read_are_reported(tmp_path):
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(RequestError, match="there are no annotations in "):
            read_annotations(folder)
    for name, make in (("a.xml", os.mkfifo), ("annotations.json", os.mkdir)):
        make(tmp_path / name)
        with pytest.raises(RequestError, match=f"cannot read .*{name}: "):
            read_annotations(tmp_path)


def test_shapes_of_labelme_that_enclose_nothing_are_reported(tmp_path):
    shapes = [
        {"label": "stalk", "points": [[1, 2], [3, 2], [3, 5]]},
        {"label": "stalk", "points": [[1, 2], [3, 2]]},
        {"label": "stalk", "shape_type": "rectangle", "points": [[6, 7], [2, 3]]},
        {"label": "stalk", "shape_type": "circle", "points": [[1, 2], [3, 2], [3, 5]]},
    ]
    data = {"imagePath": "x\\a.png", "imageWidth": 20, "imageHeight": 12, "shapes": shapes}
    for place, told in ((1, "annotation 2 is a polygon of 2 points"), (3, "annotation 4 is a circle, which has no width")):
        data["shapes"] = [shapes[0]] * place + [shapes[place]]
        (tmp_path / "a.json").write_text(json.dumps(data))
        with pytest.raises(RequestError, match=told):
            read_annotations(tmp_path)
    data["shapes"] = [shapes[0], shapes[2]]
    (tmp_path / "a.json").write_text(json.dumps(data))
    assert [each["bbox"] for each in read_annotations(tmp_path)["annotations"]] == [[1, 2, 2, 3], [2, 3, 4, 4]]


# --- weights ---
@pytest.mark.parametrize("data", [b"", b"\x02", b"\x01" + bytes(7) + b"{}", b"\x03" + bytes(7) + b"{}", b"\xff" * 16])
def test_weights_whose_header_cannot_be_one_are_reported(tmp_path, data):
    (tmp_path / "w.safetensors").write_bytes(data)
    with pytest.raises(RequestError, match=r"w.safetensors holds no weights: name a file that `train` wrote"):
        weights_file.read_parameters(
            tmp_path / "w.safetensors", "train", lambda about: pytest.fail("it was asked what it holds")
        )


def test_weights_that_are_a_folder_are_reported(tmp_path):
    with pytest.raises(RequestError, match="holds no weights"):
        weights_file.read_parameters(tmp_path, "train", lambda about: pytest.fail("it was asked what it holds"))
    with pytest.raises(RequestError, match="cannot read the weights .*none.safetensors: No such file"):
        weights_file.read_parameters(
            tmp_path / "none.safetensors", "train", lambda about: pytest.fail("it was asked what it holds")
        )
