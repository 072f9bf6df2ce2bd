"""Meshes and height fields as small clusters of triangles, made once with the scene. NumPy only.

A triangle is kept as the affine map that brings it to the unit triangle: rows that give its two barycentric coordinates and the
height above its plane, so that a ray meets it where the height is 0, and both coordinates and their sum are within [0, 1]. The
triangles are grouped, eight that are near each other at a time, with a ball around each group.
"""

import mujoco
import numpy as np

CLUSTER = 8
"""Triangles in a cluster; the last of a mesh's are filled up with ones that no ray meets."""

# Columns of `Scene.triangles`.
MAP = slice(0, 12)  # three rows of four: first and second barycentric coordinate, height
NORMALS = slice(12, 21)  # of the three corners
COORDINATES = slice(21, 27)  # of the texture, at the three corners
CORNERS = slice(27, 36)  # metres
COLUMNS = 36

_HFIELD, _MESH = int(mujoco.mjtGeom.mjGEOM_HFIELD), int(mujoco.mjtGeom.mjGEOM_MESH)
# MuJoCo smooths a corner only where the smooth normal is within this cosine of the triangle's own.
_SMOOTH = 0.8
# Of the square of a triangle's longest side: one with less area has no normal that float32 knows of.
_LEAST_AREA = 1e-9


def build_triangles(mj_model: mujoco.MjModel, ids: np.ndarray, types: np.ndarray, clear: np.ndarray) -> dict[str, np.ndarray]:
    """Triangles of all meshes and height fields among the objects ``ids``. Keys as in `Scene`.

    Args:
        mj_model: The model.
        ids: The drawn objects.
        types: Of each of them, as it is drawn.
        clear: Whether each of them lets light through. Its triangles are laid over each other in the order in which MuJoCo
            draws them, so that is the order of their rows; others are grouped by where they are.

    Returns:
        ``triangles`` [R, 36] float32, metres, in the frame of their geom, `CLUSTER` rows to a cluster; ``clusters`` [K, 4]
        float32, middle and radius (m) of the ball around each drawn cluster, in the same frame; ``cluster_places`` [K, 2]
        int32, the index into ``ids`` of the object, and the first row of its triangles. A mesh that several geoms show has its
        triangles once, and its clusters once per geom.
    """
    rows: list[np.ndarray] = []
    found: dict[tuple[int, int, bool], tuple[int, np.ndarray]] = {}
    clusters, places = [np.zeros((0, 4))], [np.zeros((0, 2), np.int64)]
    for row, index in enumerate(ids):
        if types[row] not in (_HFIELD, _MESH):
            continue
        key = (int(types[row]), int(mj_model.geom_dataid[index]), bool(clear[row]))
        if key not in found:
            triangles = _hfield(mj_model, key[1]) if key[0] == _HFIELD else _mesh(mj_model, key[1])
            first = sum(map(len, rows))
            table, balls = _clustered(*triangles, ordered=key[2])
            rows.append(table)
            found[key] = first, balls
        first, balls = found[key]
        clusters.append(balls)
        places.append(np.stack([np.full(len(balls), row), first + CLUSTER * np.arange(len(balls))], axis=1))
    return dict(
        triangles=np.concatenate([*rows, np.zeros((0, COLUMNS))]).astype(np.float32),
        clusters=np.concatenate(clusters).astype(np.float32),
        cluster_places=np.concatenate(places).astype(np.int32),
    )


def _mesh(mj_model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners [T, 3, 3], normals [T, 3, 3] and texture coordinates [T, 3, 2] of a mesh."""
    faces = slice(mj_model.mesh_faceadr[mesh], mj_model.mesh_faceadr[mesh] + mj_model.mesh_facenum[mesh])
    corners = mj_model.mesh_vert[mj_model.mesh_vertadr[mesh] + mj_model.mesh_face[faces]]
    normals = mj_model.mesh_normal[mj_model.mesh_normaladr[mesh] + mj_model.mesh_facenormal[faces]]
    if mj_model.mesh_texcoordadr[mesh] >= 0:
        where = mj_model.mesh_texcoordadr[mesh] + mj_model.mesh_facetexcoord[faces]
        return corners.astype(np.float64), normals.astype(np.float64), mj_model.mesh_texcoord[where].astype(np.float64)
    flat = _single_normals(corners)[:, None]
    cosine = (normals[..., 0] * flat[..., 0] + normals[..., 1] * flat[..., 1]) + normals[..., 2] * flat[..., 2]
    normals = np.where((cosine.astype(np.float64) < _SMOOTH)[..., None], flat, normals)
    return corners.astype(np.float64), normals.astype(np.float64), np.zeros((len(corners), 3, 2))


def _hfield(mj_model: mujoco.MjModel, hfield: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of a height field: its surface, its four sides and its bottom. All flat."""
    rows, columns = int(mj_model.hfield_nrow[hfield]), int(mj_model.hfield_ncol[hfield])
    start = mj_model.hfield_adr[hfield]
    heights = mj_model.hfield_data[start : start + rows * columns].reshape(rows, columns).astype(np.float64)
    half_x, half_y, top, base = mj_model.hfield_size[hfield]
    x, y = np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows)
    surface = np.stack([*np.meshgrid(x, y), heights * top], axis=-1)
    floor = surface * [1.0, 1.0, 0.0] - [0.0, 0.0, base]
    quads = [_strip_quads(surface[:-1], surface[1:])]
    # Each side from its lower edge to its upper one, seen from outside from left to right.
    for lower, upper in (
        (floor[0], surface[0]),
        (floor[-1][::-1], surface[-1][::-1]),
        (floor[::-1, 0], surface[::-1, 0]),
        (floor[:, -1], surface[:, -1]),
    ):
        quads.append(_strip_quads(lower[None], upper[None]))
    ends = floor[[0, 0, -1, -1], [0, -1, 0, -1]].reshape(2, 2, 3)
    quads.append(_strip_quads(ends[1:], ends[:1]))
    quads_ = np.concatenate(quads)
    # MuJoCo cuts every cell from its first corner to the one opposite, and draws cell by cell.
    corners = np.stack([quads_[:, [2, 0, 3]], quads_[:, [0, 1, 3]]], axis=1).reshape(-1, 3, 3)
    normals = np.broadcast_to(_flat_normals(corners)[:, None], corners.shape)
    return corners, normals, np.zeros((len(corners), 3, 2))


def _strip_quads(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """[n, m, 3] and [n, m, 3] -> [n * (m - 1), 4, 3]: lower left, lower right, upper left, upper right."""
    return np.stack([lower[:, :-1], lower[:, 1:], upper[:, :-1], upper[:, 1:]], axis=2).reshape(-1, 4, 3)


def _flat_normals(corners: np.ndarray) -> np.ndarray:
    """[T, 3] unit normals; of a triangle without area, anything."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def _single_normals(corners: np.ndarray) -> np.ndarray:
    """`_flat_normals` of [T, 3, 3] float32, operation by operation as MuJoCo computes them.

    What it compares has 32 bits, and slopes of 3:4:5, whose cosine is the very bound, are common.
    """
    x, y, z = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).T
    length = np.sqrt((x * x + y * y) + z * z)
    scale = np.float32(1.0) / np.maximum(length, np.float32(1e-30))
    return np.stack([x * scale, y * scale, z * scale], axis=1)


def _clustered(
    corners: np.ndarray, normals: np.ndarray, coordinates: np.ndarray, ordered: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Rows [K * CLUSTER, COLUMNS] of the triangles, cluster by cluster, and the balls [K, 4]. Without area: left out."""
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    longest = np.max(np.sum(np.square(corners - np.roll(corners, 1, axis=1)), axis=2), axis=1)
    kept = np.linalg.norm(flat, axis=1) > _LEAST_AREA * longest
    corners, normals, coordinates = corners[kept], normals[kept], coordinates[kept]
    unit = _flat_normals(corners)
    basis = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], unit], axis=2)
    inverse = np.linalg.inv(basis)
    offset = -np.einsum("tij,tj->ti", inverse, corners[:, 0])
    maps = np.concatenate([inverse, offset[:, :, None]], axis=2)
    count = len(corners)
    parts = (maps.reshape(count, 12), normals.reshape(count, 9), coordinates.reshape(count, 6), corners.reshape(count, 9))
    table = np.concatenate(parts, axis=1)
    order = np.arange(count)
    groups = np.split(order, order[CLUSTER::CLUSTER]) if ordered and count else _grouped(corners.mean(1), order)
    # No ray meets a triangle whose height is 1 everywhere.
    rows = np.zeros((len(groups), CLUSTER, COLUMNS))
    rows[:, :, 11] = 1.0
    if not groups:
        return rows.reshape(-1, COLUMNS), np.zeros((0, 4))
    full = np.arange(CLUSTER) < np.array([len(group) for group in groups])[:, None]
    # Groups that are not full have their first triangle again where others have further ones.
    members = np.repeat(np.array([group[:1] for group in groups]), CLUSTER, axis=1)
    members[full] = np.concatenate(groups)
    rows[full] = table[members[full]]
    points = corners[members].reshape(-1, CLUSTER * 3, 3)
    middles = 0.5 * (points.min(1) + points.max(1))
    radii = np.linalg.norm(points - middles[:, None], axis=2).max(1)
    return rows.reshape(-1, COLUMNS), np.concatenate([middles, radii[:, None]], axis=1)


def _grouped(middles: np.ndarray, members: np.ndarray) -> list[np.ndarray]:
    """Halves the members along their longest axis until at most `CLUSTER` are left; nearly all groups are full."""
    if len(members) <= CLUSTER:
        return [members] if len(members) else []
    points = middles[members]
    order = members[np.argsort(points[:, np.argmax(np.ptp(points, axis=0))], kind="stable")]
    half = CLUSTER * max(1, round(len(members) / (2 * CLUSTER)))
    return _grouped(middles, order[:half]) + _grouped(middles, order[half:])
