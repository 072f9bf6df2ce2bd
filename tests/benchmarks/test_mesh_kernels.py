"""Mesh scenes of `bench render`, and the throw-away kernels for them, in Pallas' interpreter."""

import collections
import importlib.util
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from benchmarks.mesh_kernels import raster, structure, views, walk
from jaxrl_vis.bench.scenes import clutter, models, packaged
from jaxrl_vis.errors import RequestError

SIZE = 16


@pytest.fixture(scope="module")
def scene() -> tuple[mujoco.MjModel, mujoco.MjData, dict[str, np.ndarray]]:
    """Some bodies of the clutter near its middle, seen by one camera."""
    spec = clutter.clutter_spec(instances=6)
    for body in spec.bodies[1:]:
        body.pos = 0.3 * np.array(body.pos) + [0.35, 0.15, 0.1]
    for camera in spec.cameras[1:]:
        spec.delete(camera)
    mj_model = spec.compile()
    poses = models.random_poses(mj_model, 1, 3, 0.1)
    mj_data = mujoco.MjData(mj_model)
    for name, rows in poses.items():
        getattr(mj_data, name)[:] = rows[0]
    return mj_model, mj_data, poses


def test_clutter_has_a_dozen_meshes_of_5000_triangles() -> None:
    mj_model = clutter.clutter_spec().compile()
    assert mj_model.mesh_facenum.tolist() == [5000] * 12
    assert np.unique(mj_model.geom_dataid, return_counts=True)[1].tolist() == [1] + [42] * 8 + [41] * 4
    assert mj_model.ncam == 4 and mj_model.light_castshadow.any()
    assert not models.load("clutter").light_castshadow.any()


@pytest.mark.parametrize("number", range(4))
def test_meshes_are_closed_and_face_outwards(number: int) -> None:
    points, faces = clutter.mesh(number, np.random.default_rng(0))
    edges = collections.Counter((int(a), int(b)) for face in faces for a, b in zip(face, np.roll(face, -1), strict=True))
    assert set(edges.values()) == {1} and all((b, a) in edges for a, b in edges)
    corners = points[faces]
    assert np.einsum("tj,tj->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) > 0  # six times the volume


def test_robots_of_missing_packages_are_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packaged.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(RequestError, match="pip install --no-deps gym-aloha") as caught:
        models.load("aloha")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", packaged.PACKAGED)
def test_robots_are_seen_by_a_camera_of_their_own(name: str) -> None:
    if importlib.util.find_spec(packaged._SOURCES[name].package) is None:
        pytest.skip(f"the package of {name} is missing")
    mj_model = models.load(name)
    assert mj_model.camera(0).name == "bench" and (mj_model.geom_type == mujoco.mjtGeom.mjGEOM_MESH).sum() >= 15


def first_hits(mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Depth (m) and geom of every pixel by MuJoCo's own rays, inf and -1 for the sky."""
    half = views.half_height(mj_model)
    unit = (2.0 * np.arange(SIZE) + 1.0 - SIZE) / SIZE * half
    v, u = np.meshgrid(-unit, unit, indexing="ij")
    directions = np.stack([u.ravel(), v.ravel(), -np.ones(SIZE * SIZE)], 1) @ mj_data.cam_xmat[0].reshape(3, 3).T
    depth, geoms = np.full(SIZE * SIZE, np.inf), np.full(SIZE * SIZE, -1)
    for pixel, direction in enumerate(directions):
        geom = np.zeros(1, np.int32)
        distance = mujoco.mj_ray(mj_model, mj_data, mj_data.cam_xpos[0], direction, None, 1, -1, geom)
        if geom[0] >= 0:
            depth[pixel], geoms[pixel] = distance, geom[0]
    return depth, geoms


@pytest.mark.parametrize("design", ["lanes", "scatter"])
def test_kernels_agree_with_rays_of_mujoco(scene: tuple, design: str) -> None:
    mj_model, mj_data, poses = scene
    meshes = structure.build(mj_model, 4)
    names = ("nodes", "maps", "balls", "small_maps", "cones", "corners")
    tables = {name: jnp.asarray(getattr(meshes, name)) for name in names}
    tables["rgba"] = jnp.asarray(mj_model.geom_rgba.T, jnp.float32)

    def draw(poses: dict[str, jax.Array]) -> Any:
        lens = (SIZE, views.half_height(mj_model), float(mj_model.vis.map.znear * mj_model.stat.extent))
        seen = views.make_views(mj_model, meshes, SIZE, poses)
        if design == "lanes":
            return walk.draw(seen, meshes, tables, *lens, walk.Settings(), interpret=True)[0]
        return raster.draw(seen, meshes, tables, *lens, raster.Settings(), design, interpret=True)[0]

    images = jax.jit(draw)({name: jnp.asarray(rows) for name, rows in poses.items()})
    depth, geoms = first_hits(mj_model, mj_data)
    assert len(np.unique(geoms)) >= 5  # several bodies, and the floor
    shown = geoms >= 0
    assert np.mean(np.asarray(images.geom[0]) == geoms) > 0.99
    assert np.mean(np.abs(np.asarray(images.depth[0])[shown] - depth[shown]) < 1e-3) > 0.99
