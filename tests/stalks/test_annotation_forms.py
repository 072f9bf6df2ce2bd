"""Tests of annotations in the files and folders that programs export: each yields the same two stalks."""

import base64
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.annotations import read_annotations
from jaxrl_vis.stalks.phenotyping.io.masks import encode_mask

WIDTH, HEIGHT = 160, 120
BOXES = [[30, 10, 10, 70], [100, 20, 8, 60]]
LEAF = [[50, 20], [90, 15], [95, 40]]
Files = dict[str, str]


def corners(box: list[int]) -> list[list[float]]:
    left, top, wide, tall = box
    return [[left, top], [left + wide, top], [left + wide, top + tall], [left, top + tall]]


def coco(file_name: str, names: tuple[str, ...] = ("stalk", "leaf"), **image) -> str:
    about = {"id": 1, "width": WIDTH, "height": HEIGHT, "file_name": file_name, **image}
    outlines = [*map(corners, BOXES), LEAF]
    annotations = [
        {"id": place + 1, "image_id": 1, "category_id": category, "segmentation": [sum(outline, [])], "iscrowd": 0}
        for place, (outline, category) in enumerate(zip(outlines, (1, 1, 2)))
    ]
    categories = [{"id": place + 1, "name": name, "supercategory": "none"} for place, name in enumerate(names)]
    return json.dumps({"info": {}, "licenses": [], "images": [about], "annotations": annotations, "categories": categories})


def voc(file_name: str, size: tuple[int, int] = (WIDTH, HEIGHT)) -> str:
    objects = ""
    for name, (left, top, wide, tall) in [("stalk", BOXES[0]), ("stalk", BOXES[1]), ("leaf", [50, 15, 45, 25])]:
        edges = {"xmin": left + 1, "ymin": top + 1, "xmax": left + wide, "ymax": top + tall}
        bounds = "".join(f"<{edge}>{value}</{edge}>" for edge, value in edges.items())
        objects += f"<object><name>{name}</name><difficult>0</difficult><bndbox>{bounds}</bndbox></object>"
    about = f"<size><width>{size[0]}</width><height>{size[1]}</height><depth>3</depth></size>"
    return f"<annotation><folder>x</folder><filename>{file_name}</filename>{about}{objects}</annotation>"


def turned(file_name: str) -> str:
    """Return roLabelImg XML, whose second box lies on its side and is rotated by a quarter turn."""
    boxes = ""
    for name, x, y, wide, high, angle in (
        ("stalk", 35, 45, 10, 70, 0.0),
        ("stalk", 104, 50, 60, 8, np.pi / 2),
        ("leaf ", 70, 30, 9, 9, 0.3),
    ):
        values = {"cx": x, "cy": y, "w": wide, "h": high, "angle": angle}
        inside = "".join(f"<{key}>{value}</{key}>" for key, value in values.items())
        boxes += f"<object><type>robndbox</type><name>{name}</name><robndbox>{inside}</robndbox></object>"
    size = f"<size><width>{WIDTH}</width><height>{HEIGHT}</height></size>"
    return f"<annotation><filename>{file_name}</filename>{size}{boxes}</annotation>"


def labelme(
    file_name: str, kinds: tuple[str, str] = ("polygon", "rectangle"), names: tuple[str, ...] = ("stalk", "stalk")
) -> str:
    shapes = []
    for kind, name, box in zip(kinds, names, BOXES):
        points = corners(box)
        shape = {"label": name, "points": points, "group_id": None, "shape_type": kind, "flags": {}}
        if kind == "rectangle":
            shape["points"] = [points[2], points[0]]
        if kind == "mask":
            png = cv2.imencode(".png", np.full((box[3], box[2]), 255, np.uint8))[1].tobytes()
            shape |= {"points": [points[0], [points[2][0] - 1, points[2][1] - 1]], "mask": base64.b64encode(png).decode()}
        if kind in ("line", "linestrip"):
            shape["points"] = [points[0], points[2]]
        shapes.append(shape)
    shapes.append({"label": "leaf", "points": LEAF, "group_id": None, "shape_type": "linestrip"})
    about = {"imagePath": file_name, "imageWidth": WIDTH, "imageHeight": HEIGHT, "imageData": None}
    return json.dumps({"version": "5.5.0", "flags": {}, "shapes": shapes, **about})


def cvat(file_name: str) -> str:
    left, top, wide, tall = BOXES[0]
    polygon = ";".join(f"{x:.2f},{y:.2f}" for x, y in corners(BOXES[0]))
    mask = f'rle="0, {8 * 60}" left="100" top="20" width="8" height="60"'
    return (
        '<?xml version="1.0" encoding="utf-8"?><annotations><version>1.1</version><meta><task></task></meta>'
        f'<image id="0" name="{file_name}" width="{WIDTH}" height="{HEIGHT}">'
        f'<polygon label="stalk" source="manual" occluded="0" points="{polygon}" z_order="0"></polygon>'
        f'<mask label="stalk" source="manual" {mask}></mask>'
        f'<polyline label="leaf" points="1,1;5,5"></polyline></image></annotations>'
    )


def cvat_boxes(file_name: str) -> str:
    boxes = "".join(
        f'<box label="stalk" xtl="{left}" ytl="{top}" xbr="{left + wide}" ybr="{top + tall}" rotation="{turn}"/>'
        for (left, top, wide, tall), turn in ((BOXES[0], 0), ([74, 46, 60, 8], 90))
    )
    return f'<annotations><image id="3" name="{file_name}" width="{WIDTH}" height="{HEIGHT}">{boxes}</image></annotations>'


def yolo(outlines: bool = False, score: bool = False) -> str:
    lines = []
    for left, top, wide, tall in BOXES:
        if outlines:
            numbers = [
                value / (WIDTH, HEIGHT)[place % 2] for place, value in enumerate(sum(corners([left, top, wide, tall]), []))
            ]
        else:
            numbers = [(left + wide / 2) / WIDTH, (top + tall / 2) / HEIGHT, wide / WIDTH, tall / HEIGHT]
        lines.append(" ".join(map(str, [1, *numbers, *([0.9] if score else [])])))
    return "\n".join([*lines, "0 0.5 0.5 0.1 0.1"]) + "\n"


def label_studio(short: bool = False) -> str:
    size = {"original_width": WIDTH, "original_height": HEIGHT}
    left, top, wide, tall = (100 * value / (WIDTH, HEIGHT)[place % 2] for place, value in enumerate(BOXES[0]))
    points = [[100 * x / WIDTH, 100 * y / HEIGHT] for x, y in corners(BOXES[1])]
    box = {"x": left, "y": top, "width": wide, "height": tall, "rotation": 0, "rectanglelabels": ["stalk"]}
    outline = {"points": points, "closed": True, "polygonlabels": ["stalk"]}
    leaf = {"format": "rle", "rle": [0, 0], "brushlabels": ["leaf"]}
    address = "/data/local-files/?d=field%201/row%201.png"
    if short:
        shapes = [{**value, **size} for value in (box, outline, leaf)]
        return json.dumps([{"image": address, "id": 7, "label": shapes, "annotator": 1}])
    results = [{"value": value, "type": "labels", **size} for value in (box, outline, leaf)]
    annotations = [{"result": [], "was_cancelled": True}, {"result": results, "was_cancelled": False}]
    return json.dumps([{"id": 7, "data": {"image": address}, "annotations": annotations}])


NAMES = "train: ../train/images\nnc: 2\nnames: ['leaf', 'stalk']\n"
NUMBERED = "path: .\nnames:\n  0: leaf\n  1: stalk\n"
FORMS: dict[str, tuple[Files, str]] = {
    "CVAT, COCO": ({"annotations/instances_default.json": coco("row 1.png")}, "images/row 1.png"),
    "Roboflow, COCO": ({"train/_annotations.coco.json": coco("r_png.rf.1.jpg", ("stalk", "leaf"))}, "train/r_png.rf.1.jpg"),
    "Roboflow, valid beside train": (
        {"train/_annotations.coco.json": coco("r.jpg"), "valid/_annotations.coco.json": coco("none.jpg")},
        "train/r.jpg",
    ),
    "Label Studio, COCO": ({"result.json": coco("images\\8a7f-row1.jpg")}, "images/8a7f-row1.jpg"),
    "Label Studio, COCO of local files": ({"result.json": coco("..\\..\\data\\row 1.png")}, "row 1.png"),
    "Label Studio": ({"project-1-at-2024.json": label_studio()}, "row 1.png"),
    "Label Studio, short": ({"project-1-at-2024.json": label_studio(True)}, "images/row 1.png"),
    "COCO without sizes": ({"annotations.json": coco("r.png", width=None, height=0)}, "r.png"),
    "COCO, other case": ({"annotations.json": coco("r.jpg")}, "R.JPG"),
    "labelImg": ({"r.xml": voc("r.png")}, "r.png"),
    "labelImg, other case": ({"r.xml": voc("r.jpg")}, "r.JPG"),
    "labelImg, no extension": ({"1900_-75.1.xml": voc("1900_-75.1")}, "1900_-75.1.jpg"),
    "labelImg, size 0": ({"r.xml": voc("r.png", (0, 0))}, "r.png"),
    "Pascal VOC": ({"Annotations/r.xml": voc("r.jpg")}, "JPEGImages/r.jpg"),
    "annotated as JPEG, kept as PNG": ({"r.xml": voc("r.jpg")}, "r.png"),
    "roLabelImg": ({"r.xml": turned("r")}, "r.jpg"),
    "CVAT for images": ({"annotations.xml": cvat("field 1/r.png")}, "images/field 1/r.png"),
    "CVAT for images, boxes": ({"annotations.xml": cvat_boxes("r.png")}, "images/r.png"),
    "LabelMe": ({"r.json": labelme("..\\x\\r.png")}, "r.png"),
    "LabelMe, masks": ({"r.json": labelme("r.png", ("mask", "mask"))}, "r.png"),
    "X-AnyLabeling": ({"r.json": labelme("r.png", ("rotation", "rotation"))}, "r.png"),
    "YOLO of Roboflow": ({"data.yaml": NAMES, "train/labels/r.txt": yolo()}, "train/images/r.jpg"),
    "YOLO of Ultralytics": ({"data.yaml": NUMBERED, "labels/train/r.txt": yolo(True)}, "images/train/r.jpg"),
    "YOLO of Label Studio": ({"classes.txt": "leaf\nstalk\n", "labels/r.txt": yolo(), "notes.json": "{}"}, "images/r.png"),
    "YOLO of CVAT": (
        {"obj.names": "leaf\nstalk\n", "obj.data": "classes = 2\n", "train.txt": "x\n", "obj_train_data/r.txt": yolo()},
        "obj_train_data/r.png",
    ),
    "YOLO, with scores": ({"classes.txt": "leaf\nstalk\n", "r.txt": yolo(score=True)}, "r.png"),
}


def put(folder: Path, files: Files, *images: str) -> Path:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    for name in images:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        encoded = cv2.imencode(Path(name).suffix.lower(), np.full((HEIGHT, WIDTH), 90, np.uint8))[1]
        (folder / name).write_bytes(encoded.tobytes())
    return folder


@pytest.mark.parametrize("form", FORMS)
def test_every_form_annotates_the_same_stalks(tmp_path, form):
    files, image = FORMS[form]
    found = read_annotations(put(tmp_path, files, image))
    (about,) = found["images"]
    assert (about["file_name"], about["width"], about["height"]) == (image, WIDTH, HEIGHT)
    assert (tmp_path / about["file_name"]).is_file()
    for annotation, box in zip(found["annotations"], BOXES, strict=True):
        np.testing.assert_allclose(annotation["bbox"], box, atol=1e-6)


# --- what counts as a stalk ---
def named(folder: Path, *names: str) -> Path:
    shapes = [{"label": name, "points": corners(BOXES[0]), "shape_type": "polygon"} for name in names]
    text = json.dumps({"shapes": shapes, "imagePath": "r.png", "imageWidth": WIDTH, "imageHeight": HEIGHT})
    return put(folder, {"r.json": text}, "r.png")


@pytest.mark.parametrize(
    ("names", "labels", "taken"),
    [
        (("stalk", "leaf"), (), [0]),
        (("Stalks", "STALK", "stalk_2", "sorghum stalk", "Maize-Stalk 7"), (), [0, 1, 2, 3, 4]),
        (("stalk", "not stalk", "not stalk (post)", "no stalk", "stalk leaf", "dead stalk", "cornstalks?"), (), [0]),
        (("stem ", "leaf"), ("stem",), [0]),
        (("stem", "stalk", "Culm"), ("culm", "stem"), [0, 2]),
    ],
)
def test_what_is_called_a_stalk_is_one(tmp_path, names, labels, taken):
    found = read_annotations(named(tmp_path, *names), labels)
    assert [int(annotation["source"].rpartition(" ")[2]) - 1 for annotation in found["annotations"]] == taken
    left_out = [" ".join(name.split()) for place, name in enumerate(names) if place not in taken]
    assert all(name in found["summary"] for name in left_out) and ("left out" in found["summary"]) == bool(left_out)


@pytest.mark.parametrize(
    ("names", "labels", "part"),
    [
        (("stem", "leaf"), (), "nothing is called a stalk there, but stem (1), leaf (1): name what counts as one with --label"),
        (("not stalk (post)",), (), "--label 'not stalk (post)'"),
        (("stalk", "leaf"), ("stem",), "nothing is called stem there, but stalk (1), leaf (1)"),
        (("",), ("stem",), "without a name (1)"),
    ],
)
def test_where_nothing_is_called_so_its_names_are_listed(tmp_path, names, labels, part):
    with pytest.raises(RequestError) as error:
        read_annotations(named(tmp_path, *names), labels)
    assert part in str(error.value) and len(str(error.value).splitlines()) == 1


def test_classes_of_yolo_without_names_are_numbers(tmp_path):
    folder = put(tmp_path, {"r.txt": yolo()}, "r.png")
    with pytest.raises(RequestError, match="but 1 .2., 0 .1.: name what counts as one with --label"):
        read_annotations(folder)
    assert len(read_annotations(folder, ("1",))["annotations"]) == 2


# --- shapes ---
@pytest.mark.parametrize("kind", ["line", "linestrip", "point", "circle"])
def test_shapes_without_a_width_are_reported_of_stalks_and_of_nothing_else(tmp_path, kind):
    put(tmp_path, {"r.json": labelme("r.png", ("polygon", kind))}, "r.png")
    with pytest.raises(RequestError, match=rf"r.json: annotation 2 is a {kind}, which has no width: draw it as a polygon"):
        read_annotations(tmp_path)
    put(tmp_path, {"r.json": labelme("r.png", ("polygon", kind), ("stalk", "leaf"))})
    assert len(read_annotations(tmp_path)["annotations"]) == 1


def test_polygons_of_one_group_are_one_stalk(tmp_path):
    parts = [corners([30, 10, 10, 20]), corners([31, 50, 10, 30]), corners(BOXES[1]), LEAF]
    groups, names = [3, 3, None, 3], ["stalk", "stalk", "stalk", "leaf"]
    shapes = [
        {"label": name, "points": part, "group_id": group, "shape_type": "polygon"}
        for part, group, name in zip(parts, groups, names)
    ]
    text = json.dumps({"shapes": shapes, "imagePath": "r.png", "imageWidth": WIDTH, "imageHeight": HEIGHT})
    first, second = read_annotations(put(tmp_path, {"r.json": text}, "r.png"))["annotations"]
    assert first["bbox"] == [30, 10, 11, 70] and len(first["segmentation"]) == 2 and second["bbox"] == BOXES[1]


def test_masks_of_labelme_and_cvat_are_the_pixels_that_were_painted(tmp_path):
    mask = np.random.default_rng(0).random((60, 8)) > 0.4
    png = base64.b64encode(cv2.imencode(".png", mask.astype(np.uint8) * 255)[1].tobytes()).decode()
    shape = {"label": "stalk", "points": [[100, 20], [107, 79]], "shape_type": "mask", "mask": png}
    text = json.dumps({"shapes": [shape], "imagePath": "r.png", "imageWidth": WIDTH, "imageHeight": HEIGHT})
    wanted = encode_mask(mask, (20, 100), (HEIGHT, WIDTH))
    (found,) = read_annotations(put(tmp_path / "labelme", {"r.json": text}, "r.png"))["annotations"]
    assert found["segmentation"] == wanted
    flat = mask.ravel()
    breaks = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff([0, *breaks, flat.size]).tolist()
    runs = [0, *runs] if flat[0] else runs
    text = cvat("r.png").replace(f"0, {8 * 60}", ", ".join(map(str, runs)))
    found = read_annotations(put(tmp_path / "cvat", {"annotations.xml": text}, "r.png"))["annotations"][1]
    assert found["segmentation"] == wanted


# --- several at once ---
def test_files_of_several_forms_are_read_together(tmp_path):
    folder = put(
        tmp_path,
        {
            "a.xml": voc("a.png"),
            "b.json": labelme("b.png"),
            "c.txt": yolo(),
            "classes.txt": "leaf\nstalk",
            "calibration.json": "{}",
            "calibration.xml": "<opencv_storage/>",
        },
        *(f"{name}.png" for name in "abc"),
    )
    found = read_annotations(folder)
    assert sorted(about["file_name"] for about in found["images"]) == ["a.png", "b.png", "c.png"]
    assert len(found["annotations"]) == 6


@pytest.mark.parametrize(
    ("files", "images", "part"),
    [
        ({"r.xml": voc("r.png"), "r.json": labelme("r.png")}, ["r.png"], "r.png is annotated twice, in"),
        ({"r.xml": voc("r.png")}, ["a/r.png", "b/r.png"], "which may be a/r.png or b/r.png"),
        ({"annotations.xml": "<annotations><track/></annotations>"}, [], "tracks of a video"),
        ({"r.txt": "1 0.5 0.5 0.1\n"}, ["r.png"], "is not an annotation of YOLO"),
        ({"r.txt": "1 0.5 0.5 0.1 7\n"}, ["r.png"], "that is not a fraction of an image"),
        ({"r.txt": "1 0.5 0.5 0.1 0.1 0.1 0.1 0.1\n"}, ["r.png"], "line 1 has 7 numbers"),
        ({"data.yaml": "kpt_shape: [3, 2]\nnames: [a]\n", "r.txt": yolo()}, ["r.png"], "of key points"),
        ({"r.json": '{"shapes": [{"label": "stalk", "points": [[0, 0], [5, 5]], "shape_type": "mask", "mask": "$$"}], '
          '"imagePath": "r.png", "imageWidth": 9, "imageHeight": 9}'}, ["r.png"], "a mask that is not base64"),
        ({"r.json": '[1, 2]'}, ["r.png"], "is not an annotation of LabelMe"),
        ({"r.xml": "<opencv_storage/>"}, ["r.png"], "is not an annotation of Pascal VOC, but has the name of an image"),
        ({"notes.txt": "hello", "plot.json": "{}"}, ["r.png"], "(plot.json is none): put annotations.json of COCO there"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_reported_in_one_line(tmp_path, files, images, part):
    with pytest.raises(RequestError) as error:
        read_annotations(put(tmp_path, files, *images), ("stalk", "1"))
    assert part in str(error.value) and len(str(error.value).splitlines()) == 1


def test_regions_of_many_stalks_are_neither_stalks_nor_background(tmp_path):
    from tiny_detector import TINY

    from jaxrl_vis.stalks.phenotyping.detector.sections import STALK, UNCLEAR
    from jaxrl_vis.stalks.phenotyping.training.annotated import annotated_examples, fit_settings

    data = json.loads(coco("r.png"))
    crowd = {"id": 9, "image_id": 1, "category_id": 1, "iscrowd": 1, "bbox": [60, 10, 30, 70]}
    put(tmp_path, {"annotations.json": json.dumps({**data, "annotations": [*data["annotations"], crowd]})}, "r.png")
    assert fit_settings(tmp_path, TINY).anchor_widths[-1] < 12 * TINY.width / WIDTH
    (example,) = annotated_examples(tmp_path, TINY)
    assert (example.kinds == STALK).sum() == 2 and len(example.crops) == 2
    strips = example.stalks[example.kinds == UNCLEAR] * WIDTH / example.image.shape[1]
    # Each strip is about as wide as a stalk, and all of the region lies in one.
    assert np.all(strips[:, 2] - strips[:, 0] < 14) and strips[:, 0].min() == 60 and strips[:, 2].max() == 90
    assert np.all(np.diff(np.sort(strips[:, 0])) < 10)
    data["annotations"] = [crowd]
    (tmp_path / "annotations.json").write_text(json.dumps(data))
    with pytest.raises(RequestError, match="annotates no single stalk"):
        read_annotations(tmp_path)
