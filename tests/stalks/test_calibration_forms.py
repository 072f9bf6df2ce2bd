"""Tests of calibrations in all formats of programs: each yields the same cameras, or one line if it is unusable."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.calibration import find_calibration, read_calibration
from jaxrl_vis_envs.plants import Calibration

CAMERAS = Calibration(640, 480, 500.0, (319.5, 239.5), 0.1)
IDENTITY = "1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0"


def as_yaml(tree, **style) -> str:
    return yaml.safe_dump(json.loads(json.dumps(tree)), **style)  # without references


def p(shift: float = 0.0, focal: float = 500.0) -> list[float]:
    return [focal, 0.0, 319.5, shift, 0.0, focal, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0]


def matrix(values: list[float], indent: str = "   ") -> str:
    rows = len(values) // (4 if len(values) == 12 else 3 if len(values) == 9 else 1)
    cols = len(values) // rows
    shape = f"rows: {rows}\n{indent}cols: {cols}"
    return f"!!opencv-matrix\n{indent}{shape}\n{indent}dt: d\n{indent}data: [ {', '.join(map(str, values))} ]"


def ros1(shift: float) -> str:
    return (
        'header: \n  seq: 1\n  stamp: \n    secs: 16\n    nsecs: 47\n  frame_id: "left"\nheight: 480\nwidth: 640\n'
        f'distortion_model: "plumb_bob"\nD: [0.0, 0.0]\nK: [{IDENTITY}]\nR: [{IDENTITY}]\nP: {p(shift)}\n'
        "binning_x: 0\nbinning_y: 0\nroi: \n  x_offset: 0\n  y_offset: 0\n  height: 0\n  width: 0\n  do_rectify: False\n---\n"
    )


def ros2(shift: float, binning: int = 0, roi: tuple[int, int, int, int] = (0, 0, 0, 0)) -> str:
    return yaml.safe_dump(
        {
            "header": {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": "oak"},
            "height": 480,
            "width": 640,
            "distortion_model": "rational_polynomial",
            "d": [0.0, 0.0],
            "p": p(shift),
            "binning_x": binning,
            "binning_y": binning,
            "roi": {**dict(zip(("x_offset", "y_offset", "height", "width"), roi)), "do_rectify": False},
        },
        sort_keys=False,
        default_flow_style=False,
    )


def ros1_csv(shift: float) -> str:
    cells = {"%time": 1608946479473160331, "field.header.seq": 1, "field.height": 480, "field.width": 640}
    cells |= {f"field.P{place}": value for place, value in enumerate(p(shift))}
    cells |= {"field.binning_x": 0, "field.binning_y": 0, "field.roi.height": 0, "field.roi.width": 0}
    return ",".join(cells) + "\n" + ",".join(map(str, cells.values())) + "\n"


def ros2_csv(shift: float) -> str:
    numbers = [0.0] * 5 + [1.0] * 9 + [1.0] * 9 + p(shift)
    return "1,2,oak,480,640,plumb_bob," + ",".join(map(str, numbers)) + ",0,0,0,0,0,0,False\n"


def printed(shift: float) -> str:
    return (
        "sensor_msgs.msg.CameraInfo(header=std_msgs.msg.Header(stamp=builtin_interfaces.msg.Time(sec=1, nanosec=0), "
        f"frame_id='oak'), height=480, width=640, distortion_model='plumb_bob', d=[0.0], k=array([{IDENTITY}]), "
        f"r=array([{IDENTITY}]), p=array({p(shift)}), binning_x=0, binning_y=0, "
        "roi=sensor_msgs.msg.RegionOfInterest(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False))\n"
    )


def ost(shift: float, side: str) -> str:
    rows = "\n".join(" ".join(map(str, p(shift)[row : row + 4])) for row in (0, 4, 8))
    return (
        "# oST version 5.0 parameters\n\n\n[image]\n\nwidth\n640\n\nheight\n480\n\n"
        f"[narrow_stereo/{side}]\n\ncamera matrix\n1 0 0\n0 1 0\n0 0 1\n\ndistortion\n0 0 0 0 0\n\nprojection\n{rows}\n"
    )


def both(form, suffix: str = ".yaml", names: tuple[str, str] = ("left", "right")) -> dict[str, str]:
    return {f"{name}{suffix}": form(shift) for name, shift in zip(names, (0.0, -50.0))}


OPENCV = f"%YAML:1.0\n---\nP1: {matrix(p())}\nP2: {matrix(p(-50.0))}\n"
LISTS = {"P1": np.reshape(p(), (3, 4)).tolist(), "P2": np.reshape(p(-50.0), (3, 4)).tolist()}
CAMERA = {"camera_model": "pinhole", "intrinsics": [500.0, 500.0, 319.5, 239.5], "resolution": [640, 480]}
CAMERA |= {"distortion_model": "radtan", "distortion_coeffs": [0.0] * 4}
POSE = [[1.0, 0.0, 0.0, -0.1], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
CHAIN = {"cam0": CAMERA, "cam1": {**CAMERA, "T_cn_cnm1": POSE}}
ZED = (
    "[LEFT_CAM_{0}]\nfx=500\nfy=500\ncx=319.5\ncy=239.5\n[RIGHT_CAM_{0}]\nfx=500\nfy=500\ncx=319.5\ncy=239.5\n"
    "[STEREO]\nBaseline=100\n"
)
REALSENSE = {"baseline": "-100.0", "intrinsic_left.x.x": "0.5", "rectified.0.width": "1280", "rectified.0.height": "720"}
REALSENSE |= {"rectified.0.fx": "640", "rectified.0.ppx": "640", "rectified.0.ppy": "360"}
REALSENSE |= {
    "rectified.1.fx": "0",
    "rectified.1.ppx": "0",
    "rectified.1.ppy": "0",
    "rectified.1.width": "640",
    "rectified.1.height": "400",
}
REALSENSE |= {"rectified.2.fx": "500", "rectified.2.ppx": "319.5", "rectified.2.ppy": "239.5", "rectified.2.width": "640"}
REALSENSE |= {"rectified.2.height": "480"}
MIDDLEBURY = (
    "cam0=[500 0 319.5; 0 500 239.5; 0 0 1]\ncam1=[500 0 319.5; 0 500 239.5; 0 0 1]\ndoffs=0\nbaseline=100\nwidth=640\n"
    "height=480\nndisp=270\n"
)
KITTI = "".join(f"{name} {' '.join(map('{:e}'.format, p(shift)))}\n" for name, shift in (("P0:", 0.0), ("P1:", -50.0)))
RAW_KITTI = "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\nS_00: 1.392000e+03 5.120000e+02\n" + "".join(
    f"S_rect_0{camera}: 640 480\nR_rect_0{camera}: 1 0 0 0 1 0 0 0 1\nP_rect_0{camera}: {' '.join(map(str, p(shift)))}\n"
    for camera, shift in ((0, 0.0), (1, -50.0))
)

FORMS: dict[str, dict[str, str]] = {
    "stereo_calib of OpenCV": {"extrinsics.yml": OPENCV, "intrinsics.yml": f"%YAML:1.0\n---\nM1: {matrix([1.0] * 9)}\n"},
    "PyYAML, lists of lists": {
        "rig.yaml": as_yaml({**LISTS, "image_width": 640, "image_height": 480}, default_flow_style=False)
    },
    "PyYAML, lists of lists in brackets": {"rig.yml": as_yaml({**LISTS, "image_size": [640, 480]}, default_flow_style=None)},
    "JSON, lists of lists": {"rig.json": json.dumps({**LISTS, "image_width": 640, "image_height": 480})},
    "rostopic echo": both(ros1),
    "rostopic echo, several messages": both(lambda shift: ros1(shift) * 3),
    "rostopic echo after a warning": both(
        lambda shift: "WARNING: no messages received and simulated time is active.\n" + ros1(shift)
    ),
    "rostopic echo -p": both(ros1_csv, ".txt"),
    "ros2 topic echo": both(lambda shift: ros2(shift) + "---\n"),
    "ros2 topic echo --csv": both(ros2_csv, ".txt"),
    "print of rclpy": both(printed, ".txt"),
    "cam0 and cam1": both(ros2, ".yaml", ("cam0", "cam1")),
    "infra1 and infra2": both(ros2, ".yaml", ("infra1_camera_info", "infra2_camera_info")),
    "LEFT and RIGHT": both(ros2, ".YML", ("LEFT", "RIGHT")),
    "rig_L and rig_R": both(ros2, ".yaml", ("rig_L", "rig_R")),
    "ost.txt of both": {"ost.txt": ost(0.0, "left") + ost(-50.0, "right")},
    "left.ini and right.ini": {"left.ini": ost(0.0, "left"), "right.ini": ost(-50.0, "right")},
    "a table for each side": {
        "stereo.yaml": as_yaml({side: yaml.safe_load(ros2(shift)) for side, shift in (("left", 0.0), ("right", -50.0))})
    },
    "ORB-SLAM": {
        "EuRoC.yaml": "%YAML:1.0\n"
        + "".join(
            f"{side}.height: 480\n{side}.width: 640\n{side}.P: {matrix(p(shift))}\n"
            for side, shift in (("LEFT", 0.0), ("RIGHT", -50.0))
        )
    },
    "kalibr, of rectified images": {"camchain-rig.yaml": as_yaml(CHAIN)},
    "RealSense": {"d435.json": json.dumps(REALSENSE)},
    "Middlebury": {"calib.txt": MIDDLEBURY},
    "KITTI": {"calib.txt": KITTI},
    "KITTI, raw data": {"calib_cam_to_cam.txt": RAW_KITTI},
}


def put(folder: Path, files: dict[str, str]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(text)
    return folder


def image(folder: Path, size: tuple[int, int] = (640, 480)) -> Path:
    path = folder / "left_000.png"
    cv2.imwrite(str(path), np.zeros((size[1], size[0]), np.uint8))
    return path


@pytest.mark.parametrize("form", FORMS)
def test_every_form_says_the_same_cameras(tmp_path, form):
    folder = put(tmp_path / "rig", FORMS[form])
    shown = image(tmp_path)
    for path in (folder, folder / next(iter(FORMS[form])), folder / list(FORMS[form])[-1]):
        if path.name == "intrinsics.yml":
            continue  # it holds half of what is needed
        found = read_calibration(path, None, shown)
        assert (found.width, found.height) == (640, 480)
        assert (found.focal, *found.centre, found.offset) == pytest.approx((500.0, 319.5, 239.5, 0.0))
        assert found.baseline == pytest.approx(0.1)


def test_calibrations_beside_images_are_found(tmp_path):
    """Calibrations are found under the names that programs give them, and no other file is mistaken for one."""
    none = put(tmp_path / "none", {"plot.json": "{}", "annotations.json": "{}", "odometry.csv": "", "notes.txt": ""})
    assert find_calibration(none) is None
    for form in ("stereo_calib of OpenCV", "rostopic echo", "cam0 and cam1", "Middlebury", "KITTI, raw data"):
        folder = put(tmp_path / form, {**FORMS[form], "plot.json": "{}"})
        found = find_calibration(folder)
        assert found is not None and read_calibration(found, None, image(folder)).baseline == pytest.approx(0.1)


def test_binning_and_regions_of_interest(tmp_path):
    """The order is that of ROS's image_geometry: the region is cut out first, then its pixels are binned."""
    folder = put(tmp_path, {"left.yaml": ros2(0.0, 2), "right.yaml": ros2(-50.0, 2)})
    assert read_calibration(folder) == Calibration(320, 240, 250.0, (159.75, 119.75), 0.1)
    region = (40, 20, 200, 400)
    folder = put(tmp_path, {"left.yaml": ros2(0.0, 1, region), "right.yaml": ros2(-50.0, 1, region)})
    assert read_calibration(folder) == Calibration(400, 200, 500.0, (279.5, 219.5), 0.1)


def test_offsets_of_middlebury_keep_their_sign(tmp_path):
    """By the data set's definition, depth is baseline times focal length over the sum of disparity and doffs."""
    text = MIDDLEBURY.replace("cam1=[500 0 319.5", "cam1=[500 0 340.5").replace("doffs=0", "doffs=21")
    found = read_calibration(put(tmp_path, {"calib.txt": text}))
    assert found.depth(np.array([79.0])) == pytest.approx(0.1 * 500 / (79.0 + 21.0))


def test_the_folders_of_images_say_which_pair_of_kitti(tmp_path):
    colour = KITTI + KITTI.replace("P0", "P2").replace("P1", "P3").replace("-5.000000e+01", "-1.000000e+02")
    path = put(tmp_path, {"calib.txt": colour}) / "calib.txt"
    for name, baseline in (("image_0", 0.1), ("image_2", 0.2), ("image_02", 0.2)):
        folder = put(tmp_path / name / "data", {})
        assert read_calibration(path, None, image(folder)).baseline == pytest.approx(baseline)
    with pytest.raises(RequestError, match="holds P0, P1 and P2, P3"):
        read_calibration(path)


def test_the_coloured_pair_of_kitti(tmp_path):
    """Both cameras are offset from the first greyscale one, horizontally and slightly vertically."""
    rows = "{0} 721.5377 0 609.5593 {1} 0 721.5377 172.854 {2} 0 0 1 {3}\n"
    text = rows.format("P2:", 44.85728, 0.2163791, 0.002745884) + rows.format("P3:", -339.5242, 2.199936, 0.002729905)
    found = read_calibration(put(tmp_path, {"calib.txt": text}) / "calib.txt", None, image(tmp_path, (1242, 375)))
    assert found.baseline == pytest.approx(0.5327, abs=1e-4)


REFUSED = {
    "a size that no image gives": ({"rig.yml": OPENCV}, None, "add image_width and image_height"),
    "an image that was cropped": ({"rig.yml": OPENCV}, (400, 480), "far from the middle"),
    "kalibr": (
        {"chain.yaml": as_yaml({**CHAIN, "cam0": {**CAMERA, "distortion_coeffs": [0.1, 0.0, 0.0, 0.0]}})},
        None,
        "kalibr",
    ),
    "kalibr, one camera": ({"chain.yaml": as_yaml({"cam0": CAMERA})}, None, "holds one camera"),
    "kalibr, omni": ({"chain.yaml": as_yaml({**CHAIN, "cam0": {**CAMERA, "camera_model": "omni"}})}, None, "pinhole"),
    "kalibr, no pose": ({"chain.yaml": as_yaml({"cam0": CAMERA, "cam1": CAMERA})}, None, "T_cn_cnm1"),
    "ZED, raw": ({"SN1.conf": ZED.format("VGA").replace("fx=500", "fx=501", 1)}, (672, 376), "how the cameras were built"),
    "ZED, another size": ({"SN1.conf": ZED.format("VGA")}, (1280, 720), "it does not say which"),
    "ZED, a word": ({"SN1.conf": ZED.format("VGA").replace("=100", "=far")}, (672, 376), "not a number"),
    "RealSense, no table": ({"d.json": json.dumps({"baseline": "-50", "intrinsic_left.x.x": "1"})}, None, "export the whole"),
    "RealSense, another size": ({"d.json": json.dumps(REALSENSE)}, (320, 240), "for 1280 x 720, 640 x 480"),
    "RealSense, no size": ({"d.json": json.dumps(REALSENSE)}, None, "for your images"),
    "Middlebury, no doffs": ({"calib.txt": MIDDLEBURY.replace("doffs=0\n", "")}, None, "is missing or not a number"),
    "Middlebury, other doffs": ({"calib.txt": MIDDLEBURY.replace("doffs=0\n", "doffs=9\n")}, None, "say otherwise"),
    "KITTI, one camera": ({"calib.txt": KITTI.splitlines()[0]}, None, "no such pair"),
    "one camera": ({"ost.txt": ost(0.0, "left")}, None, "is of one camera"),
    "never calibrated": (
        both(
            lambda shift: (
                ros2(shift)
                .replace("500.0", "0.0")
                .replace("319.5", "0.0")
                .replace("239.5", "0.0")
                .replace("1.0", "0.0")
                .replace("-50.0", "0.0")
            )
        ),
        None,
        "never calibrated",
    ),
    "OpenCV, raw": (
        {
            "rig.yml": "%YAML:1.0\n---\n"
            + "".join(
                f"{name}: {matrix(values)}\n"
                for name, values in (
                    ("M1", [500.0, 0, 320, 0, 501.0, 240, 0, 0, 1]),
                    ("M2", [500.0, 0, 320, 0, 500.0, 240, 0, 0, 1]),
                    ("R", [1.0, 0, 0, 0, 1, 0, 0, 0, 1]),
                    ("T", [-0.1, 0.0, 0.0]),
                )
            )
        },
        (640, 480),
        "how the cameras were built",
    ),
    "two pairs": ({**both(ros2), **both(ros2, ".yaml", ("cam0", "cam1"))}, None, "several pairs"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_serve_is_reported_in_one_line(tmp_path, case):
    files, size, part = REFUSED[case]
    path = put(tmp_path / "rig", files)
    path = path / next(iter(files)) if len(files) == 1 else path
    with pytest.raises(RequestError) as error:
        read_calibration(path, None, image(tmp_path, size) if size else None)
    assert part in str(error.value) and len(str(error.value).splitlines()) == 1
