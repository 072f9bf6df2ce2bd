"""Bounding volume hierarchies over the triangles of meshes and height fields, built once per scene. NumPy only.

A GPU program walks them without a stack: nodes are stored in the order in which a ray visits them, near child first, in eight
orders, one for each octant of directions. A ray that meets a node's box goes on to the next node, one that misses it to the
node after its subtree.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxrl_vis_envs.render.model import meshes

LEAF = 2
"""Triangles per leaf; incomplete leaves are padded with triangles that no ray intersects."""
CELLS = 1023
"""Cells of a mesh's box along an axis, in which the boxes of its nodes are stored."""

_BINS = 16
_MIN_EXTENT = 1e-6  # m, of the box of a flat mesh
_OUTWARDS = 1e-3  # cells by which boxes are enlarged before they are rounded


class Hierarchies(NamedTuple):
    """Hierarchies of N objects, meshes or height fields, in the order of `Scene.object_ids`. Equal meshes share theirs.

    Attributes:
        nodes: [S, 4] int32: low and high corner of a node's box in cells (ten bits an axis, x lowest); its link: the node
            after its subtree or, for a leaf, -1 minus its first row of ``maps``; and 0.
        maps: [W, 12] float32, maps to unit triangles, the columns `meshes.MAP`, `LEAF` rows for each leaf.
        rows: [W] int32, rows of `Scene.triangles`; -1 for the padding of a leaf.
        first: [N] int32, first node of an object in the first octant.
        steps: [N] int32, number of its nodes. Those of octant i start at ``first + i * steps``; bit a of i is set for
            directions that are negative along axis a.
        frame: [N, 6] float32, metres, frame of the geom: low corner of the object's box, and lengths of a cell.
        ball: [N, 4] float32, metres: bounding sphere, centre in the frame of the geom and radius.
        objects: [N] int32, indices of the objects among those of the scene.
    """

    nodes: Any
    maps: Any
    rows: Any
    first: Any
    steps: Any
    frame: Any
    ball: Any
    objects: Any


class _Trees(NamedTuple):
    """Binary trees over the triangles of several meshes; V nodes, level by level.

    Attributes:
        box: [V, 2, 3] float64, m.
        child: [V] int, index of the first child, which the second follows; -1 for a leaf.
        axis: [V] int, axis of the split. The first child is the lower one.
        levels: Slices of the nodes, from the roots (one for each mesh) down.
        leaf: [V] int, number of a leaf, -1 for an inner node.
        members: [leaves, LEAF] int, triangles of each leaf, -1 for none.
    """

    box: np.ndarray
    child: np.ndarray
    axis: np.ndarray
    levels: list[slice]
    leaf: np.ndarray
    members: np.ndarray


def build_hierarchies(triangles: np.ndarray, places: np.ndarray) -> Hierarchies | None:
    """Build the hierarchies of a scene's triangles.

    Args:
        triangles: [R, COLUMNS] float32, see `meshes.build_triangles`.
        places: [K, 2] int32, index of the object and first row of the triangles of each cluster: ``cluster_places`` of
            `meshes.build_triangles`. Each object's triangles are in consecutive rows.

    Returns:
        The hierarchies of all objects with triangles, None if there are no triangles.
    """
    if not len(places):
        return None
    objects, clusters = np.unique(places[:, 0], return_index=True)
    starts, mesh_of_object = np.unique(places[clusters, 1], return_inverse=True)
    is_real = np.any(triangles[:, meshes.MAP][:, 8:11] != 0.0, axis=1)
    rows = np.flatnonzero(is_real)
    mesh = np.searchsorted(starts, rows, side="right") - 1
    corners = triangles[rows, meshes.CORNERS].reshape(-1, 3, 3).astype(np.float64)
    trees = _grow(corners.min(1), corners.max(1), mesh, len(starts))

    low = trees.box[: len(starts), 0]
    cell = np.maximum(trees.box[: len(starts), 1] - low, _MIN_EXTENT) / CELLS
    middle = 0.5 * trees.box[: len(starts)].sum(1)
    radius = np.zeros(len(starts))
    np.maximum.at(radius, mesh, np.linalg.norm(corners - middle[mesh][:, None], axis=2).max(1))
    nodes, first, steps = _threaded(trees, low, cell)
    members = trees.members.ravel()
    table = np.zeros((len(members), 12), np.float32)
    table[:, 11] = 1.0
    table[members >= 0] = triangles[rows[members[members >= 0]], meshes.MAP]
    return Hierarchies(
        nodes=nodes,
        maps=table,
        rows=np.where(members >= 0, rows[members], -1).astype(np.int32),
        first=first[mesh_of_object].astype(np.int32),
        steps=steps[mesh_of_object].astype(np.int32),
        frame=np.concatenate([low, cell], axis=1)[mesh_of_object].astype(np.float32),
        ball=np.concatenate([middle, radius[:, None]], axis=1)[mesh_of_object].astype(np.float32),
        objects=objects.astype(np.int32),
    )


def _grow(low: np.ndarray, high: np.ndarray, mesh: np.ndarray, count: int) -> _Trees:
    """Build the trees level by level, by the surface area heuristic on `_BINS` bins along each axis.

    Args:
        low: [T, 3] float64, low corners of the triangles' boxes, m.
        high: [T, 3] float64, high corners.
        mesh: [T] int, mesh of each triangle, ascending; every mesh has triangles.
        count: Number of meshes.
    """
    order = np.arange(len(low))
    sizes = np.bincount(mesh, minlength=count)
    boxes, children, axes, leaves, members, levels = [], [], [], [], [], []
    made = leaf_count = 0
    while len(sizes):
        starts = np.cumsum(sizes) - sizes
        boxes.append(np.stack([np.minimum.reduceat(low[order], starts), np.maximum.reduceat(high[order], starts)], axis=1))
        levels.append(slice(made, made + len(sizes)))
        made += len(sizes)
        is_leaf = sizes <= LEAF
        leaves.append(np.where(is_leaf, leaf_count + np.cumsum(is_leaf) - 1, -1))
        leaf_count += int(is_leaf.sum())
        within = starts[is_leaf][:, None] + np.arange(LEAF)
        members.append(np.where(np.arange(LEAF) < sizes[is_leaf][:, None], order[np.minimum(within, len(order) - 1)], -1))
        children.append(np.where(is_leaf, -1, made + 2 * (np.cumsum(~is_leaf) - 1)))
        axes.append(np.zeros(len(sizes), int))
        order = order[np.repeat(~is_leaf, sizes)]
        if not len(order):
            break
        sizes = sizes[~is_leaf]
        axes[-1][~is_leaf], is_upper = _split(low[order], high[order], sizes)
        side = 2 * np.repeat(np.arange(len(sizes)), sizes) + is_upper
        order = order[np.argsort(side, kind="stable")]
        sizes = np.bincount(side, minlength=2 * len(sizes))
    box, child, axis, leaf = (np.concatenate(parts) for parts in (boxes, children, axes, leaves))
    return _Trees(box, child, axis, levels, leaf, np.concatenate(members))


def _split(low: np.ndarray, high: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split nodes of more than `LEAF` triangles.

    Args:
        low: [T, 3], low corners of the triangles' boxes, by node.
        high: [T, 3], high corners.
        sizes: [V], triangles of each node.

    Returns:
        Axis of each node's split [V], and the mask [T] of triangles in the upper part. Neither part is empty.
    """
    starts = np.cumsum(sizes) - sizes
    node = np.repeat(np.arange(len(sizes)), sizes)
    centre = low + high
    first, last = np.minimum.reduceat(centre, starts), np.maximum.reduceat(centre, starts)
    extent = np.where(last > first, last - first, 1.0)
    bins = np.minimum((_BINS * (centre - first[node]) / extent[node]).astype(int), _BINS - 1)
    costs = np.stack([_cut_costs(low, high, _BINS * node + bins[:, axis], len(sizes)) for axis in range(3)], axis=1)
    best = costs.reshape(len(sizes), -1).argmin(1)
    axis, cut = best // (_BINS - 1), best % (_BINS - 1)
    is_upper = bins[np.arange(len(node)), axis[node]] > cut[node]
    # Triangles with one common centre have no axis: half of them each.
    is_stuck = np.isinf(costs.reshape(len(sizes), -1).min(1))
    rank = np.arange(len(node)) - starts[node]
    return axis, np.where(is_stuck[node], 2 * rank >= sizes[node], is_upper)


def _cut_costs(low: np.ndarray, high: np.ndarray, key: np.ndarray, count: int) -> np.ndarray:
    """Return the costs [V, _BINS - 1] of cuts after each bin but the last, infinite if a part is empty.

    Args:
        low: [T, 3], low corners of the triangles' boxes.
        high: [T, 3], high corners.
        key: [T], number of the node times `_BINS`, plus the bin.
        count: V, number of nodes.
    """
    order = np.argsort(key, kind="stable")
    used, starts, held = np.unique(key[order], return_index=True, return_counts=True)
    lows, highs = np.full((count * _BINS, 3), np.inf), np.full((count * _BINS, 3), -np.inf)
    lows[used], highs[used] = np.minimum.reduceat(low[order], starts), np.maximum.reduceat(high[order], starts)
    counts = np.zeros(count * _BINS, int)
    counts[used] = held
    lows, highs, counts = lows.reshape(count, _BINS, 3), highs.reshape(count, _BINS, 3), counts.reshape(count, _BINS)
    below = _costs(lows, highs, counts)[:, :-1]
    above = _costs(lows[:, ::-1], highs[:, ::-1], counts[:, ::-1])[:, -2::-1]
    return below + above


def _costs(lows: np.ndarray, highs: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the area of the box around the first 1, 2, ... bins times the leaves that they need; infinite without any."""
    size = np.maximum.accumulate(highs, axis=1) - np.minimum.accumulate(lows, axis=1)
    size = np.where(np.isfinite(size), size, 0.0)
    area = size[..., 0] * size[..., 1] + size[..., 1] * size[..., 2] + size[..., 2] * size[..., 0]
    leaves = -(-np.cumsum(counts, axis=1) // LEAF)
    return np.where(leaves > 0, area * leaves, np.inf)


def _threaded(trees: _Trees, low: np.ndarray, cell: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Store the nodes in the eight orders.

    Args:
        trees: The trees.
        low: [M, 3], m, low corners of the meshes' boxes.
        cell: [M, 3], m, cells of the meshes.

    Returns:
        ``nodes``, and the first node and the number of nodes of each mesh, [M] each.
    """
    count, inner = len(trees.box), trees.child >= 0
    size, mesh = np.ones(count, int), np.zeros(count, int)
    mesh[: len(low)] = np.arange(len(low))
    for level in trees.levels:
        parents = level.start + np.flatnonzero(inner[level])
        for child in (trees.child[parents], trees.child[parents] + 1):
            mesh[child] = mesh[parents]
    for level in reversed(trees.levels):
        parents = level.start + np.flatnonzero(inner[level])
        size[parents] += size[trees.child[parents]] + size[trees.child[parents] + 1]
    steps = size[: len(low)]
    first = 8 * (np.cumsum(steps) - steps)

    bounds = (trees.box - low[mesh][:, None]) / cell[mesh][:, None]
    corners = np.clip([np.floor(bounds[:, 0] - _OUTWARDS), np.ceil(bounds[:, 1] + _OUTWARDS)], 0, CELLS).astype(np.int64)
    words = (corners << np.array([0, 10, 20])).sum(2)
    nodes = np.zeros((8 * count, 4), np.int32)
    for octant in range(8):
        place = np.zeros(count, int)
        place[: len(low)] = first + octant * steps
        for level in trees.levels:
            parents = level.start + np.flatnonzero(inner[level])
            lower, upper = trees.child[parents], trees.child[parents] + 1
            turned = (octant >> trees.axis[parents] & 1) == 1
            place[lower] = place[parents] + 1 + np.where(turned, size[upper], 0)
            place[upper] = place[parents] + 1 + np.where(turned, 0, size[lower])
        nodes[place, 0], nodes[place, 1] = words
        nodes[place, 2] = np.where(inner, place + size, -1 - LEAF * trees.leaf)
    return nodes, first, steps
