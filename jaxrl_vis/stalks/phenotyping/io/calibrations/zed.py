"""Calibrations of Stereolabs ZED cameras: SN1234.conf, with unrectified cameras at several image sizes, in millimetres."""

import configparser
import math
from pathlib import Path

import cv2
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.calibrations.cameras import Size, UnrectifiedPair, camera_matrix

_SIZES: dict[str, Size] = {
    "2K": (2208, 1242),
    "FHD": (1920, 1080),
    "FHD1200": (1920, 1200),
    "HD": (1280, 720),
    "QHD": (3200, 1800),
    "4K": (3840, 2160),
    "SVGA": (960, 600),
    "VGA": (672, 376),
}


def is_settings(text: str) -> bool:
    """Return True if a text is a calibration of a ZED camera."""
    return "[LEFT_CAM_" in text and "[STEREO]" in text


def read_settings(text: str, path: Path, size: Size | None) -> UnrectifiedPair:
    """Parse the cameras at one image size.

    Args:
        text: Contents of the file.
        path: The file, for messages.
        size: Width and height of the images; may be None if the file holds only one size.

    Raises:
        RequestError: The size is not in the file, or a value is missing or invalid.
    """
    settings = configparser.ConfigParser(interpolation=None, strict=False)
    try:
        settings.read_string(text)
        named = {section.removeprefix("LEFT_CAM_") for section in settings.sections() if section.startswith("LEFT_CAM_")}
        modes = [mode for mode in _SIZES if mode in named and f"RIGHT_CAM_{mode}" in settings]
        fitting = [mode for mode in modes if size in (None, _SIZES[mode])]
        if len(fitting) != 1:
            there = ", ".join(f"{_SIZES[mode][0]} x {_SIZES[mode][1]}" for mode in modes) or "no size that is known"
            your_images = "your images" if size is None else f"images of {size[0]} x {size[1]}"
            raise RequestError(f"{path} is of a ZED camera, for {there}: it does not say which of them is for {your_images}")
        mode = fitting[0]
        stereo, cameras = settings["STEREO"], [settings[f"{side}_CAM_{mode}"] for side in ("LEFT", "RIGHT")]
        matrices = [camera_matrix(*(float(camera[name]) for name in ("fx", "fy", "cx", "cy"))) for camera in cameras]
        bent = [[float(camera.get(name, "0")) for name in ("k1", "k2", "p1", "p2", "k3")] for camera in cameras]
        turns = [float(stereo.get(f"{name}_{mode}", "0")) for name in ("RX", "CV", "RZ")]
        baseline = float(stereo["Baseline"])
        shift = [-baseline, float(stereo.get("TY", "0")), float(stereo.get("TZ", "0"))]
        values = [*np.ravel(matrices), *np.ravel(bent), *turns, *shift]
    except RequestError:
        raise
    except (configparser.Error, KeyError, ValueError) as error:
        reason = " ".join(str(error).split())[:100]
        raise RequestError(f"{path} is of a ZED camera, but one of its values is missing or not a number ({reason})") from error
    if not all(map(math.isfinite, values)) or max(map(abs, values)) > 1e9:
        raise RequestError(f"{path} is of a ZED camera, but not all of its numbers are finite")
    rotation = cv2.Rodrigues(np.array(turns))[0]
    return UnrectifiedPair(
        np.stack(matrices), np.array(bent), False, rotation, np.array(shift), _SIZES[mode], "mm", "a ZED camera"
    )
