"""Three-dimensional scene of a MuJoCo model in a browser (viser): the robot, and a translucent copy at its goal."""

from typing import Any

import mujoco
import numpy as np
import trimesh

GOAL_COLOUR = (62, 207, 142)
_GOAL_OPACITY = 0.35
_VISIBLE_GROUPS = 3  # as in MuJoCo's viewers, geoms of groups 3 and up are for collisions
_FLOOR_DROP = 0.002  # vertical offset of planes, m, against flickering below other shapes
_FLAT = (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_MESH)
_ENDLESS = 10.0  # half-size of infinite planes, m
_ELEVATION, _TURN = np.radians(22.0), np.radians(35.0)  # initial view: above the horizon, and from the task's camera


def geom_surface(mj_model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Return vertices [V, 3] float32 (m, frame of the geom) and triangles [F, 3] of a geom; None if it has no surface."""
    size = mj_model.geom_size[geom].astype(float)
    match mujoco.mjtGeom(mj_model.geom_type[geom]):
        case mujoco.mjtGeom.mjGEOM_BOX:
            mesh = trimesh.creation.box(2 * size)
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            mesh = trimesh.creation.icosphere(3, size[0])
        case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            mesh = trimesh.creation.icosphere(3, 1.0)
            mesh.apply_scale(size)
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            mesh = trimesh.creation.cylinder(size[0], 2 * size[1], 40)
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            mesh = trimesh.creation.capsule(2 * size[1], size[0], (24, 24))
            mesh.apply_translation((0, 0, -mesh.bounds.mean(axis=0)[2]))
        case mujoco.mjtGeom.mjGEOM_MESH:
            which = mj_model.geom_dataid[geom]
            vertex, face = mj_model.mesh_vertadr[which], mj_model.mesh_faceadr[which]
            vertices = mj_model.mesh_vert[vertex : vertex + mj_model.mesh_vertnum[which]]
            return vertices.astype(np.float32), mj_model.mesh_face[face : face + mj_model.mesh_facenum[which]]
        case _:
            return None
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces)


def geom_colour(mj_model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return the colour of a geom, RGBA [4] in [0, 1]."""
    material = mj_model.geom_matid[geom]
    return mj_model.geom_rgba[geom] if material < 0 else mj_model.mat_rgba[material]


def visible_geoms(mj_model: mujoco.MjModel, body: int) -> list[int]:
    """List the ids of the visible geoms of a body: not of a collision group, and not fully transparent."""
    first, count = mj_model.body_geomadr[body], mj_model.body_geomnum[body]
    return [
        geom
        for geom in range(first, first + count)
        if mj_model.geom_group[geom] < _VISIBLE_GROUPS and geom_colour(mj_model, geom)[3] > 0
    ]


def moving_bodies(mj_model: mujoco.MjModel) -> list[int]:
    """List the ids of the movable bodies, mocap bodies excluded, that have visible geoms."""
    moved = (mj_model.body_weldid != 0) & (mj_model.body_mocapid < 0)
    return [body for body in range(mj_model.nbody) if moved[body] and visible_geoms(mj_model, body)]


class LiveScene:
    """Bodies of a model as nodes of a viser scene.

    Args:
        server: `viser.ViserServer`.
        mj_model: The model.
        xpos, xquat: Initial poses of all bodies, [B, 3] (m) and [B, 4], scalar first.
        camera: Name of the task's camera, which determines the initial view.
    """

    def __init__(self, server: Any, mj_model: mujoco.MjModel, xpos: np.ndarray, xquat: np.ndarray, camera: str):
        self._scene, self._model, self._moving = server.scene, mj_model, moving_bodies(mj_model)
        server.scene.set_up_direction("+z")
        server.scene.configure_default_lights(cast_shadow=False)
        for body in range(mj_model.nbody):
            if body not in self._moving:
                self._add_body(f"/still/{body}", body, xpos[body], xquat[body])
        self._robot = {body: self._add_body(f"/robot/{body}", body, xpos[body], xquat[body]) for body in self._moving}
        self._goal = {body: self._add_body(f"/goal/{body}", body, xpos[body], xquat[body], True) for body in self._moving}
        self._set_view(server, xpos, camera)

    def show(self, xpos: np.ndarray, xquat: np.ndarray, is_goal: bool = False) -> None:
        """Move the robot, or with ``is_goal`` its copy at the goal, to body positions [B, 3] (m) and quaternions [B, 4]."""
        for body, frame in (self._goal if is_goal else self._robot).items():
            frame.position, frame.wxyz = xpos[body], xquat[body]

    def _add_body(self, name: str, body: int, position: np.ndarray, rotation: np.ndarray, is_goal: bool = False) -> Any:
        frame = self._scene.add_frame(name, show_axes=False, position=position, wxyz=rotation)
        for geom in visible_geoms(self._model, body):
            if self._model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
                self._add_plane(f"{name}/{geom}", geom)
                continue
            mesh = geom_surface(self._model, geom)
            if mesh is None:
                continue
            rgba = geom_colour(self._model, geom)
            opacity = _GOAL_OPACITY if is_goal else float(rgba[3])
            self._scene.add_mesh_simple(
                f"{name}/{geom}",
                *mesh,
                color=GOAL_COLOUR if is_goal else tuple(int(255 * part) for part in rgba[:3]),
                opacity=opacity if opacity < 1 else None,
                flat_shading=mujoco.mjtGeom(self._model.geom_type[geom]) in _FLAT,
                position=self._model.geom_pos[geom],
                wxyz=self._model.geom_quat[geom],
            )
        return frame

    def _add_plane(self, name: str, geom: int) -> None:
        """Add a plane as a light grid, regardless of its colour."""
        width, height = (2 * float(side) if side > 0 else 2 * _ENDLESS for side in self._model.geom_size[geom][:2])
        self._scene.add_grid(
            name,
            width,
            height,
            cell_size=0.25,
            cell_color=(222, 224, 228),
            section_color=(198, 202, 208),
            plane_color=(244, 245, 247),
            plane_opacity=1.0,
            position=self._model.geom_pos[geom] - (0, 0, _FLOOR_DROP),
            wxyz=self._model.geom_quat[geom],
        )

    def _set_view(self, server: Any, xpos: np.ndarray, camera: str) -> None:
        """Set the initial view beside that of the task's camera, such that the moving bodies fill it."""
        mj_data = mujoco.MjData(self._model)
        mujoco.mj_kinematics(self._model, mj_data)
        mujoco.mj_camlight(self._model, mj_data)
        towards = -mj_data.cam_xmat[self._model.camera(camera).id].reshape(3, 3)[:, 2]
        # If the camera looks straight down, its up axis replaces the viewing direction.
        level = towards if abs(towards[2]) < 0.9 else mj_data.cam_xmat[self._model.camera(camera).id].reshape(3, 3)[:, 1]
        azimuth = np.arctan2(-level[1], -level[0]) + _TURN
        centre = xpos[self._moving].mean(axis=0)
        reach = max(float(np.linalg.norm(xpos[self._moving] - centre, axis=1).max()), 0.3 * float(self._model.stat.extent) / 3)
        away = np.array([np.cos(_ELEVATION) * np.cos(azimuth), np.cos(_ELEVATION) * np.sin(azimuth), np.sin(_ELEVATION)])
        centre = centre - (0.0, 0.0, 0.2 * reach)  # because the view is from above
        view = server.initial_camera
        view.position, view.look_at, view.up = centre + 3.6 * reach * away, centre, (0.0, 0.0, 1.0)
