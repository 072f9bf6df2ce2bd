"""Tests of ROS 1 and ROS 2 recordings in `phenotype run`: images of both cameras, calibrations, and odometry."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from odometry_of_plot import read_odometry

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io import recording
from jaxrl_vis.stalks.phenotyping.io.calibration import find_calibration, read_calibration
from jaxrl_vis.stalks.phenotyping.io.folders import find_plots
from jaxrl_vis.stalks.phenotyping.io.images import read_image
from jaxrl_vis.stalks.phenotyping.io.recording import Topics, extract_recording, is_recording

SIZE = (24, 32)
FRAMES = 3
PLAIN = np.random.default_rng(0).integers(0, 255, (FRAMES, 2, *SIZE, 3), np.uint8)


def test_without_rosbags_its_installation_is_named(tmp_path, monkeypatch):
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    monkeypatch.setattr(recording.importlib.util, "find_spec", lambda name: None)
    assert is_recording(tmp_path / "a.bag") and not is_recording(tmp_path)
    with pytest.raises(RequestError, match=r"to read it needs rosbags: .*install .*bags"):
        extract_recording(tmp_path / "a.bag", tmp_path / "out")


def write(
    path: Path,
    version: int,
    encoding: str = "rgb8",
    topics=("/stereo/left/image_rect", "/stereo/right/image_rect"),
    distortion: float = 0.0,
    storage: str = "mcap",
) -> Path:
    """Write a recording of `FRAMES` pairs; right images come 2 ms after the left ones, and the robot drives at 0.5 m/s."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    types = store.types
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    writer = Writer1(path) if version == 1 else Writer2(path, version=9, storage_plugin=plugin)
    serialize = store.serialize_ros1 if version == 1 else store.serialize_cdr

    def header(nanoseconds: int):
        stamp = types["builtin_interfaces/msg/Time"](sec=1608946479, nanosec=nanoseconds)
        sequence = {"seq": 0} if version == 1 else {}
        return types["std_msgs/msg/Header"](**sequence, stamp=stamp, frame_id="camera")

    def image(pixels: np.ndarray, nanoseconds: int):
        if encoding in ("jpeg", "png"):
            data = cv2.imencode(f".{encoding}", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))[1].ravel()
            return types["sensor_msgs/msg/CompressedImage"](header=header(nanoseconds), format=encoding, data=data)
        values = {
            "rgb8": pixels,
            "bgr8": pixels[..., ::-1],
            "mono8": pixels[..., 0],
            "bayer_rggb8": pixels[..., 0],
            "yuv422": pixels,
        }
        values["mono16"] = pixels[..., 0].astype(np.uint16) * 200
        rows = np.ascontiguousarray(values[encoding]).view(np.uint8).reshape(SIZE[0], -1)
        rows = np.pad(rows, ((0, 0), (0, 5)))  # rows may be longer than their pixels
        about = {"height": SIZE[0], "width": SIZE[1], "encoding": encoding, "is_bigendian": 0, "step": rows.shape[1]}
        return types["sensor_msgs/msg/Image"](header=header(nanoseconds), **about, data=rows.ravel())

    def camera(shift: float):
        region = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        k = np.array([30.0, 0, 16, 0, 30, 12, 0, 0, 1])
        p = np.array([30.0, 0, 16, shift, 0, 30, 12, 0, 0, 0, 1, 0])
        values = {"d": np.array([distortion] * 5), "k": k, "r": np.eye(3).ravel(), "p": p}
        values = {name.upper(): value for name, value in values.items()} if version == 1 else values
        about = {"height": SIZE[0], "width": SIZE[1], "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}
        return types["sensor_msgs/msg/CameraInfo"](header=header(0), **about, **values, roi=region)

    def pose(metres: float, nanoseconds: int):
        geometry = {name: types[f"geometry_msgs/msg/{name}"] for name in ("Point", "Quaternion", "Pose", "Vector3", "Twist")}
        place = geometry["Pose"](geometry["Point"](x=metres, y=0.0, z=0.0), geometry["Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0))
        still = geometry["Twist"](geometry["Vector3"](x=0.0, y=0.0, z=0.0), geometry["Vector3"](x=0.0, y=0.0, z=0.0))
        covariance = np.zeros(36)
        with_pose = types["geometry_msgs/msg/PoseWithCovariance"](pose=place, covariance=covariance)
        with_twist = types["geometry_msgs/msg/TwistWithCovariance"](twist=still, covariance=covariance)
        named = {"header": header(nanoseconds), "child_frame_id": "base"}
        return types["nav_msgs/msg/Odometry"](**named, pose=with_pose, twist=with_twist)

    kind = "sensor_msgs/msg/CompressedImage" if encoding in ("jpeg", "png") else "sensor_msgs/msg/Image"
    with writer:
        names = {topic: kind for topic in topics}
        infos = [topic.rpartition("/image")[0] + "/camera_info" for topic in topics]
        names |= {name: "sensor_msgs/msg/CameraInfo" for name in infos} | {"/odom": "nav_msgs/msg/Odometry"}
        connections = {name: writer.add_connection(name, of, typestore=store) for name, of in names.items()}

        def put(topic: str, message, nanoseconds: int) -> None:
            writer.write(connections[topic], 1608946479 * 10**9 + nanoseconds, serialize(message, names[topic]))

        for name, shift in zip(infos, (0.0, -3.0)):
            put(name, camera(shift), 0)
        for tenth in range(10):
            put("/odom", pose(0.05 * tenth, tenth * 100_000_000), tenth * 100_000_000)
        for frame in range(FRAMES):
            for side, topic in enumerate(topics):
                moment = 150_000_000 + frame * 200_000_000 + side * 2_000_000
                put(topic, image(PLAIN[frame, side], moment), moment)
    return path


@pytest.fixture(autouse=True)
def _rosbags(request):
    if "without" not in request.node.name:
        pytest.importorskip("rosbags")


@pytest.mark.parametrize(("name", "version", "storage"), [("row.bag", 1, ""), ("row", 2, "mcap"), ("row", 2, "sqlite3")])
def test_a_recording_is_a_plot(tmp_path, name, version, storage):
    path = write(tmp_path / name, version, storage=storage)
    assert is_recording(path)
    for found in {path, *path.glob("*.mcap"), *path.glob("*.db3")} if path.is_dir() else {path}:
        folder = extract_recording(found, tmp_path / "out")
        (plot,) = find_plots(folder)
        assert plot.name == found.stem and len(plot.pairs) == FRAMES
        for pair, both in zip(plot.pairs, PLAIN):
            assert pair.left is not None and pair.right is not None
            np.testing.assert_array_equal(read_image(pair.left), both[0])
            np.testing.assert_array_equal(read_image(pair.right), both[1])
        calibration = find_calibration(folder)
        assert calibration is not None
        assert read_calibration(calibration).baseline == pytest.approx(0.1)
        driven = read_odometry(plot)
        assert driven is not None
        np.testing.assert_allclose(list(driven.values()), [0.075, 0.175, 0.275], atol=1e-4)
        before = (folder / "left.yaml").stat().st_mtime_ns
        assert extract_recording(found, tmp_path / "out") == folder and (folder / "left.yaml").stat().st_mtime_ns == before


@pytest.mark.parametrize("encoding", ["bgr8", "mono8", "mono16", "png", "jpeg", "bayer_rggb8"])
def test_images_of_every_encoding(tmp_path, encoding):
    folder = extract_recording(write(tmp_path / "row.bag", 1, encoding), tmp_path)
    image = read_image(next(iter(sorted((folder / "left").iterdir()))))
    wanted = {"mono8": PLAIN[0, 0, ..., 0], "mono16": PLAIN[0, 0, ..., 0].astype(np.uint16) * 200}.get(encoding, PLAIN[0, 0])
    if encoding in ("jpeg", "bayer_rggb8"):
        assert image.shape == (*SIZE, 3) and image.std() > 10
    else:
        np.testing.assert_array_equal(image, wanted)


def test_raw_images_and_several_pairs_are_reported(tmp_path):
    raw = ("/left/image_raw", "/right/image_raw")
    with pytest.raises(RequestError, match="/left/image_raw has raw images, which its camera_info says are distorted"):
        extract_recording(write(tmp_path / "raw.bag", 1, topics=raw, distortion=0.1), tmp_path)
    assert extract_recording(write(tmp_path / "straight.bag", 1, topics=raw), tmp_path).is_dir()
    four = ("/a/left/image_rect", "/a/right/image_rect", "/b/left/image_rect", "/b/right/image_rect")
    with pytest.raises(
        RequestError, match="several pairs of images: say --left TOPIC --right TOPIC; images are on /a/left/image"
    ):
        extract_recording(_two_rigs(tmp_path / "two.bag", four), tmp_path)
    assert extract_recording(tmp_path / "two.bag", tmp_path, Topics(*four[2:])).is_dir()
    with pytest.raises(RequestError, match="has no images on /none"):
        extract_recording(tmp_path / "two.bag", tmp_path, Topics("/none", four[1]))
    mono = ("/camera/image_rect", "/other/image_rect")
    with pytest.raises(RequestError, match="no pair of left and right images"):
        extract_recording(write(tmp_path / "mono.bag", 1, topics=mono), tmp_path)


def _two_rigs(path: Path, topics: tuple[str, ...]) -> Path:
    global PLAIN
    both, PLAIN = PLAIN, np.concatenate([PLAIN, PLAIN], axis=1)
    try:
        return write(path, 1, topics=topics)
    finally:
        PLAIN = both


def test_encodings_that_cannot_be_read_are_reported(tmp_path):
    with pytest.raises(RequestError, match="images are encoded as yuv422; mono8"):
        extract_recording(write(tmp_path / "row.bag", 1, "yuv422"), tmp_path)


@pytest.mark.parametrize("kind", ["cut", "corrupted", "empty", "text"])
@pytest.mark.parametrize("name", ["row.bag", "row.mcap", "row.db3"])
def test_files_that_are_not_recordings_are_reported_in_one_line(tmp_path, name, kind):
    whole = b"hello " * 50
    if name == "row.bag" and kind in ("cut", "corrupted"):
        whole = write(tmp_path / "good.bag", 1).read_bytes()
    data = {
        "cut": whole[: len(whole) // 2],
        "corrupted": whole[:4150] + b"\xff" * 400 + whole[4550:],
        "empty": b"",
        "text": b"hello",
    }
    (tmp_path / name).write_bytes(data[kind])
    with pytest.raises(RequestError) as error:
        extract_recording(tmp_path / name, tmp_path / "out")
    assert len(str(error.value).splitlines()) == 1 and name in str(error.value)
