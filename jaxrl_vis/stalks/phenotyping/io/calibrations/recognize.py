"""Detection of the format of calibrations from their contents, and of the files that belong together."""

from pathlib import Path
from typing import Any

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.calibrations import kalibr, kitti, middlebury, opencv, realsense, ros, zed
from jaxrl_vis.stalks.phenotyping.io.calibrations.cameras import RectifiedPair, UnrectifiedPair
from jaxrl_vis.stalks.phenotyping.io.file_storage import parse_storage
from jaxrl_vis.stalks.phenotyping.io.images import image_size
from jaxrl_vis.stalks.phenotyping.io.names import readable
from jaxrl_vis.stalks.phenotyping.io.naming.sides import partner_names
from jaxrl_vis_envs.documents import read_text

_MAX_BYTES = 2_000_000  # of a file
_SUFFIXES = (".yaml", ".yml", ".xml", ".json", ".txt", ".conf", ".ini")
_NAMES = ("calibration", "extrinsics", "calib", "calib_cam_to_cam", "camchain", "stereo")
"""Stems of files with the calibration of a pair, in order of preference."""
_KINDS = "OpenCV, ROS, kalibr, ZED, RealSense, Middlebury or KITTI"
_NO_PAIR = (
    "holds neither P1 and P2 of OpenCV nor one side of a ROS camera_info (left.yaml and right.yaml): "
    "calibrate the pair, and rectify its images"
)


def read_cameras(path: Path, image: Path | None = None) -> RectifiedPair | UnrectifiedPair:
    """Read the cameras of a calibration in any supported format.

    Args:
        path: A file, or a folder with one file, or with one for each camera. For the file of one camera, that of the other one
            is found by its name.
        image: A left image, which selects among several sizes or pairs in a file; None if unknown.

    Raises:
        RequestError: There is no calibration, or it cannot be read.
    """
    if path.is_dir():
        return _find_in_folder(path, image)
    cameras = _read(path, image)
    if not isinstance(cameras, list):
        return cameras
    if len(cameras) == 2:
        return ros.read_pair(cameras, [path, path], path)
    pair = find_side_files(path)
    if pair is None:
        other = next((name for _, name in partner_names(path.stem)), None)
        if other is None:
            raise RequestError(
                f"{path} is of one camera: put the files of both into a folder, as left and right, and name that"
            )
        raise RequestError(
            f"there is no calibration {path.with_stem(other)}: name a file of a pair, or a folder with left.yaml and right.yaml"
        )
    return _read_sides(pair, path, image)


def calibration_files(folder: Path) -> list[Path]:
    """Return the files of a folder whose suffix is that of a calibration, sorted."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES and path.is_file())


def find_pair_file(files: list[Path]) -> Path | None:
    """Return the file named as the calibration of a pair, or else a .conf file of ZED; None if there is none."""
    stems = {path: path.stem.lower() for path in files}
    zed_files = [path for path in files if path.suffix.lower() == ".conf"]
    for name in _NAMES:
        matches = [path for path, stem in stems.items() if stem == name or (name == "camchain" and stem.startswith(f"{name}-"))]
        if matches:
            return matches[0]
    return zed_files[0] if zed_files else None


def _find_in_folder(folder: Path, image: Path | None) -> RectifiedPair | UnrectifiedPair:
    files = calibration_files(folder)
    pairs = {pair for pair in map(find_side_files, files) if pair is not None}
    if len(pairs) == 1:
        return _read_sides(pairs.pop(), folder, image)
    if len(pairs) > 1:
        names = " and ".join(readable(left.name) for left, _ in sorted(pairs))
        raise RequestError(f"{folder} holds several pairs of calibrations, of {names}: name one of the files")
    alone = find_pair_file(files) or (files[0] if len(files) == 1 else None)
    if alone is None:
        raise RequestError(
            f"there is no calibration {folder / 'left.yaml'}: name a file of a pair, or a folder with left.yaml and right.yaml"
        )
    return read_cameras(alone, image)


def find_side_files(path: Path) -> tuple[Path, Path] | None:
    """Return the files of the left and the right camera, one of which is ``path``; None if there is no matching other file."""
    try:
        there = {file.name.lower(): file for file in path.parent.iterdir()}
    except OSError:
        return None
    for side, name in partner_names(path.stem):
        other = there.get(f"{name}{path.suffix}".lower())
        if other is not None and other.is_file() and other != path:
            return (path, other) if side == "left" else (other, path)
    return None


def _read_sides(pair: tuple[Path, Path], path: Path, image: Path | None) -> RectifiedPair | UnrectifiedPair:
    cameras: list[dict[str, Any]] = []
    for file in pair:
        parsed = _read(file, image)
        if not isinstance(parsed, list):
            return parsed  # this file holds both cameras by itself
        if len(parsed) != 1:
            raise RequestError(f"{file} {_NO_PAIR}")
        cameras += parsed
    return ros.read_pair(cameras, list(pair), path)


def _read(path: Path, image: Path | None) -> RectifiedPair | UnrectifiedPair | list[dict[str, Any]]:
    """Read a file: a pair, or the contents of one or two ROS cameras.

    Raises:
        RequestError: The file cannot be read, or is not a calibration.
    """
    try:
        text = read_text(path, _MAX_BYTES)
        if middlebury.is_middlebury(text):
            return middlebury.read_middlebury(text, path)
        if kitti.is_kitti(text):
            return kitti.read_kitti(text, path, image)
        if zed.is_settings(text):
            return zed.read_settings(text, path, _size(image))
        cameras = ros.parse_ini(text)
        if cameras is not None:
            if not 1 <= len(cameras) <= 2:
                raise RequestError(f"{path} holds {len(cameras)} cameras with a projection: name a file of one or of a pair")
            return cameras
        printed = ros.parse_printed(text) or ros.parse_csv(text)
        if printed is not None:
            return [printed]
        store = parse_storage(ros.strip_preamble(text))
    except RequestError:
        raise
    except OSError as error:
        raise RequestError(f"there is no calibration {path}: {error.strerror or error}") from error
    except ValueError as error:
        why = " ".join(str(error).split())[:200]
        raise RequestError(
            f"{path} is not a calibration: it is neither YAML nor XML as OpenCV and ROS write it ({why})"
        ) from error
    return _read_store(store, path, image)


def _read_store(store: Any, path: Path, image: Path | None) -> RectifiedPair | UnrectifiedPair | list[dict[str, Any]]:
    if isinstance(store, list):
        raise RequestError(f"{path} is not a calibration: it holds a list, not names with values such as P1 and P2")
    if not isinstance(store, dict):
        raise RequestError(f"{path} is not a calibration: it is neither YAML nor XML as {_KINDS} write it")
    if store.get("P2") is not None:
        return opencv.read_projections(store, path)
    if kalibr.is_chain(store):
        return kalibr.read_chain(store, path)
    both = ros.split_pair(store)
    if both is not None:
        return both
    if realsense.is_calibration_table(store):
        return realsense.read_table(store, path, _size(image))
    if ros.is_camera(store):
        return [store]
    raw = opencv.read_raw({**_intrinsics(path), **store}, path)
    if raw is None:
        raise RequestError(f"{path} {_NO_PAIR}")
    return raw


def _intrinsics(path: Path) -> dict[str, Any]:
    """Return the contents of intrinsics.yml beside extrinsics.yml of OpenCV's sample; empty if it does not exist."""
    intrinsics = path.with_name(path.name.replace("extrinsics", "intrinsics"))
    if intrinsics == path or not intrinsics.is_file():
        return {}
    try:
        store = parse_storage(read_text(intrinsics, _MAX_BYTES))
    except (OSError, ValueError):
        return {}
    return store if isinstance(store, dict) else {}


def _size(image: Path | None) -> tuple[int, int] | None:
    """Return the width and height of an image; None if it cannot be read, which is reported elsewhere."""
    try:
        size = None if image is None else image_size(image)
    except OSError:
        return None
    return None if size is None else (size[1], size[0])
