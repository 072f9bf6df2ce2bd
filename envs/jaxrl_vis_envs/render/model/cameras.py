"""Camera of a scene (one of the model's, or a free camera), its lens and its mount. NumPy only."""

import numbers
from typing import Any

import mujoco
import numpy as np

from jaxrl_vis_envs.render.mounts import Mount

FREE_CAMERA = -1
"""Index of the free camera, which is not part of the model, as in MuJoCo."""

Camera = str | int | mujoco.MjvCamera | None
"""A camera's name or index; None, -1 or an `MjvCamera` for a free one."""


def find_camera(mj_model: mujoco.MjModel, camera: Camera) -> int:
    """Return the index of a camera, `FREE_CAMERA` for a free camera.

    Raises:
        ValueError: There is no such camera; the message lists those of the model.
    """
    if isinstance(camera, mujoco.MjvCamera):
        view: Any = camera
        if view.type == mujoco.mjtCamera.mjCAMERA_FIXED:
            return find_camera(mj_model, int(view.fixedcamid))
        if view.type != mujoco.mjtCamera.mjCAMERA_FREE:
            raise ValueError("an MjvCamera must be free or fixed: define a camera that tracks a body in the model")
        return FREE_CAMERA
    if camera is None:
        return FREE_CAMERA
    if isinstance(camera, str):
        camera_id = mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
    elif isinstance(camera, numbers.Integral) and not isinstance(camera, bool):
        camera_id = int(camera)
        if camera_id == FREE_CAMERA:
            return FREE_CAMERA
    else:
        kind = type(camera).__name__
        raise ValueError(f"a scene has one camera: a name, an index, an MjvCamera, or None for a free one; got a {kind}")
    if not 0 <= camera_id < mj_model.ncam:
        names = ", ".join(repr(mj_model.camera(index).name) for index in range(mj_model.ncam)) or "none"
        raise ValueError(f"there is no camera {camera!r} in the model; its cameras are: {names}; or None for a free one")
    return camera_id


def free_camera(mj_model: mujoco.MjModel, camera: Camera) -> mujoco.MjvCamera:
    """Return ``camera`` if it is an `MjvCamera`, else MuJoCo's default free camera, which looks at the centre of the whole
    model.

    The default is that of `mjv_defaultFreeCamera`: 1.5 times ``stat.extent`` away from ``stat.center``, with the azimuth, the
    elevation and the projection of ``vis.global``.
    """
    if isinstance(camera, mujoco.MjvCamera):
        return camera
    default = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(mj_model, default)
    return default


def free_camera_pose(camera: mujoco.MjvCamera) -> tuple[np.ndarray, np.ndarray]:
    """Return the position of a free camera, [3] m, and its rotation vector, [3] rad, both in the world's frame."""
    azimuth, elevation = np.deg2rad([camera.azimuth, camera.elevation])
    ahead = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    quaternion, turn = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, np.stack([right, np.cross(right, ahead), -ahead], axis=1).reshape(-1))
    mujoco.mju_quat2Vel(turn, quaternion, 1.0)
    return np.array(camera.lookat) - camera.distance * ahead, turn


def projection(mj_model: mujoco.MjModel, camera_id: int, camera: Camera) -> str:
    """Return the projection of a camera, as in `Scene`."""
    if camera_id == FREE_CAMERA:
        return "orthographic" if free_camera(mj_model, camera).orthographic else "perspective"
    if mj_model.cam_projection[camera_id] == mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC:
        return "orthographic"
    return "intrinsic" if np.all(mj_model.cam_sensorsize[camera_id] > 0) else "perspective"


def camera_parameters(mj_model: mujoco.MjModel, camera_id: int, camera: Camera) -> dict[str, Any]:
    """Return the camera's arrays, the leaves of a scene. Keys as in `Scene`."""
    if camera_id == FREE_CAMERA:
        position, turn = free_camera_pose(free_camera(mj_model, camera))
        lens = dict(fovy=mj_model.vis.global_.fovy, focal=np.zeros(2), principal=np.zeros(2), sensor=np.zeros(2))
        lens |= dict(camera_position=np.zeros(3), camera_axes=np.eye(3), camera_shift=position, camera_turn=turn)
    else:
        intrinsic = mj_model.cam_intrinsic[camera_id]
        position, axes = mj_model.cam_pos[camera_id], np.zeros(9)
        mujoco.mju_quat2Mat(axes, mj_model.cam_quat[camera_id])
        # A tracking camera keeps its orientation and its offset from the initial pose.
        if mj_model.cam_mode[camera_id] == mujoco.mjtCamLight.mjCAMLIGHT_TRACK:
            position, axes = mj_model.cam_pos0[camera_id], mj_model.cam_mat0[camera_id]
        elif mj_model.cam_mode[camera_id] == mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM:
            position, axes = mj_model.cam_poscom0[camera_id], mj_model.cam_mat0[camera_id]
        lens = dict(
            fovy=mj_model.cam_fovy[camera_id],
            focal=intrinsic[:2],
            principal=intrinsic[2:],
            sensor=mj_model.cam_sensorsize[camera_id],
            camera_position=position,
            camera_axes=axes.reshape(3, 3),
            camera_shift=np.zeros(3),
            camera_turn=np.zeros(3),
        )
    return dict(
        **lens,
        znear=mj_model.vis.map.znear * mj_model.stat.extent,
        zfar=mj_model.vis.map.zfar * mj_model.stat.extent,
    )


def camera_mount(mj_model: mujoco.MjModel, camera_id: int) -> Mount:
    """Return the mount of a camera; a free camera is fixed to the world."""
    if camera_id == FREE_CAMERA:
        return Mount(int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED), 0, -1)
    fields = (mj_model.cam_mode, mj_model.cam_bodyid, mj_model.cam_targetbodyid)
    return Mount(*(int(field[camera_id]) for field in fields))
