"""Acceleration structures of meshes, built once on the host: bounding volume hierarchies with skip pointers, and clusters.

Every mesh has a frame of its own, in which its bounding box is [0, 1023] on each axis: boxes of nodes are six integers of ten
bits, rounded outwards.
"""

from typing import NamedTuple

import mujoco
import numpy as np

CELLS = 1023.0
FINE = 65535.0  # cells of the corners in `Structure.corners`
CLUSTER = 64
"""Triangles per cluster of `Structure.corners`."""
SMALL = 8
"""Triangles per cluster of `Structure.balls`."""


class Structure(NamedTuple):
    """Structures of M meshes with the same numbers of rows, padded.

    Attributes:
        nodes: [M * 8 * S, 4] int32: low and high corner of a node's box (ten bits an axis); its link, which is the index of the
            next node if the box is missed (16 bits), and 1 + number of the leaf in the upper 16 bits, 0 for an inner node; and
            0. Nodes of a mesh are stored in eight orders, near child first, one for each octant of directions. After a hit, the
            next node follows.
        maps: [M * T, 12] float32, affine maps of the mesh's frame to each unit triangle, see `render.model.meshes`, by leaf.
        leaf: Triangles per leaf.
        low, cell: [M, 3] float64, m, origin and unit of each mesh's frame in the frame of the geom.
        middle, radius: [M, 3] and [M] float64, m, bounding sphere in the frame of the geom.
        steps: S, nodes of a mesh in one order.
        triangles: T, triangles of a mesh.
        balls: [4, M * K] float32: bounding spheres of clusters of `SMALL` consecutive rows of ``small_maps``, geom's frame.
        small_maps: [M * K * SMALL, 12] float32 as ``maps``, grouped.
        cones: [8, M * C] float32: bounding sphere (4) and cone of normals (axis, and cosine of the cutoff, see `clusters`).
        corners: [9, M * C * CLUSTER] int16, corners of the triangles in 1/65535 of the mesh's box, less 32768.
    """

    nodes: np.ndarray
    maps: np.ndarray
    leaf: int
    low: np.ndarray
    cell: np.ndarray
    middle: np.ndarray
    radius: np.ndarray
    steps: int
    triangles: int
    balls: np.ndarray
    small_maps: np.ndarray
    cones: np.ndarray
    corners: np.ndarray


def build(mj_model: mujoco.MjModel, leaf: int = 2) -> Structure:
    """Build the structures of all meshes of a model.

    Args:
        mj_model: Model.
        leaf: Triangles per leaf.
    """
    meshes = [mesh_corners(mj_model, number) for number in range(mj_model.nmesh)]
    boxes = [(corners.min((0, 1)), corners.max((0, 1))) for corners in meshes]
    low = np.array([box[0] for box in boxes])
    cell = np.maximum(np.array([box[1] for box in boxes]) - low, 1e-6) / CELLS
    middle = np.array([0.5 * (box[0] + box[1]) for box in boxes])
    radius = np.array([np.linalg.norm(c - m, axis=2).max() for c, m in zip(meshes, middle, strict=True)])
    trees = [_Tree((corners - origin) / unit, leaf) for corners, origin, unit in zip(meshes, low, cell, strict=True)]
    steps, rows = max(len(tree.boxes) for tree in trees), max(tree.leaves * leaf for tree in trees)
    nodes = np.zeros((4, len(meshes), 8, steps), np.int32)
    maps = np.zeros((12, len(meshes), rows), np.float32)
    maps[11] = 1.0  # met by no ray
    for number, tree in enumerate(trees):
        for octant in range(8):
            table = tree.threaded(octant)
            nodes[:3, number, octant, : table.shape[1]] = table
            nodes[2, number, octant, table.shape[1] :] = steps
        own = tree.triangle_rows()
        maps[:, number, : own.shape[1]] = own
    balls, small_maps = _small(meshes, low, cell)
    cones, corners = _clusters(meshes, low, cell)
    nodes, maps = nodes.reshape(4, -1).T.copy(), maps.reshape(12, -1).T.copy()  # a node, a triangle in few sectors of memory
    return Structure(nodes, maps, leaf, low, cell, middle, radius, steps, rows, balls, small_maps, cones, corners)


def mesh_corners(mj_model: mujoco.MjModel, number: int) -> np.ndarray:
    """Return the corners [T, 3, 3] float64 (m) of a mesh's triangles."""
    faces = slice(mj_model.mesh_faceadr[number], mj_model.mesh_faceadr[number] + mj_model.mesh_facenum[number])
    return mj_model.mesh_vert[mj_model.mesh_vertadr[number] + mj_model.mesh_face[faces]].astype(np.float64)


def unit_maps(corners: np.ndarray) -> np.ndarray:
    """Return affine maps [T, 12] to unit triangles; triangles without area get one that no ray meets."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    flat = np.cross(first, second)
    length = np.linalg.norm(flat, axis=1)
    valid = length > 1e-9 * np.maximum((first**2).sum(1), (second**2).sum(1))
    maps = np.zeros((len(corners), 3, 4))
    maps[:, 2, 3] = 1.0
    basis = np.stack([first, second, flat / np.maximum(length, 1e-30)[:, None]], axis=2)[valid]
    inverse = np.linalg.inv(basis)
    maps[valid, :, :3] = inverse
    maps[valid, :, 3] = -np.einsum("tij,tj->ti", inverse, corners[valid, 0])
    return maps.reshape(-1, 12)


class _Tree:
    """Binary tree over triangles by the surface area heuristic.

    Attributes:
        boxes: [nodes, 2, 3].
        children: Pairs of nodes, or None for a leaf.
        axes: Axis of each split.
        numbers: Number of each leaf, -1 for an inner node.
        leaves: Number of leaves.
    """

    def __init__(self, corners: np.ndarray, leaf: int):
        self.corners, self.leaf, self.leaves = corners, leaf, 0
        self.low, self.high = corners.min(1), corners.max(1)
        self.boxes, self.children, self.axes, self.numbers, self.members = [], [], [], [], []
        self._split(np.arange(len(corners)))

    def _split(self, members: np.ndarray) -> int:
        node = len(self.boxes)
        self.boxes.append((self.low[members].min(0), self.high[members].max(0)))
        self.children.append(None)
        self.axes.append(0)
        self.numbers.append(-1)
        if len(members) <= self.leaf:
            self.numbers[node] = self.leaves
            self.members.append(members)
            self.leaves += 1
            return node
        best = (np.inf, 0, 0, members)
        for axis in range(3):
            order = members[np.argsort(self.low[members, axis] + self.high[members, axis], kind="stable")]
            left, right = _areas(self.low[order], self.high[order]), _areas(self.low[order[::-1]], self.high[order[::-1]])[::-1]
            sizes = np.arange(1, len(order))
            full = -(-sizes // self.leaf), -(-(len(order) - sizes) // self.leaf)  # leaves that either side needs
            costs = left[:-1] * full[0] + right[1:] * full[1]
            where = int(np.argmin(costs))
            if costs[where] < best[0]:
                best = (costs[where], axis, where + 1, order)
        _, axis, where, order = best
        self.axes[node] = axis
        self.children[node] = (self._split(order[:where]), self._split(order[where:]))
        return node

    def threaded(self, octant: int) -> np.ndarray:
        """Return the words [3, nodes] int32 in the order for directions whose component on axis a is negative at bit a."""
        order, skips = [], {}

        def visit(node: int) -> None:
            order.append(node)
            children = self.children[node]
            if children is not None:
                for child in children[:: -1 if octant >> self.axes[node] & 1 else 1]:
                    visit(child)
            skips[node] = len(order)

        visit(0)
        boxes = np.array(self.boxes)[order]
        low = np.clip(np.floor(boxes[:, 0] - 1e-3), 0, 1023).astype(np.int64)
        high = np.clip(np.ceil(boxes[:, 1] + 1e-3), 0, 1023).astype(np.int64)
        links = np.array([skips[node] | (self.numbers[node] + 1) << 16 for node in order])
        shifts = np.array([0, 10, 20])
        words = np.stack([(low << shifts).sum(1), (high << shifts).sum(1), links])
        return words.astype(np.uint32).view(np.int32)

    def triangle_rows(self) -> np.ndarray:
        """Return the maps [12, leaves * leaf] of the triangles, by leaf."""
        maps = unit_maps(self.corners)
        rows = np.zeros((self.leaves, self.leaf, 12))
        rows[:, :, 11] = 1.0
        for number, members in enumerate(self.members):
            rows[number, : len(members)] = maps[members]
        return rows.reshape(-1, 12).T


def _areas(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the surface areas of the boxes around the first 1, 2, ... of the boxes [N, 3]."""
    size = np.maximum.accumulate(high) - np.minimum.accumulate(low)
    return size[:, 0] * size[:, 1] + size[:, 1] * size[:, 2] + size[:, 2] * size[:, 0]


def _grouped(middles: np.ndarray, members: np.ndarray, size: int) -> list[np.ndarray]:
    """Split ``members`` recursively along their longest axis into groups of at most ``size``."""
    if len(members) <= size:
        return [members]
    points = middles[members]
    order = members[np.argsort(points[:, np.argmax(np.ptp(points, axis=0))], kind="stable")]
    half = size * max(1, round(len(members) / (2 * size)))
    return _grouped(middles, order[:half], size) + _grouped(middles, order[half:], size)


def _padded(groups: list[np.ndarray], size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the groups [K, size], filled up with their first member, and the mask of members."""
    full = np.arange(size) < np.array([len(group) for group in groups])[:, None]
    members = np.repeat(np.array([group[:1] for group in groups]), size, axis=1)
    members[full] = np.concatenate(groups)
    return members, full


def _spheres(points: np.ndarray) -> np.ndarray:
    """Return bounding spheres [K, 4] of points [K, N, 3]."""
    middles = 0.5 * (points.min(1) + points.max(1))
    return np.concatenate([middles, np.linalg.norm(points - middles[:, None], axis=2).max(1)[:, None]], axis=1)


def _small(meshes: list[np.ndarray], low: np.ndarray, cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``balls`` and ``small_maps``; numbers of clusters are padded to a multiple of 32 with spheres of radius -1."""
    found = []
    for corners in meshes:
        members, full = _padded(_grouped(corners.mean(1), np.arange(len(corners)), SMALL), SMALL)
        found.append((corners, members, full))
    count = -(-max(len(members) for _, members, _ in found) // 32) * 32
    balls, maps = np.zeros((len(meshes), count, 4)), np.zeros((len(meshes), count, SMALL, 12))
    balls[:, :, 3], maps[..., 11] = -1.0, 1.0
    for number, (corners, members, full) in enumerate(found):
        balls[number, : len(members)] = _spheres(corners[members].reshape(len(members), -1, 3))
        own = unit_maps((corners - low[number]) / cell[number])[members]
        maps[number, : len(members)][full] = own[full]
    return balls.reshape(-1, 4).T.astype(np.float32), maps.reshape(-1, 12).astype(np.float32)


def _clusters(meshes: list[np.ndarray], low: np.ndarray, cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``cones`` and ``corners``, see `Structure`.

    All triangles of a cluster face away from a camera at p if dot(middle - p, axis) >= cutoff * |middle - p| + radius, where
    cutoff is the sine of the cone's half-angle. Without such a cone, cutoff is 2.
    """
    groups = [_padded(_grouped(corners.mean(1), np.arange(len(corners)), CLUSTER), CLUSTER) for corners in meshes]
    count = -(-max(len(members) for members, _ in groups) // 32) * 32
    cones = np.zeros((len(meshes), count, 8))
    cones[:, :, 3] = -1.0
    table = np.zeros((len(meshes), count, CLUSTER, 9))
    for number, (corners, (members, full)) in enumerate(zip(meshes, groups, strict=True)):
        points = corners[members]
        cones[number, : len(members), :4] = _spheres(points.reshape(len(members), -1, 3))
        normal = np.cross(points[:, :, 1] - points[:, :, 0], points[:, :, 2] - points[:, :, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-30)
        axis = normal.sum(1)
        axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-30)
        cosine = np.einsum("kcj,kj->kc", normal, axis).min(1)
        cones[number, : len(members), 4:7] = axis
        cones[number, : len(members), 7] = np.where(cosine > 0.05, np.sqrt(np.maximum(1.0 - cosine**2, 0.0)), 2.0)
        fine = np.round((points - low[number]) / (cell[number] * CELLS) * FINE).reshape(len(members), CLUSTER, 9)
        fine[~full] = 0.0  # a point: no area
        table[number, : len(members)] = fine
    corners = (table.reshape(-1, 9).T - 32768.0).astype(np.int16)
    return cones.reshape(-1, 8).T.astype(np.float32), corners
