"""GPU kernel that searches for triangles finds what the plain renderer finds; run by Pallas's interpreter, without a GPU."""

import functools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mesh_scene import SIZE, prepared
from nvidia import lowered_for_nvidia
from small_scene import ORTHOGRAPHIC

import jaxrl_vis_envs
from jaxrl_vis_envs.compiling.compilation import kernels, tracing_for
from jaxrl_vis_envs.render import Scene, images
from jaxrl_vis_envs.render.gpu import search
from jaxrl_vis_envs.render.model import hierarchies, meshes
from jaxrl_vis_envs.render.outputs import Outputs, Planes
from jaxrl_vis_envs.render.pixel.lights import Light
from jaxrl_vis_envs.render.pixel.prepare import prepare

KERNEL = functools.partial(search.traverse_on_gpu, interpret=True)
SEARCH = images._Search(
    search.layout, functools.partial(search.nearest, interpret=True), functools.partial(search.blocked, walk=KERNEL)
)
ARM = ("sphere", "capsule", "box")


def drawn(scene: Scene, poses: SimpleNamespace, outputs: Outputs, searches: images._Search, missing: int) -> Planes:
    """Draw two images; in the second, the geom ``missing`` has no pose. The kernel is for a GPU, the plain way for this CPU."""

    def draw(places: jax.Array) -> Planes:
        given = SimpleNamespace(**{**vars(poses), "geom_xpos": places})
        with tracing_for("cpu" if searches == images._PLAIN else "cuda"):
            return images._draw(outputs, scene, *prepare(scene, given), searches)

    places = jnp.stack([poses.geom_xpos, poses.geom_xpos.at[missing].set(jnp.nan)])
    return jax.tree.map(np.asarray, jaxrl_vis_envs.jit(jax.vmap(draw), runs_once=True)(places))


@pytest.mark.parametrize(
    ("given", "outputs", "options"),
    [
        (("",), Outputs(rgb=True, depth=True, segmentation=True, normals=True, quantized=True), {"shadows": True}),
        ((ORTHOGRAPHIC, 'material="glass"'), Outputs(rgb=False, depth=True, segmentation=True), {"textured": False}),
    ],
    ids=["shadows", "orthographic"],
)
def test_kernel_draws_what_the_plain_renderer_draws(given: tuple, outputs: Outputs, options: dict[str, Any]) -> None:
    scene, mj_model, poses = prepared(*given, **options)
    later = mj_model.geom("later").id
    expected, ours = (drawn(scene, poses, outputs, searches, later) for searches in (images._PLAIN, SEARCH))
    labels = expected.segmentation
    assert len(np.unique(labels)) > 18 and len(scene.hierarchies.first) > 32
    for name in ("later", "veil", *(["close"] if len(given) == 1 else [])):
        assert mj_model.geom(name).id in labels[0], name
    # Of two that coincide the later one is visible, and without its pose the earlier one.
    assert mj_model.geom("earlier").id not in ours.segmentation[0] and later not in ours.segmentation[1]
    assert mj_model.geom("earlier").id in ours.segmentation[1]
    same = ours.segmentation == labels
    assert same.mean() > 0.998  # the rest: a ray within rounding of an edge
    for name, plane in expected._asdict().items():
        if plane is None or name == "segmentation":
            continue
        differences = np.abs(np.asarray(getattr(ours, name), np.float64) - plane)
        if plane.ndim == 4:
            differences = differences.max(1)
        assert differences[same].max() <= (1.0 if name == "rgb" else 1e-4), name


@pytest.mark.parametrize("directional", [False, True])
def test_kernel_finds_the_shadows_that_rays_of_mujoco_find(directional: bool) -> None:
    scene, mj_model, _ = prepared()
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    unit = prepare(scene, mj_data).unit
    rng = np.random.default_rng(1)
    start = rng.uniform([-1.2, -1.2, -0.4], [1.2, 1.2, -0.3], (SIZE[0] * SIZE[1], 3))  # below all objects
    light = np.array([0.2, -0.4, 1.5])
    offset = np.broadcast_to(light, start.shape) if directional else light - start
    distance = np.linalg.norm(offset, axis=1)
    direction = offset / distance[:, None]
    if directional:
        distance[:] = np.inf
    is_fine = np.isin(mj_model.geom_type, (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD))
    mj_model.geom_group[~is_fine] = 5
    hits = [
        mujoco.mj_ray(mj_model, mj_data, one, way, np.array([1, 1, 1, 1, 1, 0], np.uint8), 1, -1, np.zeros(1, np.int32))
        for one, way in zip(start, direction, strict=True)
    ]
    hidden = (np.array(hits) >= 0.0) & (np.array(hits) < distance)
    axes, position = mj_data.cam_xmat[0].reshape(3, 3), mj_data.cam_xpos[0]
    segments = search.Segments(
        tuple(jnp.asarray(((start - position) @ axes).T, jnp.float32)),
        tuple(jnp.asarray((direction @ axes).T, jnp.float32)),
        jnp.full(len(start), 1e-4),
        jnp.asarray(distance, jnp.float32),
    )
    place = None if directional else jnp.asarray((light - position) @ axes, jnp.float32)
    towards = jnp.asarray(-(light / np.linalg.norm(light)) @ axes, jnp.float32)
    source = Light(directional, False, True, place, towards, *(jnp.ones(3),) * 4, None, None)

    def find(blocked: Any) -> np.ndarray:
        return np.asarray(jaxrl_vis_envs.jit(lambda given: blocked(scene, unit, given, source), runs_once=True)(segments))

    found = {"plain": find(images._PLAIN.blocked), "kernel": find(SEARCH.blocked)}
    assert 0.2 < hidden.mean() < 0.8
    np.testing.assert_array_equal(found["plain"], found["kernel"])
    assert (found["kernel"] == hidden).mean() > 0.998  # the rest: within rounding of an edge


@pytest.mark.parametrize("octant", [0, 5])
def test_hierarchies_hold_every_triangle_once_within_its_boxes(octant: int) -> None:
    scene, _, _ = prepared()
    trees, triangles = jax.tree.map(np.asarray, scene.hierarchies), np.asarray(scene.triangles)
    for number in range(len(trees.first)):
        first = trees.first[number] + octant * trees.steps[number]
        nodes = trees.nodes[first : first + trees.steps[number]]
        leaves = np.flatnonzero(nodes[:, 2] < 0)
        assert len(nodes) == 2 * len(leaves) - 1
        rows = trees.rows[(-1 - nodes[leaves, 2])[:, None] + np.arange(hierarchies.LEAF)]
        real = rows[rows >= 0]
        places = np.asarray(scene.cluster_places)
        clusters = places[places[:, 0] == trees.objects[number], 1]
        held = (clusters[:, None] + np.arange(meshes.CLUSTER)).ravel()
        held = held[np.any(triangles[held, 8:11] != 0.0, axis=1)]  # without padding
        np.testing.assert_array_equal(np.sort(real), np.sort(held))
        low, cell = trees.frame[number, :3], trees.frame[number, 3:]
        corners = (triangles[real, meshes.CORNERS].reshape(-1, 3) - low) / cell
        assert corners.min() > -0.5 and corners.max() < hierarchies.CELLS + 0.5
        # Every leaf lies in the box of every node whose subtree it belongs to.
        for place in (0, len(nodes) // 3):
            end = nodes[place, 2] - first if nodes[place, 2] >= 0 else place + 1
            within = rows[(leaves >= place) & (leaves < end)]
            points = (triangles[within[within >= 0], meshes.CORNERS].reshape(-1, 3) - low) / cell
            shifts = np.array([0, 10, 20])
            lowest, highest = (nodes[place, word] >> shifts & hierarchies.CELLS for word in range(2))
            assert (points >= lowest - 1e-2).all() and (points <= highest + 1e-2).all()


@pytest.mark.parametrize("glass", ["", 'material="glass"'], ids=["opaque", "transparent"])
def test_scenes_with_triangles_are_searched_by_kernels_on_a_gpu(glass: str) -> None:
    scene, _, _ = prepared(glass=glass, haze=True, shadows=True)
    with tracing_for("cuda"):
        with kernels(True):
            assert images._fast(scene, Outputs(rgb=True, depth=True)) is images._draw_walking
            assert images.kernel.can_search(scene)  # its primitives, too
        with kernels(False):
            assert images._fast(scene, Outputs(rgb=True, depth=True)) is None
    with tracing_for("cpu"):
        assert images._fast(scene, Outputs(rgb=True, depth=True)) is images._draw_rasterized


def test_planes_seen_through_from_behind_take_the_plain_search() -> None:
    assert not images.kernel.can_search(prepared(plane_backs=True)[0])


def test_kernels_for_triangles_are_lowered_for_nvidia() -> None:
    with tracing_for("cuda"), kernels(True):
        text = lowered_for_nvidia(search.probe)
    assert "find_triangle" in text and "find_blocker" in text
