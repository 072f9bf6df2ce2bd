"""Search for the nearest triangle: what it may leave out."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxrl_vis_envs
from jaxrl_vis.bench.scenes import clutter
from jaxrl_vis_envs.render import Scene, camera
from jaxrl_vis_envs.render.pixel import blocks, triangles
from jaxrl_vis_envs.render.pixel.prepare import prepare

SIZE = 24


def scene_of_meshes(projection: str) -> tuple[Scene, mujoco.MjData]:
    """A bowl and a ring, one before the other, and a height field, seen by one camera."""
    spec = mujoco.MjSpec()
    camera_ = spec.worldbody.add_camera(pos=[0.0, -0.5, 0.1], quat=[0.7071, 0.7071, 0.0, 0.0], fovy=40.0)
    if projection == "orthographic":
        camera_.proj, camera_.fovy = mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC, 0.3
    for number in (2, 3):
        points, faces = clutter.mesh(number, np.random.default_rng(number))
        spec.add_mesh(name=str(number), uservert=points.ravel(), userface=faces.ravel())
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=str(number),
            pos=[0.1 * number - 0.25, 0.1 * number - 0.3, 0.1],
            quat=[1, 0.5, 0.2, 0],
        )
    heights = np.random.default_rng(0).uniform(0.0, 1.0, 36)
    spec.add_hfield(name="ground", nrow=6, ncol=6, size=[0.3, 0.3, 0.1, 0.05], userdata=heights)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground")
    mj_model = spec.compile()
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    return Scene.from_mjmodel(mj_model, 0, SIZE, SIZE), mj_data


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_bounds_leave_out_clusters_and_no_pixel(projection: str) -> None:
    scene, mj_data = scene_of_meshes(projection)
    unit = prepare(scene, mj_data).unit
    layout = blocks.layout(scene)
    rays = camera.pixel_rays(scene, layout.rows, layout.columns)
    found = triangles.opaque_bounds(scene, unit)
    sides = np.asarray(found.sides)
    kept = (sides[:, 0] <= sides[:, 1]) & (sides[:, 2] <= sides[:, 3])
    assert 0.02 < kept.mean() < 0.6

    def nearest(bounds: triangles.Bounds) -> tuple[jax.Array, jax.Array, jax.Array]:
        far = jnp.full(rays.u.shape[1:], scene.zfar)
        return jax.lax.map(lambda block: triangles.nearest_triangle(scene, unit, block, far, bounds=bounds), rays)

    searched = jaxrl_vis_envs.jit(nearest)
    endless = jnp.tile(jnp.array([-np.inf, np.inf, -np.inf, np.inf]), (len(kept), 1))
    bounded, unbounded = searched(found), searched(triangles.Bounds(endless, jnp.full(len(kept), -np.inf)))
    assert {0, 1, 2} <= set(np.unique(unbounded[2]).tolist())  # each object is seen
    for one, other in zip(bounded, unbounded, strict=True):
        np.testing.assert_array_equal(one, other)


def test_next_cluster_is_the_first_whose_count_exceeds_the_step() -> None:
    counts = np.cumsum(np.random.default_rng(0).integers(0, 2, 77))
    steps = np.arange(counts[-1] + 2)
    found = jax.vmap(lambda step: triangles.kth(jnp.asarray(counts, jnp.int32), step))(jnp.asarray(steps, jnp.int32))
    np.testing.assert_array_equal(found, np.searchsorted(counts, steps, side="right"))
