"""Calibrations of kalibr: camchain.yaml, with unrectified cameras."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.calibrations.cameras import UnrectifiedPair, camera_matrix, parse_array, read_size

_MODELS = {"radtan": False, "plumb_bob": False, "equidistant": True, "none": False}


def is_chain(store: dict[str, Any]) -> bool:
    """Return True if parsed YAML is a kalibr camera chain."""
    return isinstance(store.get("cam0"), dict) and "intrinsics" in store["cam0"]


def read_chain(store: dict[str, Any], path: Path) -> UnrectifiedPair:
    """Convert the first two cameras of a chain; lengths are in metres.

    Args:
        store: Contents of the file.
        path: The file, for messages.

    Raises:
        RequestError: There are no two pinhole cameras of the same size and distortion model, or a parameter is missing.
    """
    cameras = [store.get(name) for name in ("cam0", "cam1")]
    if not all(isinstance(camera, dict) for camera in cameras):
        raise RequestError(f"{path} holds one camera: calibrate the pair, with both topics, so that it holds cam0 and cam1")
    matrices, distortions, sizes, fisheye = [], [], [], []
    for name, camera in zip(("cam0", "cam1"), cameras):
        assert isinstance(camera, dict)
        model, lens = camera.get("camera_model", "pinhole"), camera.get("distortion_model", "none")
        if model != "pinhole" or lens not in _MODELS:
            raise RequestError(
                f"{path}: {name} has the model {str(model)[:30]}-{str(lens)[:30]}: calibrate with pinhole-radtan"
            )
        values, bent = parse_array(camera.get("intrinsics"), 4), parse_array(camera.get("distortion_coeffs"), 4)
        if values is None or (bent is None and lens != "none"):
            raise RequestError(f"{path}: {name} needs 4 intrinsics and 4 distortion_coeffs")
        matrices.append(camera_matrix(*values))
        distortions.append(np.zeros(4) if bent is None else bent)
        sizes.append(read_size(camera, path))
        fisheye.append(_MODELS[lens])
    assert isinstance(cameras[1], dict)
    pose = parse_array(cameras[1].get("T_cn_cnm1"), 16)
    if pose is None:
        raise RequestError(f"{path}: cam1 needs T_cn_cnm1, 4 x 4 numbers: calibrate both cameras together")
    if sizes[0] != sizes[1] or fisheye[0] != fisheye[1]:
        raise RequestError(f"{path}: cam0 and cam1 differ in resolution or in distortion model: calibrate them alike")
    pose = pose.reshape(4, 4)
    both = np.stack(matrices), np.stack(distortions)
    return UnrectifiedPair(*both, fisheye[0], pose[:3, :3], pose[:3, 3], sizes[0], "m", "kalibr")
