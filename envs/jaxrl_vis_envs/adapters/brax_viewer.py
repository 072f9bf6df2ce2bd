"""Web page that replays body trajectories in brax's interactive 3-D viewer.

The page contains the bodies and their motion. The viewer itself is downloaded from public servers when the page is opened, as
in brax's own pages: without a network, the page stays empty.
"""

import json
from typing import Any, NamedTuple

import mujoco
import numpy as np

try:
    from brax.io import html
except ImportError as error:
    raise ImportError("the 3-D viewer needs brax, which comes with jaxrl-vis, but it is missing: pip install brax") from error

# Names of the shapes that brax's viewer supports.
_SHAPES = {
    mujoco.mjtGeom.mjGEOM_PLANE: "Plane",
    mujoco.mjtGeom.mjGEOM_SPHERE: "Sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "Capsule",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "Mesh",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "Cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "Box",
    mujoco.mjtGeom.mjGEOM_MESH: "Mesh",
}
_GOAL_COLOUR = (0.24, 0.81, 0.56)
_GOAL_THICKNESS = 0.8  # relative to the robot's, so that a robot at the goal occludes it
_VISIBLE_GROUPS = 3  # as in MuJoCo's viewers, geoms of groups 3 and up are for collisions
_VIEW_SIZE = 5.0  # the viewer's camera is 10 units away, with its near plane at .1


# Without a network brax's page stays empty: explain why.
_OFFLINE = """
    <p id="offline" hidden style="font: 16px sans-serif; position: absolute; top: 40vh; width: 100%; text-align: center">
      The viewer could not be fetched: this page needs a network. The video (.gif) that play makes without --html needs none.
    </p>
    <script>
      setTimeout(() => { document.getElementById("offline").hidden = !!document.querySelector("canvas"); }, 5000);
    </script>
"""


class Poses(NamedTuple):
    """Poses of B bodies, including the world's.

    Attributes:
        positions: [..., B, 3] float32, m.
        rotations: [..., B, 4] float32, unit quaternions, scalar first.
    """

    positions: np.ndarray
    rotations: np.ndarray


def viewer_page(mj_model: mujoco.MjModel, poses: Poses, goals: Poses, seconds: float) -> str:
    """Return a page that replays T time steps of a robot and of its goal, shown as a thinner, green robot.

    The scene is translated and scaled to fit the viewer's camera, so the page's coordinates are not in metres.

    Args:
        mj_model: Model with B bodies.
        poses: Poses of the robot, [T, B, ...].
        goals: Poses of the robot at its goal at the same time steps, [T, B, ...].
        seconds: Duration of a time step, s.

    Returns:
        The page as HTML.
    """
    scale = _VIEW_SIZE / float(mj_model.stat.extent)
    links: dict[str, list[dict[str, Any]]] = {}
    tracks: list[tuple[np.ndarray, np.ndarray]] = []  # positions and rotations [T, ...] of each link

    def add_link(name: str, geoms: list[dict[str, Any]], positions: np.ndarray, rotations: np.ndarray) -> None:
        if geoms:
            links[name] = [{**geom, "link_idx": len(tracks)} for geom in geoms]
            tracks.append((scale * (positions - mj_model.stat.center), rotations))

    # The camera starts near the origin and looks at the first link.
    count = len(poses.positions)
    centre, upright = np.tile(mj_model.stat.center, (count, 1)), np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    point = {"name": "Sphere", "pos": [0, 0, 0], "rot": [1, 0, 0, 0], "rgba": [0, 0, 0, 1], "size": [1e-4, 0, 0]}
    add_link("centre of the view", [point], centre, upright)
    for body in range(mj_model.nbody):
        name = mj_model.body(body).name or f"body {body}"
        add_link(name, _geoms(mj_model, body, scale), poses.positions[:, body], poses.rotations[:, body])
        if _is_moved_by_joints(mj_model, body):
            geoms = _geoms(mj_model, body, scale, is_goal=True)
            add_link(f"goal of {name}", geoms, goals.positions[:, body], goals.rotations[:, body])
    positions, rotations = (np.stack([track[part] for track in tracks], axis=1).round(4).tolist() for part in (0, 1))
    states = [{"pos": pos, "rot": rot} for pos, rot in zip(positions, rotations)]
    system = {"opt": {"timestep": seconds}, "geoms": links, "states": {"x": states}}
    page: Any = html.render_from_json(json.dumps(system), None, False, None)  # type: ignore[arg-type] - None fills the window
    return page.replace("</body>", _OFFLINE + "</body>")


def _is_moved_by_joints(mj_model: mujoco.MjModel, body: int) -> bool:
    return bool(mj_model.body_weldid[body] != 0 and mj_model.body_mocapid[body] < 0)


def _geoms(mj_model: mujoco.MjModel, body: int, scale: float, is_goal: bool = False) -> list[dict[str, Any]]:
    """Return the visible geoms of a body in the viewer's format."""
    entries = []
    first, count = mj_model.body_geomadr[body], mj_model.body_geomnum[body]
    for geom in range(first, first + count):
        shape = mujoco.mjtGeom(mj_model.geom_type[geom])
        material = mj_model.geom_matid[geom]
        rgba = mj_model.geom_rgba[geom] if material < 0 else mj_model.mat_rgba[material]
        if shape not in _SHAPES or rgba[3] == 0 or mj_model.geom_group[geom] >= _VISIBLE_GROUPS:
            continue
        size = scale * mj_model.geom_size[geom].astype(float)
        if shape == mujoco.mjtGeom.mjGEOM_PLANE:
            size *= 2  # the viewer expects full side lengths
        # Capsules and cylinders keep their length, so that the goal's links stay connected.
        thick = slice(0, 1) if shape in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER) else slice(None)
        factor = _GOAL_THICKNESS if is_goal else 1.0
        size[thick] *= factor
        entry = {
            "name": _SHAPES[shape],
            "pos": (scale * mj_model.geom_pos[geom]).round(5).tolist(),
            "rot": mj_model.geom_quat[geom].round(6).tolist(),
            "rgba": [*_GOAL_COLOUR, 1.0] if is_goal else rgba.round(4).tolist(),
            "size": size.round(5).tolist(),
        }
        if entry["name"] == "Mesh":
            vertices, faces = _surface(mj_model, geom)
            entry |= {"vert": (scale * factor * vertices).round(5).tolist(), "face": faces.tolist()}
        entries.append(entry)
    return entries


def _surface(mj_model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [V, 3] (m, frame of the geom) and triangles [F, 3] of a mesh or an ellipsoid."""
    if mj_model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = mj_model.geom_dataid[geom]
        vertex, face = mj_model.mesh_vertadr[mesh], mj_model.mesh_faceadr[mesh]
        vertices = mj_model.mesh_vert[vertex : vertex + mj_model.mesh_vertnum[mesh]]
        return vertices.astype(float), mj_model.mesh_face[face : face + mj_model.mesh_facenum[mesh]]
    rows, columns = 12, 24
    latitude = np.linspace(0.0, np.pi, rows + 1)[:, None]
    longitude = np.linspace(0.0, 2 * np.pi, columns, endpoint=False)[None]
    axes = np.broadcast_arrays(np.sin(latitude) * np.cos(longitude), np.sin(latitude) * np.sin(longitude), np.cos(latitude))
    vertices = np.stack(axes, axis=-1).reshape(-1, 3) * mj_model.geom_size[geom]
    row, column = (index.ravel() for index in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    right = (column + 1) % columns
    upper_left, upper_right = row * columns + column, row * columns + right
    lower_left, lower_right = upper_left + columns, upper_right + columns
    faces = [np.stack([upper_left, lower_left, lower_right], 1), np.stack([upper_left, lower_right, upper_right], 1)]
    return vertices, np.concatenate(faces)
