"""Scene `clutter`: 500 instances of twelve procedurally made meshes of 5,000 triangles, four cameras, a light with shadows."""

from collections.abc import Callable

import mujoco
import numpy as np

MESHES, INSTANCES = 12, 500
_AROUND, _ALONG = 50, 50  # cells of a mesh's grid, two triangles each
_RADIUS = 0.065  # m, of the sphere around a mesh
_GRID, _SPACING = (10, 10, 5), (0.13, 0.13, 0.12)  # instances at the start, and metres between them
_CAMERAS = {"front": (1.8, 0.0, 1.2), "left": (-0.5, 1.7, 1.0), "right": (-0.6, -1.6, 1.3), "top": (0.3, 0.0, 2.2)}
_TARGET = (0.0, 0.0, 0.2)


def clutter_spec() -> mujoco.MjSpec:
    """Build the scene: free bodies in loose layers over a floor, in random orientations and colours."""
    rng = np.random.default_rng(0)
    spec = mujoco.MjSpec()
    spec.modelname = "clutter"
    spec.stat.extent, spec.stat.center = 2.0, np.array(_TARGET)
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 25.0
    spec.visual.headlight.ambient[:], spec.visual.headlight.diffuse[:] = 0.3, 0.3
    spec.visual.headlight.specular[:] = 0.0
    world = spec.worldbody
    light = world.add_light(pos=[0.5, 0.4, 3.0], dir=[-0.15, -0.1, -1.0], castshadow=True)
    light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    light.diffuse[:], light.specular[:] = 0.6, 0.2
    for name, position in _CAMERAS.items():
        world.add_camera(name=name, pos=position, quat=_look(np.array(position), np.array(_TARGET)), fovy=45.0)
    fixed = {"contype": 0, "conaffinity": 0}
    world.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2.0, 2.0, 0.1], rgba=[0.5, 0.55, 0.6, 1.0], **fixed)
    for number in range(MESHES):
        points, faces = mesh(number, rng)
        spec.add_mesh(name=f"mesh{number}", uservert=points.ravel(), userface=faces.ravel())
    shift = -0.5 * (np.array(_GRID) - 1) * _SPACING * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.08]
    for index in range(INSTANCES):
        cell = np.array(np.unravel_index(index % np.prod(_GRID), _GRID))
        turn = rng.normal(size=4)
        body = world.add_body(pos=cell * _SPACING + shift, quat=turn / np.linalg.norm(turn))
        body.add_freejoint()
        colour = [*rng.uniform(0.2, 1.0, 3), 1.0]
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"mesh{index % MESHES}", rgba=colour, **fixed)
    return spec


def mesh(number: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Make a closed surface: a lump, a rounded box, a bowl or a twisted ring, by ``number`` modulo 4.

    Args:
        number: Number of the mesh.
        rng: Generator of its proportions.

    Returns:
        Corners [V, 3] float64, m, and triangles [5000, 3] int32, counterclockwise from outside.
    """
    make = (_lump, _rounded_box, _bowl, _ring)[number % 4]
    points, faces = make(rng)
    points = points - 0.5 * (points.min(0) + points.max(0))
    return _RADIUS / np.linalg.norm(points, axis=1).max() * points, faces


def _lump(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Make a ball whose radius varies by random waves. Results as in `_closed`."""
    waves, phases = rng.normal(size=(6, 3)) * 2.0, rng.uniform(0.0, 2.0 * np.pi, 6)
    heights = rng.uniform(0.05, 0.15, 6)

    def surface_point(polar: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
        ball = _ball(polar, azimuth)
        return ball * (1.0 + np.sin(ball @ waves.T + phases) @ heights)[:, None]

    return _closed(surface_point)


def _rounded_box(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Make a superellipsoid. Results as in `_closed`."""
    power, half = rng.uniform(0.25, 0.6), rng.uniform(0.4, 1.0, 3)

    def surface_point(polar: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
        ball = _ball(polar, azimuth)
        return half * np.sign(ball) * np.abs(ball) ** power

    return _closed(surface_point)


def _bowl(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Make a surface of revolution: the outside of a bowl, and the inside back to the axis. Results as in `_closed`."""
    height, wall, lip = rng.uniform(0.5, 1.6), rng.uniform(0.75, 0.9), rng.uniform(0.8, 1.3)

    def surface_point(polar: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
        outside = polar >= np.pi / 2
        along = np.where(outside, np.pi - polar, polar)  # from the axis to the rim
        scale = np.where(outside, 1.0, wall)
        radius, z = scale * np.sin(along) ** lip, np.where(outside, 0.0, 1.0 - wall) - scale * height * np.cos(along)
        return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)

    return _closed(surface_point)


def _ring(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Make a torus with a twisted, wavy cross-section. Results as in `_closed`."""
    thickness, turns, wave = rng.uniform(0.25, 0.4), rng.integers(1, 4), rng.uniform(0.1, 0.35)
    ring, tube = np.meshgrid(*(2.0 * np.pi * np.arange(count) / count for count in (_AROUND, _ALONG)), indexing="ij")
    radius = thickness * (1.0 + wave * np.cos(2.0 * (tube + turns * ring)))
    across = 1.0 + radius * np.cos(tube)
    points = np.stack([across * np.cos(ring), across * np.sin(ring), radius * np.sin(tube)], axis=-1).reshape(-1, 3)
    first, second = np.indices((_AROUND, _ALONG)).reshape(2, -1)
    nexts = (first + 1) % _AROUND, (second + 1) % _ALONG
    corners = [a * _ALONG + b for a, b in ((first, second), (nexts[0], second), (nexts[0], nexts[1]), (first, nexts[1]))]
    return points, _halves(corners)


def _ball(polar: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Return unit vectors [N, 3] of polar angles and azimuths [N]."""
    return np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)


def _closed(surface_point: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Make a closed surface with the topology of a sphere: two poles, and rings of vertices between them.

    Args:
        surface_point: Function from polar angles and azimuths [N] to points [N, 3].

    Returns:
        Vertices [V, 3] float64, not yet scaled, and triangles [F, 3] int32, counterclockwise from outside.
    """
    polar, azimuth = np.meshgrid(
        np.pi * np.arange(1, _ALONG + 1) / (_ALONG + 1), 2.0 * np.pi * np.arange(_AROUND) / _AROUND, indexing="ij"
    )
    points = surface_point(np.array([0.0, *polar.ravel(), np.pi]), np.array([0.0, *azimuth.ravel(), 0.0]))
    row, column = np.indices((_ALONG - 1, _AROUND)).reshape(2, -1)
    right = (column + 1) % _AROUND
    corners = [1 + a * _AROUND + b for a, b in ((row, column), (row + 1, column), (row + 1, right), (row, right))]
    around = np.arange(_AROUND, dtype=np.int32)
    beside, last = (around + 1) % _AROUND, len(points) - 1
    top = np.stack([np.zeros_like(around), 1 + around, 1 + beside], axis=1)
    bottom = np.stack([np.full_like(around, last), last - _AROUND + beside, last - _AROUND + around], axis=1)
    return points, np.concatenate([top, _halves(corners), bottom]).astype(np.int32)


def _halves(corners: list[np.ndarray]) -> np.ndarray:
    """Split quads, four arrays [N] of corners, into triangles [2 N, 3]."""
    a, b, c, d = corners
    return np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3).astype(np.int32)


def _look(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the quaternion [4] of a camera at ``position`` that looks at ``target``, with world +z up."""
    back = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.stack([right, np.cross(back, right), back], axis=1).ravel())
    return quaternion
