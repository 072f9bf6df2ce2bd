"""GPU kernel that searches for triangles finds what the plain renderer finds; run by Pallas's interpreter, without a GPU."""

import functools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from nvidia import lowered_for_nvidia
from small_scene import ORTHOGRAPHIC

import jaxrl_vis_envs
from jaxrl_vis.bench.scenes import clutter
from jaxrl_vis_envs.compiling.compilation import kernels, tracing_for
from jaxrl_vis_envs.render import Scene, images
from jaxrl_vis_envs.render.gpu import search
from jaxrl_vis_envs.render.model import hierarchies, meshes
from jaxrl_vis_envs.render.outputs import Outputs, Planes
from jaxrl_vis_envs.render.pixel.prepare import prepare

SIZE = (21, 30)  # tiles hang over the image
KERNEL = functools.partial(search.by_kernel, interpret=True)
SEARCH = images._Search(
    search.layout, functools.partial(search.nearest, interpret=True), functools.partial(search.blocked, walk=KERNEL)
)
ARM = ("sphere", "capsule", "box")

_SCENE = """
<mujoco>
  <visual><headlight active="0"/></visual>
  <asset>
    <texture name="checks" type="2d" builtin="checker" rgb1=".9 .8 .6" rgb2=".2 .3 .5" width="32" height="32"/>
    <material name="checks" texture="checks"/><material name="glass" rgba=".2 .9 .4 .5"/>
    <mesh name="tetra" vertex="0 0 0  .2 0 0  0 .2 0  0 0 .2"/>
    <hfield name="ground" nrow="3" ncol="3" size=".4 .3 .2 .1" elevation="0 1 0 1 2 1 0 1 0"/>
  </asset>
  <worldbody>
    <camera name="front" pos="0 -1.6 .9" xyaxes="1 0 0 0 .5 .87" {lens}/>
    <light type="directional" dir=".5 .6 -1" ambient=".3 .3 .3" diffuse=".5 .4 .3" castshadow="true"/>
    <geom type="plane" size="3 3 .1" material="checks"/>
    <geom type="capsule" size=".06 .2" pos="-.4 0 .2" euler="60 0 20" rgba="1 0 0 1"/>
    <geom type="box" size=".1 .1 .1" pos=".5 -.3 .1" rgba="0 0 1 1"/>
    <geom type="hfield" hfield="ground" pos=".3 .6 .2" rgba=".5 .8 .3 1"/>
    <geom type="sphere" size=".1" pos="0 .1 .7" {glass}/>
    <geom name="veil" type="mesh" mesh="tetra" pos="-.4 -1 .6" {glass}/>
  </worldbody>
</mujoco>
"""


def spec_of_scene(lens: str, glass: str) -> mujoco.MjSpec:
    """Build a scene of primitives and a height field, 40 meshes, one around the near plane, and two that coincide."""
    spec = mujoco.MjSpec.from_string(_SCENE.format(lens=lens, glass=glass))
    rng = np.random.default_rng(0)
    for number in range(4):
        points, faces = clutter.mesh(number, rng)
        kept = np.unique(faces[::3])  # some of the corners, of which MuJoCo takes the hull
        spec.add_mesh(name=f"lump{number}", uservert=3.0 * points[kept[::40]].ravel())
    kind = mujoco.mjtGeom.mjGEOM_MESH
    for index in range(37):
        turn, place = rng.normal(size=4), [*rng.uniform(-0.7, 0.7, 2), rng.uniform(0.1, 0.6)]
        quat, rgba = turn / np.linalg.norm(turn), [*rng.uniform(0.2, 1.0, 3), 1.0]
        spec.worldbody.add_geom(type=kind, meshname=f"lump{index % 4}", pos=place, quat=quat, rgba=rgba)
    for name in ("earlier", "later"):
        spec.worldbody.add_geom(name=name, type=kind, meshname="lump0", pos=[0.0, -0.9, 0.3])
    spec.worldbody.add_geom(name="close", type=kind, meshname="tetra", pos=[0.02, -1.56, 0.84])
    return spec


def prepared(lens: str = "", glass: str = "", **options: Any) -> tuple[Scene, mujoco.MjModel, SimpleNamespace]:
    mj_model = spec_of_scene(lens, glass).compile()
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    poses = {name: jnp.asarray(getattr(mj_data, name), jnp.float32) for name in ("geom_xpos", "geom_xmat", "xpos", "xmat")}
    return Scene.from_mjmodel(mj_model, "front", *SIZE, **options), mj_model, SimpleNamespace(**poses)


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


def test_kernel_finds_the_shadows_that_rays_of_mujoco_find() -> None:
    scene, mj_model, _ = prepared()
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    unit = prepare(scene, mj_data).unit
    rng = np.random.default_rng(1)
    start = rng.uniform([-1.2, -1.2, -0.4], [1.2, 1.2, -0.3], (SIZE[0] * SIZE[1], 3))  # below all objects
    light = np.array([0.2, -0.4, 1.5])
    distance = np.linalg.norm(light - start, axis=1)
    direction = (light - start) / distance[:, None]
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
    found = {
        name: np.asarray(jaxrl_vis_envs.jit(functools.partial(blocked, scene, unit), runs_once=True)(segments))
        for name, blocked in (("plain", images._PLAIN.blocked), ("kernel", SEARCH.blocked))
    }
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
        assert images._fast(scene, Outputs(rgb=True, depth=True)) is None


def test_planes_seen_through_from_behind_take_the_plain_search() -> None:
    assert not images.kernel.can_search(prepared(plane_backs=True)[0])


def test_kernels_for_triangles_are_lowered_for_nvidia() -> None:
    with tracing_for("cuda"), kernels(True):
        text = lowered_for_nvidia(search.probe_program)
    assert "find_triangle" in text and "find_blocker" in text
