"""Mesh scenes of `bench render`."""

import collections
import importlib.util

import mujoco
import numpy as np
import pytest

from jaxrl_vis.bench.scenes import clutter, models, packaged
from jaxrl_vis.errors import RequestError


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
