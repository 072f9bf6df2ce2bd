"""Extraction of ROS recordings to the folder of a plot: bags of ROS 1 (.bag) and ROS 2 (metadata.yaml, .mcap, .db3).

    left/1608946479.473160331.png   images of both cameras, named by timestamp in s
    left.yaml, right.yaml           first camera_info message of each camera
    odometry.csv                    positions from nav_msgs/Odometry, or else from sensor_msgs/NavSatFix

Requires the package rosbags (extra ``bags``).
"""

import dataclasses
import importlib.util
import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.host.provenance import install_command
from jaxrl_vis.stalks.phenotyping.io.image_headers import PNG
from jaxrl_vis.stalks.phenotyping.io.images import MAX_PIXELS, write_image
from jaxrl_vis.stalks.phenotyping.io.naming.sides import partner_names

_SUFFIXES = (".bag", ".mcap", ".db3")
_IMAGE = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_CAMERA = "sensor_msgs/msg/CameraInfo"
_ODOMETRY = ("nav_msgs/msg/Odometry", "sensor_msgs/msg/NavSatFix")
_CHANNELS = {"mono8": 1, "8UC1": 1, "mono16": 1, "16UC1": 1, "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "8UC3": 3}
"""Number of channels by image encoding."""
_MOSAICS = {
    "bayer_rggb8": cv2.COLOR_BayerRGGB2RGB,
    "bayer_bggr8": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2RGB,
    "bayer_grbg8": cv2.COLOR_BayerGRBG2RGB,
}
_MAX_LISTED = 8


@dataclasses.dataclass(frozen=True)
class Topics:
    """Topics of a stereo pair of images.

    Attributes:
        left, right: Names of the topics, such as /stereo/left/image_rect.
    """

    left: str
    right: str


def is_recording(path: Path) -> bool:
    """Return True if a path is a recording: a file with the suffix of a bag, or the folder of a ROS 2 bag."""
    if path.is_file():
        return path.suffix.lower() in _SUFFIXES
    about = path / "metadata.yaml"
    return about.is_file() and about.open("rb").read(1000).lstrip().startswith(b"rosbag2_bagfile_information")


def extract_recording(path: Path, out: Path, topics: Topics | None = None) -> Path:
    """Extract the stereo images, calibrations and odometry of a recording to the folder of a plot.

    A folder that is complete, of the same recording and topics, is left alone; any other folder of this name is replaced.

    Args:
        path: The recording.
        out: Parent of the plot's folder.
        topics: Topics of the images; None if the recording has only one stereo pair.

    Returns:
        The plot's folder, named after the recording.

    Raises:
        RequestError: rosbags is not installed or cannot read the recording, or there is no unique pair of rectified images.
        OSError: The folder cannot be written.
    """
    if importlib.util.find_spec("rosbags") is None:
        raise RequestError(f"{path} is a recording, and to read it needs rosbags: {install_command('bags')}")
    folder = out / (path.stem if path.is_file() else path.name)
    stat = path.stat()
    origin = {"recording": path.name, "bytes": stat.st_size, "mtime_ns": stat.st_mtime_ns}
    origin |= {"left": topics and topics.left, "right": topics and topics.right}
    done = folder / "recording.json"
    if done.is_file() and done.read_text() == json.dumps(origin):
        return folder
    if folder.exists():
        shutil.rmtree(folder)
    try:
        _write_all(path, folder, topics)
    except (RequestError, OSError, MemoryError):
        raise
    except Exception as error:  # the readers of rosbags raise errors of many types
        words = " ".join(str(error).split())[:200] or type(error).__name__
        raise RequestError(f"{path} cannot be read as a recording of ROS: {words}") from error
    write_atomically(done, json.dumps(origin))
    return folder


def _write_all(path: Path, folder: Path, topics: Topics | None) -> None:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        kinds: dict[str, str] = {connection.topic: connection.msgtype for connection in reader.connections}
        pair = topics or _find_topics(kinds, path)
        for topic in (pair.left, pair.right):
            if kinds.get(topic) not in _IMAGE:
                raise RequestError(f"{path} has no images on {topic}: {_format_topics(kinds)}")

        def messages(topic: str) -> Iterator[Any]:
            wanted = [connection for connection in reader.connections if connection.topic == topic]
            for connection, _, raw in reader.messages(connections=wanted):
                yield reader.deserialize(raw, connection.msgtype)

        for side, topic in (("left", pair.left), ("right", pair.right)):
            _write_camera(folder / f"{side}.yaml", topic, kinds, messages)
        for side, topic in (("left", pair.left), ("right", pair.right)):
            for message in messages(topic):
                _write_message(folder / side, message, f"{path}: {topic}")
        _write_odometry(folder / "odometry.csv", kinds, messages)


def _find_topics(message_types: dict[str, str], path: Path) -> Topics:
    """Find the topics of the left and right images.

    Args:
        message_types: Message type by topic.
        path: The recording, for messages.

    Raises:
        RequestError: There is no pair of topics, or several.
    """
    images = [topic for topic, kind in message_types.items() if kind in _IMAGE and "depth" not in topic]
    pairs = {
        Topics(topic, other) for topic in images for side, other in partner_names(topic) if side == "left" and other in images
    }
    for word in ("rect", "compressed"):
        # Prefer rectified to raw images, then uncompressed to compressed ones.
        best = {pair for pair in pairs if (word in pair.left) == (word == "rect")}
        pairs = best or pairs
    if len(pairs) != 1:
        what = "several pairs of images" if pairs else "no pair of left and right images"
        raise RequestError(f"{path} has {what}: say --left TOPIC --right TOPIC; {_format_topics(message_types)}")
    return pairs.pop()


def _format_topics(message_types: dict[str, str]) -> str:
    images = sorted(topic for topic, kind in message_types.items() if kind in _IMAGE)
    others = f" and {len(images) - _MAX_LISTED} others" if len(images) > _MAX_LISTED else ""
    return f"images are on {', '.join(images[:_MAX_LISTED])}{others}" if images else "no topic has images"


def _write_camera(path: Path, topic: str, message_types: dict[str, str], messages: Any) -> None:
    """Write the first camera_info message that belongs to an image topic, if there is one.

    Raises:
        RequestError: The images are not rectified.
        OSError: The file cannot be written.
    """
    parts = topic.split("/")
    named = ["/".join([*parts[:length], "camera_info"]) for length in range(len(parts) - 1, 0, -1)]
    info = next((name for name in named if message_types.get(name) == _CAMERA), None)
    message = None if info is None else next(messages(info), None)
    if message is None:
        return
    distortion, matrix, projection = (
        [float(value) for value in _field_of_either_case(message, name)] for name in ("D", "K", "P")
    )
    as_built = any(abs(value) > 1e-9 for value in distortion) or not np.allclose(matrix[:3], projection[:3], rtol=1e-6)
    if "rect" not in topic and as_built:
        raise RequestError(f"{topic} has raw images, which its camera_info says are distorted: record or name rectified ones")
    roi = {name: int(getattr(message.roi, name)) for name in ("x_offset", "y_offset", "height", "width")}
    values = {"header": {}, "height": int(message.height), "width": int(message.width), "P": projection, "roi": roi}
    values |= {name: int(getattr(message, name)) for name in ("binning_x", "binning_y")}
    write_atomically(path, json.dumps(values))


def _field_of_either_case(message: Any, name: str) -> Any:
    """Return a field whose name is upper case in ROS 1 and lower case in ROS 2."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.lower())


def _stamp(message: Any) -> tuple[int, int]:
    stamp = message.header.stamp
    return int(stamp.sec), int(stamp.nanosec)


def _write_message(folder: Path, message: Any, source: str) -> None:
    seconds, nanoseconds = _stamp(message)
    name = f"{seconds}.{nanoseconds:09d}"
    if hasattr(message, "format"):
        data = bytes(message.data)
        suffix = ".png" if data.startswith(PNG) else ".jpg" if data.startswith(b"\xff\xd8") else None
        if suffix is None:
            raise RequestError(f"{source}: images are compressed as {str(message.format)[:40]}, neither JPEG nor PNG")
        write_atomically(folder / f"{name}{suffix}", data)
        return
    folder.mkdir(parents=True, exist_ok=True)
    write_image(folder / f"{name}.png", _decode_pixels(message, source))


def _decode_pixels(message: Any, source: str) -> np.ndarray:
    """Decode an Image message to [H, W, 3] (RGB) or [H, W], uint8 or uint16.

    Args:
        message: The message.
        source: Recording and topic, for messages.

    Raises:
        RequestError: The encoding is not supported, or the data do not match the size.
    """
    encoding, height, width, step = str(message.encoding), int(message.height), int(message.width), int(message.step)
    channels, deep = _CHANNELS.get(encoding, 1), "16" in encoding
    if encoding not in _CHANNELS and encoding not in _MOSAICS:
        raise RequestError(f"{source}: images are encoded as {encoding[:40]}; {', '.join((*_CHANNELS, *_MOSAICS))} can be read")
    row_bytes = width * channels * (2 if deep else 1)
    data = np.asarray(message.data, np.uint8)
    if not 0 < width * height <= MAX_PIXELS or step < row_bytes or data.size < step * height:
        raise RequestError(f"{source}: an image of {width} x {height} ({encoding}) has {data.size} bytes, {step} a line")
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row_bytes])
    if deep:
        return rows.view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
    if encoding in _MOSAICS:
        return cv2.cvtColor(rows, _MOSAICS[encoding])
    pixels = rows.reshape(height, width, channels)
    colours = pixels[..., 2::-1] if encoding.startswith(("bgr", "8UC3")) else pixels[..., :3]
    return rows if channels == 1 else np.ascontiguousarray(colours)


def _write_odometry(path: Path, message_types: dict[str, str], messages: Any) -> None:
    """Write the robot's finite positions with timestamps in ns.

    They are read from the first Odometry topic, or else from the first NavSatFix topic (shortest name first); nothing is
    written if neither has any.
    """
    for kind, columns in zip(_ODOMETRY, ("x_m,y_m,z_m", "latitude,longitude")):
        topics = sorted((topic for topic, of in message_types.items() if of == kind), key=lambda topic: (len(topic), topic))
        if not topics:
            continue
        lines = [f"time_ns,{columns}"]
        for message in messages(topics[0]):
            seconds, nanoseconds = _stamp(message)
            place = message.pose.pose.position if kind == _ODOMETRY[0] else message
            values = [float(getattr(place, name.removesuffix("_m"))) for name in columns.split(",")]
            if all(map(math.isfinite, values)):
                lines.append(",".join([str(seconds * 10**9 + nanoseconds), *map(repr, values)]))
        if len(lines) > 1:
            write_atomically(path, "\n".join(lines) + "\n")
            return
