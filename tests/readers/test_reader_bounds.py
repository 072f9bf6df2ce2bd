"""Files and names from outside that once ended the program, filled the memory or went unreported."""

import csv
import json
import os
import struct
import zlib
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from odometry_of_plot import read_odometry
from readers_worker import MEGABYTES, SECONDS, Worker
from safetensors.numpy import save

from jaxrl_vis import cli
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import weights_file
from jaxrl_vis.host.spreadsheets import escape_cell, to_csv, unescape_cell
from jaxrl_vis.stalks.grasping.masks import painter
from jaxrl_vis.stalks.phenotyping.io import masks
from jaxrl_vis.stalks.phenotyping.io.annotations import read_annotations
from jaxrl_vis.stalks.phenotyping.io.folders import find_plots
from jaxrl_vis.stalks.phenotyping.io.images import image_size, read_image, write_image
from jaxrl_vis.stalks.phenotyping.io.names import file_name, readable
from jaxrl_vis.stalks.phenotyping.report.overlay import draw_overlay
from jaxrl_vis.stalks.phenotyping.report.tables import write_rows
from jaxrl_vis_envs.plants import read

LATIN = os.fsdecode(b"t\xe9t\xe9")


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    worker = Worker()
    yield worker
    worker.close()


def refused(worker: Worker, name: str, files: dict[str, bytes], part: str) -> None:
    outcome = worker.read(name, files)
    assert outcome.kind == "refused" and part in outcome.text, outcome
    assert outcome.seconds < SECONDS and outcome.megabytes < MEGABYTES, outcome


# --- names ---
def test_names_of_any_bytes_are_text():
    assert readable(LATIN) == "tété" == readable("tété") == readable(os.fsdecode("tété".encode()))
    assert readable("a\nb\x07c") == "a_b_c" and readable("x\ud800") == "x?"
    assert readable("t\udcc3\udca9") == "té"  # as Python gives it where the system's language is not set
    draw_overlay(np.zeros((40, 60, 3), np.uint8), [], [], LATIN)


@given(st.text() | st.binary().map(os.fsdecode))
def test_readable_names_can_be_written_and_printed(name):
    text = readable(name)
    assert text.encode().decode() == text == readable(text) and len(text.splitlines()) <= 1
    assert os.fsencode(file_name(text)) == text.encode()


def test_odometry_finds_images_whose_names_are_not_utf8(tmp_path):
    for side in ("left", "right"):
        (tmp_path / f"{side}_000_{LATIN}.png").touch()
    (tmp_path / "odometry.csv").write_text("left,distance_m\nleft_000_tété.png,0.25\n")
    (plot,) = find_plots(tmp_path)
    assert [pair.name for pair in plot.pairs] == ["000_tété"]
    assert read_odometry(plot) == {"000_tété": 0.25}


def test_names_that_are_too_long_are_reported(tmp_path, capsys):
    long = "x" * 300
    for words in (["phenotype", "run", long], ["grasp", "run", long], ["eval", long], ["train", "Reacher", "--run-dir", long]):
        assert cli.main(words) == 2
        told = capsys.readouterr().err
        assert "too long" in told and len(told.splitlines()) == 1
    write_image(tmp_path / f"L_{'y' * 230}.png", np.zeros((2, 2), np.uint8))
    with pytest.raises(RequestError, match="whose name has 236 bytes: rename it, to 200 at most"):
        find_plots(tmp_path)


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (("left_000.png", "000_left.png", "right_000.png"), "both the left image of pair 000"),
        (("left_001.jpg", "left_001.png", "right_001.png"), "both the left image of pair 001"),
        (("left/5.png", "right/5.png", "left_5.png"), "both the left image of pair 5"),
        (("left/5.png", "left/5.jpg", "right/5.png"), "both the left image of pair 5"),
        (("left_1.png", "right_1.png", "disparity_1.pfm", "disparity/1.png"), "both the disparity of pair 1"),
        ((f"left_{LATIN}.png", "left_tété.png", "right_tété.png"), "both the left image of pair tété"),
    ],
)
def test_pairs_of_one_name_are_reported(tmp_path, names, told):
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(RequestError, match=told):
        find_plots(tmp_path)


def test_what_macos_leaves_beside_images_is_not_a_pair(tmp_path):
    for name in ("left_0.png", "right_0.png", "._left_0.png", "._right_0.png", "left_².png"):
        (tmp_path / name).touch()
    assert [pair.name for pair in find_plots(tmp_path)[0].pairs] == ["0", "²"]


# --- tables ---
@given(st.text() | st.sampled_from(("=1+1", "+1", "-1.5", "@x", "\t=1", "'=1", "''=1", "-", " =1", "＝1", "+x")))
def test_no_text_is_computed_and_all_of_it_comes_back(text):
    written = escape_cell(text)
    assert unescape_cell(written) == text
    assert not written.startswith(("=", "@", "\t", "\r", "\n")) and (
        written[:1] not in ("+", "-") or float(written) is not None
    )


def test_tables_neutralize_formulas_and_readers_know_it(tmp_path):
    formula = "=cmd|' calc'!A0"
    write_rows(tmp_path / "skipped.csv", ("plot", "pair", "why"), [{"plot": formula, "pair": "=1+1", "why": "+x"}])
    with (tmp_path / "skipped.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert row == {"plot": f"'{formula}", "pair": "'=1+1", "why": "'+x"}
    assert to_csv([{"a": "-1.25", "b": -3, "=c": None}]) == "a,b,'=c\n-1.25,-3,\n" and to_csv([]) == ""
    for name in ("=left_0.png", "=right_0.png"):
        (tmp_path / name).touch()
    (tmp_path / "odometry.csv").write_text(to_csv([{"left": "=left_0.png", "distance_m": "0.5"}]))
    (plot,) = find_plots(tmp_path)
    assert read_odometry(plot) == {plot.pairs[0].name: 0.5}


# --- images ---
def chunk(kind: bytes, data: bytes, length: int | None = None) -> bytes:
    head = (len(data) if length is None else length).to_bytes(4, "big")
    return head + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")


def png(width: int, height: int, *more: bytes) -> bytes:
    pixels = zlib.compress(b"\0" * min((width + 1) * height, 1_000_000), 9)
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(more) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def tiff(width: int, height: int, **tags: int) -> bytes:
    known = {"bits": 258, "tile_width": 322, "tile_height": 323, "rows": 278}
    entries = {256: width, 257: height, 258: 8, 259: 1, 262: 1, 277: 1, **{known[name]: value for name, value in tags.items()}}
    body = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in sorted(entries.items()))
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + body + b"\0" * 64


def jpeg(width: int, height: int) -> bytes:
    data = cv2.imencode(".jpg", np.zeros((12, 20), np.uint8))[1].tobytes()
    place = data.index(b"\xff\xc0") + 5
    return data[:place] + struct.pack(">HH", height, width) + data[place + 4 :]


@pytest.mark.parametrize(
    ("data", "part"),
    [
        (png(20000, 20000), "20000 x 20000 pixels, more than 100 million"),
        (png(9000, 9000), "9000 x 9000 pixels, but the calibration is for 20 x 12"),
        (tiff(60000, 60000), "more than 100 million"),
        (tiff(9000, 9000), "the calibration is for 20 x 12"),
        (tiff(20, 12, tile_width=1 << 15, tile_height=1 << 15), "not an image"),
        (jpeg(65000, 65000), "more than 100 million"),
        (jpeg(9000, 9000), "the calibration is for 20 x 12"),
        (b"Pf\n99999 99999\n-1\n", "more than 100 million"),
        (b"Pf\n9000 9000\n-1\n", "the calibration is for 20 x 12"),
        (png(20, 12, chunk(b"tEXt", b"", 0x7F000000)), "not an image"),  # OpenCV takes the memory that a chunk says
        (png(20, 12)[:-12] + chunk(b"IEND", b"", 0xFF000002), "not an image"),
        (png(0, 12), "not an image"),
        (b"BM" + png(20, 12), "not an image"),
        (b"\xff\xd8" + b"\xff" * 40, "not an image"),
    ],
)
def test_images_are_measured_before_they_are_decoded(worker, data, part):
    refused(worker, "image", {"a.png": data}, part)


def test_a_file_that_is_larger_than_its_pixels_is_not_read(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(png(20, 12))
    with path.open("r+b") as file:
        file.truncate(200_000_000)  # sparse
    with pytest.raises(OSError, match="a.png is larger than 20 x 12 pixels can be"):
        image_size(path)
    os.mkfifo(tmp_path / "pipe.png")
    with pytest.raises(OSError, match="is not a regular file"):
        read_image(tmp_path / "pipe.png")


def test_pngs_keep_what_belongs_to_their_pixels(tmp_path):
    """Palettes and transparency are kept; text of other programs is left out."""
    extra = chunk(b"tEXt", b"Comment\0of a camera")
    (tmp_path / "a.png").write_bytes(png(20, 12, extra))
    assert (read_image(tmp_path / "a.png") == 0).all()
    palette = cv2.imencode(".png", np.full((4, 4, 4), 200, np.uint8))[1].tobytes()
    (tmp_path / "b.png").write_bytes(palette)
    assert read_image(tmp_path / "b.png").shape == (4, 4, 3)


# --- annotations ---
def coco(**changes) -> dict[str, bytes]:
    image = {"id": 1, "file_name": "a.png", "width": 64, "height": 48, **changes.pop("image", {})}
    annotation = {"id": 7, "image_id": 1, "bbox": [1, 1, 5, 5], **changes}
    return {"annotations.json": json.dumps({"images": [image], "annotations": [annotation]}).encode()}


BIG = {"width": 10**6, "height": 10**6}
RUNS = {"size": [10**6, 10**6], "counts": [10, 10**12 - 10]}


@pytest.mark.parametrize(
    ("files", "part"),
    [
        (coco(image=BIG, segmentation=RUNS), "more than 100 million pixels"),
        (coco(image={"width": 30000, "height": 30000}, bbox=None), "more than 100 million pixels"),
        (coco(segmentation={"size": [48, 64], "counts": "o" * 1_000_000}), "cannot be read"),
        (coco(segmentation={"size": [48, 64], "counts": "é" * 9}), "cannot be read"),
        (coco(segmentation={"size": [48, 64], "counts": [10**400]}), "cannot be read"),
        (coco(segmentation={"size": [48, 64], "counts": [0.5, 48 * 64 - 0.5]}), "cannot be read"),
        (coco(segmentation=[[0, 0, 1e300, 0, 1, 1e300]]), "nowhere near an image"),
        (coco(bbox=[0, 0, 1e300, 1]), "nowhere near an image"),
        (coco(image_id=10**400), "which no image has"),
        *(
            (coco(image={"file_name": name}), "name a file in that folder")
            for name in ("../../x", "/etc/passwd", "C:\\x", "..\\x", "a/../../x", "\\\\host\\x", "", "a\0b", "\ud800.png")
        ),
        ({"annotations.json": b'{"a":' * 100_000}, "nested more than 100 levels deep"),
        ({"annotations.json": b"[" * 100_000}, "nested more than 100 levels deep"),
        ({"annotations.json": b'{"images": [], "annotations": [], "a": ' + b"1" * 5000 + b"}"}, "is not COCO"),
        ({"annotations.json": "{}".encode("utf-16")}, "is not UTF-8 text"),
    ],
)
def test_annotations_of_coco_that_ask_for_too_much(worker, files, part):
    refused(worker, "coco", files, part)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ('<?xml version="1.0" encoding="klingon"?><annotation/>', "unknown encoding"),
        ("<a>" * 100_000, "nested more than 100 levels deep"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><annotation>&b;</annotation>', "document type"),
    ],
)
def test_annotations_of_pascal_voc_that_are_none(worker, text, part):
    refused(worker, "voc", {"a.xml": text.encode()}, part)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ('{"shapes": [], "imagePath": "a.png", "imageWidth": 1e400, "imageHeight": 5}', "not an annotation of LabelMe"),
        ('{"shapes": ' + "[" * 100_000, "nested more than 100 levels deep"),
        ('{"shapes": [], "imagePath": "..", "imageWidth": 5, "imageHeight": 5}', "annotates nothing"),
    ],
)
def test_annotations_of_labelme_that_are_none(worker, text, part):
    refused(worker, "labelme", {"a.json": text.encode()}, part)


def test_two_images_of_one_id_are_reported(tmp_path):
    image = {"id": 1, "file_name": "a.png", "width": 4, "height": 4}
    data = {"images": [image, {**image, "file_name": "b.png"}], "annotations": [{"image_id": 1, "bbox": [0, 0, 1, 1]}]}
    (tmp_path / "annotations.json").write_text(json.dumps(data))
    with pytest.raises(RequestError, match="nobody can tell whose annotations are whose"):
        read_annotations(tmp_path)


@given(st.integers(1, 6), st.integers(1, 6), st.data())
def test_boxes_around_runs_need_no_mask(height, width, data):
    mask = np.array(data.draw(st.lists(st.booleans(), min_size=height * width, max_size=height * width))).reshape(height, width)
    runs = masks.encode_mask(mask, (0, 0), (height, width))
    np.testing.assert_array_equal(masks.decode_mask(runs), mask)
    if mask.any():
        line, column = np.nonzero(mask)
        expected = [column.min(), line.min(), np.ptp(column) + 1, np.ptp(line) + 1]
        assert masks.box_around_runs(masks.check_runs(runs["counts"], height, width), height) == expected


def test_outlines_of_many_corners_are_filled_part_by_part(monkeypatch):
    angle = np.linspace(0.0, 6.28, 1000)
    corners = np.stack([32 + 20 * np.cos(angle), 24 + 15 * np.sin(7 * angle)], axis=1).ravel().tolist()
    whole = masks.rasterize_polygons([corners], (48, 64))
    monkeypatch.setattr(masks, "_CHUNK_SIZE", 500)
    assert whole.any() and (masks.rasterize_polygons([corners], (48, 64)) == whole).all()


# --- weights ---
SETTINGS = {"loss": "gan", "channels": [8, 8]}


def weights(**changes) -> bytes:
    about = {"schema": painter.SCHEMA, "generator": SETTINGS, **changes}
    return save({"params/a": np.zeros(2, np.float16)}, {"about": json.dumps(about)})


@pytest.mark.parametrize(
    ("data", "part"),
    [
        (weights(generator={**SETTINGS, "channels": [10**9]}), "channels of its network must be multiples of 8 from 8 to 1024"),
        (weights(generator={**SETTINGS, "channels": [10**400]}), "channels of its network must be multiples of 8"),
        (weights(generator={**SETTINGS, "channels": [8] * 12}), "10 levels at most"),
        (weights(generator={**SETTINGS, "channels": "x"}), "channels must be a list"),
        (weights(generator={**SETTINGS, "loss": ["gan"]}), "another version"),
        (weights(generator=[]), "holds no weights"),
        (weights(schema=99), "another version"),
        (weights(), "another network"),
        (save({"a": np.zeros(2, np.float16)}), "holds no weights"),
        (save({"a": np.zeros(2, np.float16)}, {"about": "[" * 100_000}), "holds no weights"),
        (save({"a": np.zeros(2, np.float16)}, {"about": "7"}), "holds no weights"),
        (weights()[:-1], "holds no weights"),
        (b"", "holds no weights"),
        ((1 << 62).to_bytes(8, "little") + b"{}", "holds no weights"),
        (b"PK\x03\x04 half of it", "holds no weights"),
    ],
)
def test_weights_are_checked_before_a_network_is_built(worker, data, part):
    refused(worker, "painter", {"w.safetensors": data}, part)


@pytest.mark.parametrize(
    ("kind", "part"),
    [("shape", "is not"), ("type", "is not"), ("name", "is missing or too many"), ("value", "not finite")],
)
def test_arrays_that_are_not_those_of_the_network_are_reported(tmp_path, kind, part):
    with weights_file.safetensors.safe_open(painter.SHIPPED, "numpy") as file:
        about, arrays = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}
    name = min(name for name in arrays if name.endswith("bias"))
    arrays |= {
        "shape": {name: arrays[name][1:]},
        "type": {name: arrays[name].astype(np.int32)},
        "name": {f"{name}/more": arrays[name]},
        "value": {name: arrays[name] * np.float16("nan")},
    }[kind]
    (tmp_path / "w.safetensors").write_bytes(save(arrays, about))
    with pytest.raises(RequestError, match=part):
        painter.read_weights(tmp_path / "w.safetensors")


def test_weights_of_ten_bits_are_off_by_half_a_step_at_most(tmp_path):
    rng = np.random.default_rng(0)
    kernel = rng.normal(size=(9, 64, 32)).astype(np.float32) * np.linspace(0.0, 2.0, 32, dtype=np.float32)
    params = {"layer": {"kernel": kernel, "bias": kernel[0, 0], "small": kernel[0]}}
    weights_file.write_parameters(tmp_path / "w.safetensors", params, {}, bits=10)
    found, _, _ = weights_file.read_parameters(tmp_path / "w.safetensors", "train", lambda about: (None, params))
    step = np.abs(kernel).max(axis=(0, 1)) / 511
    assert (np.abs(np.asarray(found["layer"]["kernel"]) - kernel) <= 0.501 * step).all()
    for name in ("bias", "small"):  # too few to be worth it
        np.testing.assert_array_equal(found["layer"][name], params["layer"][name].astype(np.float16))
    assert (tmp_path / "w.safetensors").stat().st_size < 2.5 * kernel.size
    with weights_file.safetensors.safe_open(tmp_path / "w.safetensors", "numpy") as file:
        about, arrays = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}
    assert arrays.pop("layer/kernel.scale").shape == (32,) and arrays["layer/kernel.low"].shape == (9 * 64 * 32 // 4,)
    for more, part in (({}, "is missing or too many"), ({"layer/kernel.scale": np.ones(31, np.float32)}, "is not")):
        (tmp_path / "w.safetensors").write_bytes(save({**arrays, **more}, about))
        with pytest.raises(RequestError, match=part):
            weights_file.read_parameters(tmp_path / "w.safetensors", "train", lambda about: (None, params))


# --- families ---
@pytest.mark.parametrize(
    ("name", "text", "part"),
    [
        ("a.json", "[" * 100_000, "nested more than 100 levels deep"),
        ("a.json", '{"a":' * 90_000, "is not JSON"),
        ("a.toml", "a = " + "[" * 90_000, "nested more than 100 levels deep"),
        ("a.toml", "a." * 40_000 + "b = 1", "more than 200 dots in a line"),
        ("a.toml", "layout.plot_length = 0x" + "f" * 9_000, "plot_length"),
        ("a.json", '{"layout": {"plot_length": 1e400}}', "plot_length"),
        ("a.json", '{"name": "\\ud800"}', "a.json"),
        ("a.json", '{"name": ["x"]}', "name must be a word"),
        ("a.json", '{"layout": ' + str(["x" * 9000]).replace("'", '"') + "}", "layout must be a table"),
        ("a.json", " " * 200_000, "larger than"),
    ],
)
def test_families_that_are_none(tmp_path, name, text, part):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=part) as error:
        read(tmp_path / name)
    assert name in str(error.value) and len(str(error.value)) < 1000 and len(str(error.value).splitlines()) == 1
