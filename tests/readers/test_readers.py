"""Every reader of external files returns a value or raises its own one-line error, for any bytes, in 1 s of CPU and 200 MB.

Valid files are corrupted (`mutations`) and read in another process (`readers_worker`), so that a crash is reported as one. At
least a third of the examples of each kind get past the parser. `make fuzz` tries many more, and other ones each time.
"""

import base64
import json
import os
from collections import Counter
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from hypothesis import event, given
from hypothesis import strategies as st
from mutations import blobs, json_text, models, pngs, texts, toml_text, trees, xml_text, yaml_text
from readers_of_files import ANNOTATED, IMAGE, PAIRS
from readers_worker import MEGABYTES, SECONDS, Worker
from safetensors.numpy import save

Files = dict[str, bytes]


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    worker = Worker()
    yield worker
    worker.close()


def hold(worker: Worker, name: str, files: st.SearchStrategy[Files], refuses: bool = True) -> None:
    """Check that reader ``name`` reads or refuses corrupted files within the limits of time and memory.

    At least a third must get past the parser, some must be read and, if ``refuses``, some refused.
    """
    tally: Counter[str] = Counter()

    @given(files)
    def check_property(files: Files) -> None:
        outcome = worker.read(name, files)
        tally.update(["all", outcome.kind, *(["parsed"] if outcome.parsed else [])])
        event(f"{name}: {outcome.kind}{', past the parser' if outcome.parsed else ''}")
        assert outcome.kind != "fault", outcome.text
        assert outcome.seconds < SECONDS and outcome.megabytes < MEGABYTES, outcome

    check_property()
    print(f"{name}: {tally['all']} examples, {tally['parsed']} past the parser, {tally['value']} values")
    assert 3 * tally["parsed"] >= tally["all"]
    assert tally["value"] > 0 and (tally["refused"] > 0 or not refuses)


def named(name: str, data: st.SearchStrategy[bytes]) -> st.SearchStrategy[Files]:
    return data.map(lambda data: {name: data})


def written(text: st.SearchStrategy[str]) -> st.SearchStrategy[bytes]:
    return text.map(lambda text: text.encode("utf-8", "surrogatepass"))


def also_as_text(tree: st.SearchStrategy[str], valid: str) -> st.SearchStrategy[bytes]:
    """Return corrupted trees, and now and then a text that was corrupted as text."""
    return st.one_of(written(tree), written(tree), texts(valid))


# --- calibrations ---
_MATRIX = [500.0, 0.0, 319.5, 0.0, 0.0, 500.0, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0]
_RIGHT = [*_MATRIX[:3], -50.0, *_MATRIX[4:]]
OPENCV = {
    "image_width": 640,
    "image_height": 480,
    "unit": "m",
    "P1": {"rows": 3, "cols": 4, "dt": "d", "data": _MATRIX},
    "P2": {"rows": 3, "cols": 4, "dt": "d", "data": _RIGHT},
}
PLAIN = {"image_size": [640, 480], "P1": _MATRIX, "P2": [_RIGHT[:4], _RIGHT[4:8], _RIGHT[8:]]}
ROS = {"image_width": 640, "image_height": 480, "projection_matrix": {"rows": 3, "cols": 4, "data": _MATRIX}}


def test_calibrations_of_opencv(worker):
    corrupted = st.sampled_from((OPENCV, PLAIN)).flatmap(trees)
    as_yaml = also_as_text(corrupted.map(lambda tree: "%YAML:1.0\n---\n" + yaml_text(tree)), "%YAML:1.0\n" + yaml_text(OPENCV))
    as_json = also_as_text(corrupted.map(json_text), json_text(OPENCV))
    as_xml = also_as_text(trees(OPENCV).map(_opencv_xml), '<?xml version="1.0"?>\n' + _opencv_xml(OPENCV))
    hold(worker, "calibration", st.one_of(named("rig.yaml", as_yaml), named("rig.json", as_json), named("rig.xml", as_xml)))


def _opencv_xml(tree) -> str:
    if isinstance(tree, dict):
        # Numbers stand side by side there.
        for name in ("P1", "P2"):
            data = tree.get(name, {}).get("data") if isinstance(tree.get(name), dict) else None
            if isinstance(data, list):
                tree = {**tree, name: {**tree[name], "data": " ".join(map(str, data))}}
    return xml_text(tree, "opencv_storage")


def test_calibrations_of_ros(worker):
    right = {**ROS, "projection_matrix": {"data": _RIGHT}}
    left = also_as_text(trees(ROS).map(yaml_text), yaml_text(ROS))
    both = st.fixed_dictionaries({"left.yaml": left, "right.yaml": written(trees(right, 1).map(yaml_text))})
    hold(worker, "calibration", both)


def _lines(tree, mark: str) -> str:
    """Return a table of names and values as programs print it, one per line."""
    return "".join(f"{name}{mark}{value}\n" for name, value in tree.items()) if isinstance(tree, dict) else str(tree)


_CAMERA = {"camera_model": "pinhole", "intrinsics": [500.0, 501.0, 319.5, 239.5], "resolution": [640, 480]}
_CAMERA |= {"distortion_model": "radtan", "distortion_coeffs": [0.1, 0.0, 0.0, 0.0]}
_POSE = [[1.0, 0.0, 0.0, -0.1], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
KALIBR = {"cam0": _CAMERA, "cam1": {**_CAMERA, "resolution": [640, 480], "T_cn_cnm1": _POSE}}
REALSENSE = {"baseline": "-50.0", "rectified.0.width": "640", "rectified.0.height": "480", "rectified.0.fx": "500.0"}
REALSENSE |= {"rectified.0.ppx": "319.5", "rectified.0.ppy": 239.5}
MIDDLEBURY = {"cam0": "[500 0 319.5; 0 500 239.5; 0 0 1]", "cam1": "[500 0 340.5; 0 500 239.5; 0 0 1]", "doffs": 21.0}
MIDDLEBURY |= {"baseline": 100.0, "width": 640, "height": 480}
KITTI = {name: " ".join(map(str, matrix)) for name, matrix in (("P0", _MATRIX), ("P1", _RIGHT))}
_CAM = {"fx": 500, "fy": 501.5, "cx": 319.5, "cy": 239.5, "k1": -0.1}
ZED = {"LEFT_CAM_VGA": _CAM, "RIGHT_CAM_VGA": _CAM, "STEREO": {"Baseline": 120.1, "RX_VGA": 0.01, "CV_VGA": 0.0, "RZ_VGA": 0.0}}
SECTIONS = {"image": {"width": 640, "height": 480}}
SECTIONS |= {f"rig/{side}": {"projection": " ".join(map(str, matrix))} for side, matrix in (("l", _MATRIX), ("r", _RIGHT))}


def _sections(tree, mark: str) -> str:
    parts = tree.items() if isinstance(tree, dict) else ()
    return "".join(f"[{name}]\n{_lines(values, mark)}\n" for name, values in parts)


def test_calibrations_of_other_programs(worker):
    """Calibrations are those of kalibr, RealSense, Middlebury, KITTI, ZED, and the older form of ROS."""
    chains = also_as_text(
        trees(KALIBR).map(lambda tree: yaml_text(json.loads(json.dumps(tree)))), yaml_text(json.loads(json.dumps(KALIBR)))
    )
    tables = also_as_text(trees(REALSENSE).map(json_text), json_text(REALSENSE))
    middlebury = also_as_text(trees(MIDDLEBURY).map(lambda tree: _lines(tree, "=")), _lines(MIDDLEBURY, "="))
    kitti = also_as_text(trees(KITTI, 1).map(lambda tree: _lines(tree, ": ")), _lines(KITTI, ": "))
    zed = also_as_text(trees(ZED).map(lambda tree: _sections(tree, "=")), _sections(ZED, "="))
    ros = also_as_text(trees(SECTIONS).map(lambda tree: _sections(tree, "\n")), _sections(SECTIONS, "\n"))
    forms = {
        "chain.yaml": chains,
        "d435.json": tables,
        "calib.txt": middlebury,
        "calib_k.txt": kitti,
        "SN1.conf": zed,
        "ost.txt": ros,
    }
    hold(worker, "cameras", st.one_of(named(name, data) for name, data in forms.items()))


# --- annotations ---
_PIXELS = ANNOTATED[0] * ANNOTATED[1]
_SIZE = list(ANNOTATED)
COCO = {
    "images": [
        {"id": 1, "file_name": "a.png", "width": ANNOTATED[1], "height": ANNOTATED[0]},
        {"id": 2, "file_name": "b.png", "width": ANNOTATED[1], "height": ANNOTATED[0]},
    ],
    "annotations": [
        {
            "id": 1,
            "image_id": 1,
            "category_id": 1,
            "bbox": [10, 10, 16, 30],
            "segmentation": [[10, 10, 26, 10, 20, 40, 12, 40]],
        },
        {
            "id": 2,
            "image_id": 2,
            "bbox": [5, 4, 6, 40],
            "segmentation": {"size": list(ANNOTATED), "counts": [300, 40, _PIXELS - 340]},
        },
        {"id": 3, "image_id": 2, "segmentation": {"size": list(ANNOTATED), "counts": [300, 40, 8, 40, _PIXELS - 388]}},
        {"id": 4, "image_id": 2, "segmentation": {"size": list(ANNOTATED), "counts": "Y9X1X\\m2"}},
    ],
    "categories": [{"id": 1, "name": "stalk"}],
}


def test_boxes_and_outlines_of_coco(worker):
    single = {**COCO, "annotations": [{"image_id": 1, "bbox": [10, 10, 16, 30]}]}
    outlined = {**COCO, "annotations": [{"image_id": 1, "segmentation": [[10, 10, 26, 10, 20, 40, 12, 40]]}]}
    corrupted = st.sampled_from((COCO, single, outlined)).flatmap(trees).map(json_text)
    hold(worker, "coco", named("annotations.json", also_as_text(corrupted, json_text(COCO))))


def test_masks_of_coco(worker):
    each = [{**COCO, "annotations": [annotation]} for annotation in COCO["annotations"][1:]]
    corrupted = st.sampled_from(each).flatmap(lambda data: st.tuples(st.just(data), trees(data["annotations"], 2)))
    changed = corrupted.map(lambda both: json_text({**both[0], "annotations": both[1]}))
    hold(worker, "coco", named("annotations.json", also_as_text(changed, json_text(each[0]))))


_BOX = {"xmin": 10, "ymin": 11, "xmax": 20, "ymax": 40}
VOC = {
    "folder": "images",
    "filename": "a.png",
    "size": {"width": ANNOTATED[1], "height": ANNOTATED[0], "depth": 3},
    "object": [{"name": "stalk", "bndbox": _BOX}, {"name": "leaf", "bndbox": {**_BOX, "xmax": 15}}],
}


def test_annotations_of_pascal_voc(worker):
    text = xml_text(VOC, "annotation")
    declare_shapes = st.sampled_from(("", '<?xml version="1.0" encoding="{}"?>')).flatmap(
        lambda head: st.sampled_from(("utf-8", "utf-8", "UTF-8", "latin-1", "latin-1", "utf-16", "cp037", "klingon")).map(
            head.format
        )
    )
    corrupted = st.tuples(declare_shapes, trees(VOC).map(lambda tree: xml_text(tree, "annotation"))).map("".join)
    hold(worker, "voc", named("a.xml", also_as_text(corrupted, text)))


LABELME = {
    "version": "5.4.1",
    "imagePath": "..\\images\\a.png",
    "imageWidth": ANNOTATED[1],
    "imageHeight": ANNOTATED[0],
    "shapes": [
        {"label": "stalk", "shape_type": "polygon", "points": [[10, 10], [20.5, 10], [18, 40], [11, 40]]},
        {"label": "stalk", "shape_type": "rectangle", "points": [[30, 10], [36, 44]]},
    ],
}


def test_annotations_of_labelme(worker):
    hold(worker, "labelme", named("a.json", also_as_text(trees(LABELME).map(json_text), json_text(LABELME))))


_FRACTION = {"x": 20.0, "y": 10.0, "width": 30.0, "height": 50.0, "rotation": 0.0, "rectanglelabels": ["stalk"]}
_SHAPE = {"value": _FRACTION, "original_width": ANNOTATED[1], "original_height": ANNOTATED[0]}
_OUTLINE = {"points": [[10, 10], [40, 10], [40, 80]], "polygonlabels": ["stalk"]}
LABEL_STUDIO = [{"data": {"image": "/data/a.png"}, "annotations": [{"result": [_SHAPE, {**_SHAPE, "value": _OUTLINE}]}]}]
_MASK = base64.b64encode(cv2.imencode(".png", np.full((30, 6), 255, np.uint8))[1].tobytes()).decode()
PAINTED = {
    **LABELME,
    "imagePath": "a.png",
    "shapes": [
        {"label": "stalk", "shape_type": "mask", "points": [[10, 10], [15, 39]], "mask": _MASK},
        {"label": "stalk", "shape_type": "rotation", "points": [[30, 10], [36, 10], [36, 40], [30, 40]], "group_id": 1},
        {"label": "stalk", "shape_type": "polygon", "points": [[40, 10], [46, 10], [46, 40]], "group_id": 1},
    ],
}
YOLO = [[0, 0.5, 0.5, 0.2, 0.4], [0, 0.1, 0.1, 0.3, 0.1, 0.3, 0.6], [1, 0.5, 0.5, 0.2, 0.4]]
CVAT = (
    '<annotations><image id="0" name="a.png" width="64" height="48"><box label="stalk" xtl="{}" ytl="10" xbr="20" ybr="{}"/>'
    '<polygon label="stalk" points="30,10;36,10;{},40"/><mask label="stalk" rle="{}" left="40" top="10" width="6" height="30"/>'
    "</image></annotations>"
)
TURNED = {**VOC, "object": [{"name": "stalk", "robndbox": {"cx": 15.0, "cy": 25, "w": 6, "h": 30, "angle": 0.1}}]}


def test_annotations_of_other_programs(worker):
    """Annotations are those of Label Studio, LabelMe with masks, YOLO, CVAT and roLabelImg."""
    studio = also_as_text(trees(LABEL_STUDIO).map(json_text), json_text(LABEL_STUDIO))
    painted = also_as_text(trees(PAINTED).map(json_text), json_text(PAINTED))
    rows = trees(YOLO).map(lambda tree: "\n".join(" ".join(map(str, row)) for row in tree if isinstance(row, list)))
    names = st.sampled_from(("stalk\nleaf\n", "leaf\n", ""))
    yolo = st.tuples(also_as_text(rows, "0 0.5 0.5 0.2 0.4\n"), names)
    values = st.sampled_from(("10", "12.5", "-3", "nan", "1e400", "x", "", "0,180", "0, 90, 90", "10, 160, 9", "1e9", "180"))
    cvat = st.lists(values, min_size=4, max_size=4).map(lambda four: CVAT.format(*four))
    whole = CVAT.format("10", "40", "36", "0, 180")
    turned = also_as_text(trees(TURNED).map(lambda tree: xml_text(tree, "annotation")), xml_text(TURNED, "annotation"))
    forms = [
        named("tasks.json", studio),
        named("a.json", painted),
        yolo.map(lambda both: {"a.txt": both[0], "classes.txt": both[1].encode()}),
        named("annotations.xml", st.one_of(written(cvat), texts(whole))),
        named("a.xml", turned),
    ]
    hold(worker, "annotations", st.one_of(forms))


# --- tables ---
_HEAD = ("pair", "left", "time_s", "distance_m", "x", "y", "latitude", "longitude")
_ROWS = [
    [str(place), f"left_{name}.png", *(f"{step * place:.5f}" for step in (0.1, 0.06, 0.06, 0.01, 1e-5, 0.0))]
    for place, name in enumerate(PAIRS)
]


def test_odometries(worker):
    columns = st.lists(st.sampled_from(_HEAD), min_size=1, max_size=5, unique=True)
    cells = st.sampled_from(("", "1e400", "nan", "x", "'=1", '"', "-1", "٣", "left_000.png", "../left_001.png", "1_0", " 1 "))

    @st.composite
    def tables(draw: st.DrawFn) -> bytes:
        head = draw(st.just(list(_HEAD)) | columns)
        rows = [[dict(zip(_HEAD, row))[name] for name in head] for row in _ROWS]
        for _ in range(draw(st.integers(0, 2))):
            row = rows[draw(st.integers(0, 2))]
            row[draw(st.integers(0, len(row) - 1))] = draw(cells)
        if draw(st.integers(0, 3)) == 0:
            long = [["x" * 200_000] * len(head)]  # more than the table's reader takes
            rows = draw(st.sampled_from((rows[:2], rows * 2, [*rows, []], [["1"]], long, [["1"] * len(head)] * 60_000)))
        return "\n".join(",".join(row) for row in [head, *rows]).encode()

    valid = "\n".join(",".join(row) for row in [list(_HEAD), *_ROWS])
    hold(worker, "odometry", named("odometry.csv", st.one_of(tables(), tables(), texts(valid))))


def test_plans_of_fields(worker):
    head = ["plot_id", "range", "row", "genotype"]
    cells = st.sampled_from(("", "plot_000", "plot_001", "1", "x", "'=1", '"', "\0", "A;B", "x" * 300))
    rows = st.lists(st.lists(cells, min_size=0, max_size=5), max_size=6).map(
        lambda rows: [head, ["plot_000", "1", "2", "A"], *rows]
    )
    mark = st.sampled_from((",", ";", "\t"))
    tables = st.tuples(rows, mark).map(lambda both: "\n".join(both[1].join(row) for row in both[0]))
    valid = "plot,range\n0,1\n1,1\n2,2\n"
    hold(worker, "plan", named("plan.csv", st.one_of(written(tables), texts(valid))))


# --- images ---
def _images() -> dict[str, bytes]:
    rng = np.random.default_rng(0)
    colour = rng.integers(0, 255, (*IMAGE, 3), np.uint8)
    kinds = {".png": colour, ".jpg": colour, ".tiff": colour, "16.png": rng.integers(0, 60000, IMAGE, np.uint16)}
    encoded = {f"a{end}": cv2.imencode(f".{end.rpartition('.')[2]}", image)[1].tobytes() for end, image in kinds.items()}
    bitmaps = {".bmp": colour, ".ppm": colour, ".pgm": rng.integers(0, 60000, IMAGE, np.uint16)}
    encoded |= {f"b{end}": cv2.imencode(end, image)[1].tobytes() for end, image in bitmaps.items()}
    encoded["big.tiff"] = cv2.imencode(".tiff", kinds["16.png"])[1].tobytes()
    return encoded


def _disparities() -> dict[str, bytes]:
    values = np.linspace(1, 200, IMAGE[0] * IMAGE[1]).reshape(IMAGE)
    kinds = {"d.pfm": np.float32, "d.tiff": np.float32, "d.png": np.uint16}
    return {name: cv2.imencode(name[1:], values.astype(kind))[1].tobytes() for name, kind in kinds.items()}


def _corrupted_images(valid: dict[str, bytes]) -> st.SearchStrategy[Files]:
    return st.one_of(
        named(name, pngs(data) | blobs(data, 33) if name.endswith(".png") else blobs(data, 64)) for name, data in valid.items()
    )


def test_images(worker):
    valid = _images()
    right = st.sampled_from(
        (b"", valid["a.png"], valid["a.jpg"], valid["a16.png"], cv2.imencode(".png", np.zeros((5, 5)))[1].tobytes())
    )
    both = st.tuples(_corrupted_images(valid), right).map(lambda two: {**two[0], "right.png": two[1]})
    hold(worker, "image", _corrupted_images(valid) | both)


_WORDS = (
    "cam0",
    "cam1",
    "im",
    "raw",
    "rect",
    "1608946479.47",
    "1608946479473160331",
    "left",
    "right",
    "L",
    "r",
    "_",
    "-",
    "0",
    "00",
    "1",
    "a",
    "disparity",
    " ",
    "é",
    os.fsdecode(b"\xe9"),
    "²",
    ".",
    "x" * 120,
)
_ENDS = (".png", ".JPG", ".tiff", ".pfm", ".csv", "")


def test_names_of_images(worker):
    """Files may have any names in any folders; they are empty."""
    stem = st.lists(st.sampled_from(_WORDS), min_size=1, max_size=4).map("".join)
    name = st.tuples(stem, st.sampled_from(_ENDS)).map("".join)
    folders = ("", "", "left/", "right/", "L/", "R/", "plot/", "a/b/", "disparity/", "cam0/", "cam1/data/", "image_02/")
    alone = st.tuples(st.sampled_from(folders), name).map("".join)
    pair = alone.flatmap(lambda one: st.just([f"left_{one}".replace("/", "_"), f"right_{one}".replace("/", "_")]))
    nested = st.sampled_from(("left/0.png", "right/0.png", "left/1.png", "right/1.png")).map(lambda one: [one])
    names = st.lists(alone.map(lambda one: [one]) | pair | nested, min_size=1, max_size=6).map(lambda lists: sum(lists, []))
    usable = names.map(lambda found: {each: b"" for each in found if each.rpartition("/")[2].strip(".") and len(each) < 200})
    hold(worker, "names", usable.filter(bool))


def test_disparities(worker):
    hold(worker, "disparity", _corrupted_images(_disparities()))


# --- weights ---
@st.composite
def safetensors(draw: st.DrawFn, arrays: dict[str, np.ndarray], about: dict) -> bytes:
    """Draw a file with corrupted settings, or a corrupted header (names, shapes, types and offsets), or corrupted bytes."""
    kind = draw(st.sampled_from(("about", "about", "about", "header", "bytes")))
    if kind == "about":
        return save(arrays, {"about": json_text(draw(trees(about, 2)))})
    valid = save(arrays, {"about": json_text(about)})
    if kind == "bytes":
        return draw(blobs(valid, 200))
    length = int.from_bytes(valid[:8], "little")
    header = json_text(draw(trees(json.loads(valid[8 : 8 + length]), 2))).encode()
    return len(header).to_bytes(8, "little") + header + valid[8 + length :]


def _shapes(declare_shapes) -> dict[str, np.ndarray]:
    import jax

    leaves = jax.tree_util.tree_flatten_with_path(declare_shapes)[0]
    return {"/".join(part.key for part in path): np.zeros(leaf.shape, np.float16) for path, leaf in leaves}


def test_weights_of_the_detector(worker):
    import dataclasses

    from tiny_detector import TINY

    from jaxrl_vis.stalks.phenotyping.detector.weights import SCHEMA, declare_shapes

    about = {"schema": SCHEMA, "settings": json.loads(json.dumps(dataclasses.asdict(TINY))), "origin": "nothing"}
    hold(worker, "detector", named("w.safetensors", safetensors(_shapes(declare_shapes(TINY)), about)))


def test_weights_of_the_painter(worker):
    from jaxrl_vis.stalks.grasping.masks.painter import SCHEMA, Settings, declare_shapes

    settings = Settings("segmentation", (8, 8))
    about = {"schema": SCHEMA, "generator": {"loss": "segmentation", "channels": [8, 8]}, "origin": "nothing"}
    hold(worker, "painter", named("w.safetensors", safetensors(_shapes(declare_shapes(settings)), about)))


# --- families and records ---
def test_families(worker):
    import dataclasses

    from jaxrl_vis_envs.plants import TRAINING

    whole = json.loads(json.dumps(dataclasses.asdict(TRAINING)))
    del whole["stream"]
    few = {
        "base": "training",
        "name": "mine",
        "layout": {"stalks_mean": 5, "plot_length": 0.5},
        "stalks": {"lean_sd": [0, 3.5]},
    }
    corrupted = st.sampled_from((whole, few, few)).flatmap(trees)
    as_json = also_as_text(corrupted.map(json_text), json_text(few))
    as_toml = also_as_text(corrupted.map(toml_text), toml_text(few))
    hold(worker, "family", named("mine.json", as_json) | named("mine.toml", as_toml))


def test_evaluations_and_truth(worker):
    each = {"number": 0, "true": 5, "counted": 4, "widths_mm": [[15.0, 14.5]], "pairs": 4}
    valid = {"synthetic": True, "each": [each, {**each, "number": 1}]}
    hold(worker, "evaluation", named("e.json", also_as_text(trees(valid).map(json_text), json_text(valid))))
    instance = np.zeros(ANNOTATED, np.uint16)
    instance[5:40, 20:30] = 1
    seen = [
        {"pair": 0, "stalk": 0, "band_box": [20, 5, 29, 39], "band_visible": 0.9},
        {"pair": 1, "stalk": 1, "band_box": None},
    ]
    truth = also_as_text(trees({"seen": seen, "count": 1}).map(json_text), json_text({"seen": seen}))
    image = cv2.imencode(".png", instance)[1].tobytes()
    masks = st.just(image) | pngs(image) | st.just(cv2.imencode(".png", instance[:20])[1].tobytes())
    hold(worker, "truth", st.fixed_dictionaries({"plot.json": truth, "truth/instance_0.png": masks}))


def test_records_of_pairs(worker):
    sighting = {"box": [1, 2, 3, 4], "axis": [1, 2], "score": 0.9, "line": 3, "column": 2, "upper_place": None, "reason": ""}
    files = {"left": None, "right": None, "disparity": None, "calibration": None}
    valid = {"size": [48, 64], "camera_height_m": None, "sightings": [sighting, {**sighting, "hidden": True}], "of": files}
    hold(worker, "record", named("0.json", also_as_text(trees(valid).map(json_text), json_text(valid))), False)


# --- models ---
MODEL = """
<mujoco>
  <asset>
    <texture name="checks" type="2d" builtin="checker" rgb1=".9 .8 .6" rgb2=".2 .3 .5" width="8" height="8"/>
    <texture name="faces" type="cube" builtin="gradient" rgb1="1 .8 .1" rgb2=".1 .1 .7" width="4" height="24"/>
    <texture name="sky" type="skybox" builtin="gradient" rgb1=".5 .7 .9" rgb2="0 .1 .2" width="4" height="24"/>
    <material name="checks" texture="checks" texrepeat="3 2" texuniform="true"/>
    <material name="faces" texture="faces" emission=".1" specular=".3"/>
    <material name="glass" rgba=".2 .3 .4 .5" reflectance=".1"/>
    <mesh name="tent" vertex="0 0 0 .2 0 0 0 .2 0 0 0 .2"/>
    <hfield name="hills" nrow="3" ncol="3" size=".3 .3 .1 .05" elevation="0 1 0 1 2 1 0 1 0"/>
  </asset>
  <visual><headlight ambient=".2 .2 .2"/><map znear=".01" zfar="50"/><global fovy="45"/></visual>
  <worldbody>
    <light type="directional" dir="1 1 -2" diffuse=".3 .2 .1"/>
    <light type="spot" pos="0 -1 2" dir="0 .5 -1" cutoff="40" exponent="5" attenuation="1 .1 .05"/>
    <camera name="front" pos="0 -2.2 1" xyaxes="1 0 0 0 .35 .94" fovy="50"/>
    <geom name="floor" type="plane" size="0 0 1" material="checks"/>
    <geom type="hfield" hfield="hills" pos=".5 0 0"/>
    <body name="arm" pos="0 0 .4">
      <joint type="hinge" axis="0 1 0"/>
      <camera name="hand" mode="targetbody" target="other" pos="0 0 .1"/>
      <light pos="0 0 1" dir="0 0 -1"/>
      <geom type="capsule" size=".1 .2" euler="30 20 0" rgba="0 1 0 1"/>
      <geom type="mesh" mesh="tent" material="glass"/>
      <site name="tip" type="box" size=".01 .02 .03" rgba="1 0 0 1"/>
    </body>
    <body name="other" pos=".5 .1 .4">
      <freejoint/>
      <geom type="ellipsoid" size=".1 .2 .3" material="faces"/>
      <geom type="box" size=".1 .1 .1" pos="0 0 .3" rgba=".5 .5 .5 .5"/>
      <geom type="cylinder" size=".05 .1" pos="0 .2 .3"/>
    </body>
  </worldbody>
</mujoco>
"""


def test_models_that_mujoco_loads(worker):
    hold(worker, "model", named("scene.xml", written(models(MODEL))), False)
