"""Tests of calibrations of stereo cameras in files of OpenCV and ROS, and of errors in others."""

import dataclasses
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.calibration import check_size, read_calibration, write_calibration
from jaxrl_vis.stalks.phenotyping.io.file_storage import parse_storage
from jaxrl_vis_envs.plants import Calibration

CAMERAS = Calibration(640, 480, 500.0, (319.5, 239.5), 0.1)


def ros(camera: Calibration, baseline: float) -> str:
    f, (x, y) = camera.focal, camera.centre
    return (
        f"image_width: {camera.width}\nimage_height: {camera.height}\ncamera_name: rig\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{f}, 0, {x}, 0, {f}, {y}, 0, 0, 1]\n"
        f"projection_matrix:\n  rows: 3\n  cols: 4\n  data: [{f}, 0., {x}, {-f * baseline}, 0., {f}, {y}, 0., 0., 0., 1., 0.]\n"
    )


def test_calibrations_of_opencv_and_ros_are_read(tmp_path):
    offset = dataclasses.replace(CAMERAS, offset=12.5)
    for each in (CAMERAS, offset):
        write_calibration(tmp_path / "rig.yaml", each)
        found = read_calibration(tmp_path / "rig.yaml")
        assert dataclasses.astuple(found)[:2] == (640, 480)
        assert found.focal == each.focal and found.baseline == pytest.approx(0.1) and found.offset == pytest.approx(each.offset)
        assert found.depth(found.disparity(np.array([0.8]))) == pytest.approx(0.8)
    assert read_calibration(matrices(tmp_path / "rig.xml", 0.1)).baseline == pytest.approx(0.1)
    (tmp_path / "left.yaml").write_text(ros(CAMERAS, 0.0))
    (tmp_path / "right.yaml").write_text(ros(CAMERAS, 0.1))
    assert read_calibration(tmp_path) == read_calibration(tmp_path / "right.yaml") == CAMERAS
    info = "width: 640\nheight: 480\nP: [500, 0, 319.5, {}, 0, 500, 239.5, 0, 0, 0, 1, 0]\n"
    (tmp_path / "left.yaml").write_text(info.format(0))
    (tmp_path / "right.yaml").write_text(info.format(-50))
    assert read_calibration(tmp_path) == CAMERAS


def test_a_calibration_that_begins_with_a_mark_of_byte_order(tmp_path):
    write_calibration(tmp_path / "rig.yaml", CAMERAS)
    (tmp_path / "rig.yaml").write_text((tmp_path / "rig.yaml").read_text(), encoding="utf-8-sig")
    assert read_calibration(tmp_path / "rig.yaml").focal == CAMERAS.focal


LEFT = "[500, 0, 319.5, 0, 0, 500, 239.5, 0, 0, 0, 1, 0]"


def matrices(
    path: Path, baseline: float, focal: float = 500.0, unit: str = "", size: bool = True, right_focal: float = 500.0
) -> Path:
    store = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    if size:
        store.write("image_width", 640)
        store.write("image_height", 480)
    if unit:
        store.write("unit", unit)
    store.write("P1", np.array([[focal, 0, 319.5, 0], [0, focal, 239.5, 0], [0, 0, 1, 0]], float))
    store.write("P2", np.array([[right_focal, 0, 319.5, -focal * baseline], [0, focal, 239.5, 0], [0, 0, 1, 0]], float))
    store.release()
    return path


def test_millimetres_are_not_taken_for_metres(tmp_path):
    millimetres = matrices(tmp_path / "mm.yaml", 100.0)
    with pytest.raises(RequestError, match=r"--calibration-unit mm if the chessboard was measured in mm \(0.1 m\)"):
        read_calibration(millimetres)
    assert read_calibration(millimetres, "mm").baseline == pytest.approx(0.1)
    assert read_calibration(matrices(tmp_path / "said.yaml", 100.0, unit="mm")).baseline == pytest.approx(0.1)
    with pytest.raises(RequestError, match=r"--calibration-unit m if the chessboard was measured in m \(0.1 m\)"):
        read_calibration(matrices(tmp_path / "m.yaml", 0.1), "mm")


@pytest.mark.parametrize(
    ("length", "unit", "told"), [(10.0, "cm", "cm if"), (4.16667, "24mm", "24mm if it was counted in squares")]
)
def test_chessboards_in_centimetres_and_squares(tmp_path, length, unit, told):
    file = matrices(tmp_path / "board.yaml", length)
    with pytest.raises(RequestError, match=f"not that of a stereo pair: say .*--calibration-unit {told}"):
        read_calibration(file)
    assert read_calibration(file, unit).baseline == pytest.approx(0.1, rel=1e-4)
    with pytest.raises(RequestError, match="must be m, cm or mm, or the side of a square"):
        read_calibration(file, "feet")


def test_the_last_columns_of_both_cameras_count(tmp_path):
    """If both are relative to a third camera, the baseline is their difference; equal ones are refused."""
    for side, place in (("left", 0.05), ("right", 0.15)):
        (tmp_path / f"{side}.yaml").write_text(ros(CAMERAS, place))
    assert read_calibration(tmp_path).baseline == pytest.approx(0.1)
    (tmp_path / "left.yaml").write_text(ros(CAMERAS, 0.15))
    with pytest.raises(RequestError, match="baseline of 0"):
        read_calibration(tmp_path)


def test_cameras_above_each_other_are_refused(tmp_path):
    for side, shifts in (("left", (0, 0)), ("right", (0, -5e4))):  # millimetres
        matrix = [500, 0, 319.5, shifts[0], 0, 500, 239.5, shifts[1], 0, 0, 1, 0]
        (tmp_path / f"{side}.yaml").write_text(f"width: 640\nheight: 480\nP: {matrix}\n")
    with pytest.raises(RequestError, match="cameras above each other"):
        read_calibration(tmp_path, "mm")


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (dict(baseline=-0.1), "cameras swapped"),
        (dict(baseline=0.0), "baseline of 0"),
        (dict(baseline=0.1, right_focal=510.0), "not rectified"),
        (dict(baseline=0.1, size=False), "add image_width and image_height"),
        (dict(baseline=0.1, focal=5.0, right_focal=5.0), "focal length of 5 pixels"),
        (dict(baseline=0.1, unit="inch"), "unit must be m, cm or mm"),
        (dict(baseline=1e5), "not that of a stereo pair"),
    ],
)
def test_bad_calibrations_are_reported_in_one_line(tmp_path, arguments, part):
    with pytest.raises(RequestError) as error:
        read_calibration(matrices(tmp_path / "bad.yaml", **arguments))
    assert part in str(error.value) and "bad.yaml" in str(error.value)
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "part"),
    [
        (None, "there is no calibration"),
        ("", "neither P1 and P2"),
        ("a: [1, 2", "not a calibration"),
        ("\x00\x01\x02", "neither YAML nor XML"),
        ("K: [1, 2, 3]", "neither P1 and P2"),
        ("- 1\n- 2", "it holds a list"),
        ("[1, 2]", "it holds a list"),
        ("hello", "neither YAML nor XML"),
        ("P1: hello\nP2: hello", "P1 of the left camera must be 3 x 4 numbers"),
        ("P1: {rows: 3, cols: 4, data: 7}\nP2: 1", "P1 of the left camera must be 3 x 4 numbers"),
        ("P1: [a, b, c, d, e, f, g, h, i, j, k, l]\nP2: 1", "P1 of the left camera must be 3 x 4 numbers"),
        ("P1: !!opencv-matrix\n  rows: 3\n  cols: 4\n  dt: d\n  data: [1, 2]\nP2: 1", "P1 of the left camera must be 3 x 4"),
        ("P1: !!opencv-matrix\n  dt: d\n  data: [1, 2]\nP2: 1", "P1 of the left camera must be 3 x 4"),
        ("P1: !!opencv-matrix\n  rows: 3\n  cols: 4\n  dt: d\n  data: hello\nP2: 1", "P1 of the left camera must be 3 x 4"),
        (f'P1: {LEFT}\nP2: {LEFT}\nimage_width: "640"\nimage_height: 480', "image_width and image_height must be numbers"),
        (f"P1: {LEFT}\nP2: {LEFT}\nimage_width: 640\nimage_height: .Inf", "image_width and image_height must be numbers"),
        (f"P1: {LEFT}\nP2: {LEFT}\nimage_size: [640, x]", "image_size must be numbers"),
        (f"P1: {LEFT}\nP2: {LEFT}\nimage_size: [640, 480]\nunit: 5", "unit must be m, cm or mm"),
        (f"P1: {LEFT}\nP2: {LEFT}\nimage_size: [1e9, 480]", "image_size must be numbers"),
        (f"P1: {LEFT}\nP2: {LEFT}\nimage_size: [640.5, 480]", "image_size must be numbers"),
        ("P2: &a [1]\nP1: *a", "a reference to another place"),
        ("[1]: 2", "a name that is not a word"),
        ("{" * 100_000, "a name that is not a word"),
        ("a: 1\n\tb: 2", "line 2"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage>&b;</opencv_storage>', "declares a document type"),
        ("<opencv_storage><P1>", "neither YAML nor XML"),
        ("# " + "x" * 2_000_000, "larger than 2 MB"),
        *(
            (opening * 100_000, "nested more than 100 levels deep")
            for opening in ("[", "a: [", "{a: ", "- ", '{"a": ', '{"a": [', "<a>", "<opencv_storage><_>")
        ),
    ],
)
def test_files_that_are_no_calibration(tmp_path, text, part):
    path = tmp_path / "rig.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(RequestError) as error:
        read_calibration(path)
    assert part in str(error.value) and len(str(error.value).splitlines()) == 1


def test_calibrations_are_for_images_of_one_size(tmp_path):
    check_size(CAMERAS, 640, 480, "left.png")
    with pytest.raises(RequestError, match="left.png has 480 x 640 pixels, but the calibration is for 640 x 480"):
        check_size(CAMERAS, 480, 640, "left.png")
    (tmp_path / "left.yaml").write_text(ros(dataclasses.replace(CAMERAS, width=320), 0.0))
    (tmp_path / "right.yaml").write_text(ros(CAMERAS, 0.1))
    with pytest.raises(RequestError, match="320 x 480"):
        read_calibration(tmp_path)


@pytest.mark.parametrize("kind", ["yaml", "xml", "json"])
def test_files_are_read_as_opencv_reads_them(tmp_path, kind):
    """Integers, floats, strings, lists and matrices are read as by OpenCV."""
    path = tmp_path / f"any.{kind}"
    store = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    matrix = np.random.default_rng(0).normal(size=(3, 4)) * 10.0 ** np.arange(-6, 6).reshape(3, 4)
    for name, value in (("whole", 7), ("real", -1.5e-300), ("text", "in words"), ("digits", "640"), ("matrix", matrix)):
        store.write(name, value)
    store.startWriteStruct("list", cv2.FileNode_SEQ)
    for value in (1, 2.5, 1e30):
        store.write("", value)
    store.endWriteStruct()
    store.release()
    found = parse_storage(path.read_text())
    store = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert [found[name] for name in ("whole", "real")] == [store.getNode(name).real() for name in ("whole", "real")]
    assert [found[name] for name in ("text", "digits")] == [store.getNode(name).string() for name in ("text", "digits")]
    np.testing.assert_array_equal(np.reshape(found["matrix"]["data"], (3, 4)), store.getNode("matrix").mat())
    assert found["list"] == [store.getNode("list").at(place).real() for place in range(3)]


def test_a_calibration_may_be_a_stream_of_documents(tmp_path):
    """The first of several documents counts; `rostopic echo` prints such streams."""
    path = tmp_path / "rig.yaml"
    write_calibration(path, CAMERAS)
    path.write_text(path.read_text() + "---\nP1: 7\n")
    assert read_calibration(path) == CAMERAS


def test_reading_a_pipe_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "rig.yaml")
    with pytest.raises(RequestError, match="it is not a regular file"):
        read_calibration(tmp_path / "rig.yaml")
