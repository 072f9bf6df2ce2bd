"""Meshes and height fields as small clusters of triangles, built once per scene. NumPy only.

A triangle is stored as the affine map to the unit triangle: rows for two barycentric coordinates and the height above its
plane. A ray intersects it where the height is 0, if both coordinates and their sum are within [0, 1]. Triangles are grouped
into clusters of eight neighbours, each with a bounding sphere.
"""

import mujoco
import numpy as np

CLUSTER = 8
"""Triangles per cluster; incomplete clusters are padded with triangles that no ray intersects."""

# Columns of `Scene.triangles`.
MAP = slice(0, 12)  # three rows of four: first and second barycentric coordinate, height
NORMALS = slice(12, 21)  # at the three corners
COORDINATES = slice(21, 27)  # texture coordinates at the three corners
CORNERS = slice(27, 36)  # metres
COLUMNS = 36

_HFIELD, _MESH = int(mujoco.mjtGeom.mjGEOM_HFIELD), int(mujoco.mjtGeom.mjGEOM_MESH)
# MuJoCo uses a corner's smooth normal only if its cosine with the triangle's own normal is at least this.
_SMOOTH = 0.8
# Minimum area relative to the square of a triangle's longest side; below it, float32 cannot represent the normal.
_MIN_AREA = 1e-9


def build_triangles(mj_model: mujoco.MjModel, ids: np.ndarray, types: np.ndarray, clear: np.ndarray) -> dict[str, np.ndarray]:
    """Build the triangles of all meshes and height fields among the objects ``ids``. Keys as in `Scene`.

    Args:
        mj_model: MuJoCo model.
        ids: [G], indices of the rendered objects.
        types: [G], their types as rendered.
        clear: [G] bool, True for transparent objects. Their rows are in MuJoCo's drawing order, in which their triangles are
            blended; triangles of other objects are grouped by position.

    Returns:
        ``triangles`` [R, 36] float32, metres, in the frame of their geom, `CLUSTER` rows per cluster; ``clusters`` [K, 8]
        float32 of each rendered cluster, in the same frame: centre and radius (m) of its bounding sphere, and the cone of its
        normals: axis (unit vector) and sine of the half-angle, 2 if that is a right angle or more; ``cluster_places``
        [K, 2] int32, index of the cluster's object in ``ids``, and first row of its triangles. If several geoms share a mesh,
        its triangles are stored once, and its clusters once per geom.
    """
    rows: list[np.ndarray] = []
    built: dict[tuple[int, int, bool], tuple[int, np.ndarray]] = {}
    clusters, places = [np.zeros((0, 8))], [np.zeros((0, 2), np.int64)]
    for row, index in enumerate(ids):
        if types[row] not in (_HFIELD, _MESH):
            continue
        key = (int(types[row]), int(mj_model.geom_dataid[index]), bool(clear[row]))
        if key not in built:
            triangles = _hfield(mj_model, key[1]) if key[0] == _HFIELD else _mesh(mj_model, key[1])
            first = sum(map(len, rows))
            table, balls = _clustered(*triangles, ordered=key[2])
            rows.append(table)
            built[key] = first, balls
        first, balls = built[key]
        clusters.append(balls)
        places.append(np.stack([np.full(len(balls), row), first + CLUSTER * np.arange(len(balls))], axis=1))
    return dict(
        triangles=np.concatenate([*rows, np.zeros((0, COLUMNS))]).astype(np.float32),
        clusters=np.concatenate(clusters).astype(np.float32),
        cluster_places=np.concatenate(places).astype(np.int32),
    )


def _mesh(mj_model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return corners [T, 3, 3], normals [T, 3, 3] and texture coordinates [T, 3, 2] of a mesh."""
    faces = slice(mj_model.mesh_faceadr[mesh], mj_model.mesh_faceadr[mesh] + mj_model.mesh_facenum[mesh])
    corners = mj_model.mesh_vert[mj_model.mesh_vertadr[mesh] + mj_model.mesh_face[faces]]
    normals = mj_model.mesh_normal[mj_model.mesh_normaladr[mesh] + mj_model.mesh_facenormal[faces]]
    if mj_model.mesh_texcoordadr[mesh] >= 0:
        texcoords = mj_model.mesh_texcoordadr[mesh] + mj_model.mesh_facetexcoord[faces]
        return corners.astype(np.float64), normals.astype(np.float64), mj_model.mesh_texcoord[texcoords].astype(np.float64)
    flat = _single_normals(corners)[:, None]
    cosine = (normals[..., 0] * flat[..., 0] + normals[..., 1] * flat[..., 1]) + normals[..., 2] * flat[..., 2]
    normals = np.where((cosine.astype(np.float64) < _SMOOTH)[..., None], flat, normals)
    return corners.astype(np.float64), normals.astype(np.float64), np.zeros((len(corners), 3, 2))


def _hfield(mj_model: mujoco.MjModel, hfield: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return corners, normals and texture coordinates of a height field: surface, four sides and bottom, all flat-shaded."""
    rows, columns = int(mj_model.hfield_nrow[hfield]), int(mj_model.hfield_ncol[hfield])
    start = mj_model.hfield_adr[hfield]
    heights = mj_model.hfield_data[start : start + rows * columns].reshape(rows, columns).astype(np.float64)
    half_x, half_y, top, base = mj_model.hfield_size[hfield]
    x, y = np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows)
    surface = np.stack([*np.meshgrid(x, y), heights * top], axis=-1)
    floor = surface * [1.0, 1.0, 0.0] - [0.0, 0.0, base]
    quads = [_strip_quads(surface[:-1], surface[1:])]
    # Each side from its lower to its upper edge, from left to right as seen from outside.
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
    # MuJoCo splits every cell along the diagonal from its first corner, and draws cell by cell.
    corners = np.stack([quads_[:, [2, 0, 3]], quads_[:, [0, 1, 3]]], axis=1).reshape(-1, 3, 3)
    normals = np.broadcast_to(_flat_normals(corners)[:, None], corners.shape)
    return corners, normals, np.zeros((len(corners), 3, 2))


def _strip_quads(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return quads [n * (m - 1), 4, 3] (lower left, lower right, upper left, upper right) between edges [n, m, 3]."""
    return np.stack([lower[:, :-1], lower[:, 1:], upper[:, :-1], upper[:, 1:]], axis=2).reshape(-1, 4, 3)


def _flat_normals(corners: np.ndarray) -> np.ndarray:
    """Return unit normals [T, 3]; undefined for a triangle without area."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def _single_normals(corners: np.ndarray) -> np.ndarray:
    """Return `_flat_normals` of [T, 3, 3] float32, with the same sequence of operations as in MuJoCo.

    MuJoCo compares float32 values, and slopes of 3:4:5, whose cosine is exactly the threshold, are common.
    """
    x, y, z = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).T
    length = np.sqrt((x * x + y * y) + z * z)
    scale = np.float32(1.0) / np.maximum(length, np.float32(1e-30))
    return np.stack([x * scale, y * scale, z * scale], axis=1)


def _clustered(
    corners: np.ndarray, normals: np.ndarray, coordinates: np.ndarray, ordered: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Drop triangles without area and group the others; return rows [K * CLUSTER, COLUMNS] by cluster, and bounding spheres
    with cones [K, 8].
    """
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    longest = np.max(np.sum(np.square(corners - np.roll(corners, 1, axis=1)), axis=2), axis=1)
    valid = np.linalg.norm(flat, axis=1) > _MIN_AREA * longest
    corners, normals, coordinates = corners[valid], normals[valid], coordinates[valid]
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
    # Padding: a triangle whose height is 1 everywhere is intersected by no ray.
    rows = np.zeros((len(groups), CLUSTER, COLUMNS))
    rows[:, :, 11] = 1.0
    if not groups:
        return rows.reshape(-1, COLUMNS), np.zeros((0, 8))
    full = np.arange(CLUSTER) < np.array([len(group) for group in groups])[:, None]
    # Incomplete groups repeat their first triangle to compute the bounding spheres.
    members = np.repeat(np.array([group[:1] for group in groups]), CLUSTER, axis=1)
    members[full] = np.concatenate(groups)
    rows[full] = table[members[full]]
    points = corners[members].reshape(-1, CLUSTER * 3, 3)
    middles = 0.5 * (points.min(1) + points.max(1))
    radii = np.linalg.norm(points - middles[:, None], axis=2).max(1)
    return rows.reshape(-1, COLUMNS), np.concatenate([middles, radii[:, None], _cones(unit[members])], axis=1)


def _cones(normals: np.ndarray) -> np.ndarray:
    """Return cones [K, 4] around unit normals [K, N, 3]: axis, and sine of the half-angle, 2 for a right angle or more."""
    axes = normals.sum(1)
    axes /= np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-30)
    cosines = np.einsum("knj,kj->kn", normals, axes).min(1)
    sines = np.where(cosines > 1e-3, np.sqrt(np.maximum(1.0 - cosines**2, 0.0)) + 1e-4, 2.0)
    return np.concatenate([axes, sines[:, None]], axis=1)


def _grouped(middles: np.ndarray, members: np.ndarray) -> list[np.ndarray]:
    """Split ``members`` recursively along their longest axis into groups of at most `CLUSTER`, nearly all of them full."""
    if len(members) <= CLUSTER:
        return [members] if len(members) else []
    points = middles[members]
    order = members[np.argsort(points[:, np.argmax(np.ptp(points, axis=0))], kind="stable")]
    half = CLUSTER * max(1, round(len(members) / (2 * CLUSTER)))
    return _grouped(middles, order[:half]) + _grouped(middles, order[half:])
