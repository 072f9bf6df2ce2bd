"""Scenes with triangles on a CPU: rasterisation finds what the plain renderer finds, and the passes render its images."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mesh_scene import prepared
from small_scene import ORTHOGRAPHIC

import jaxrl_vis_envs
from jaxrl_vis_envs.render import Scene, camera, images
from jaxrl_vis_envs.render.cpu import passes, raster
from jaxrl_vis_envs.render.outputs import Outputs, Planes
from jaxrl_vis_envs.render.pixel import blocks, raycast
from jaxrl_vis_envs.render.pixel.prepare import prepare

PANES = """
    <geom name="pane" type="box" size=".3 .02 .3" pos=".2 -.8 .5" rgba=".2 .9 .4 .5"/>
    <geom name="bubble" type="sphere" size=".2" pos=".1 -.9 .5" rgba=".9 .1 .2 .3"/>
"""
MANY = '<geom type="box" size=".02 .02 .02" pos="-.6 -.2 .4"/>' * 30
FACES = Outputs(rgb=True, depth=True, segmentation=True, quantized=True)


def drawn(scene: Scene, poses: SimpleNamespace, outputs: Outputs, missing: int) -> list[Planes]:
    """Draw two images by the chosen way and by the plain one; in the second, the geom ``missing`` has no pose."""
    places = jnp.stack([poses.geom_xpos, poses.geom_xpos.at[missing].set(jnp.nan)])

    def draw(draw: Any) -> Planes:
        def draw_one(geom_xpos: jax.Array) -> Planes:
            return draw(outputs, scene, *prepare(scene, SimpleNamespace(**{**vars(poses), "geom_xpos": geom_xpos})))

        return jaxrl_vis_envs.jit(jax.vmap(draw_one), runs_once=True)(places)

    return [jax.tree.map(np.asarray, draw(one)) for one in (images._fast(scene, outputs), images._draw)]


@pytest.mark.parametrize(
    ("given", "options"),
    [
        ({"more": PANES}, {"textured": True}),
        ({"more": MANY, "lens": ORTHOGRAPHIC}, {"textured": False}),
    ],
    ids=["transparent", "many"],
)
def test_passes_render_meshes_as_the_plain_renderer_does(given: dict[str, str], options: dict[str, Any]) -> None:
    scene, mj_model, poses = prepared(**given, **options)
    later = mj_model.geom("later").id
    assert passes.can_render(scene, FACES) and raycast.has_separate_rows(scene) == (given["more"] == MANY)
    ours, expected = drawn(scene, poses, FACES, later)
    assert len(np.unique(expected.segmentation)) > 15
    assert later in expected.segmentation[0] and later not in expected.segmentation[1]
    np.testing.assert_array_equal(ours.segmentation, expected.segmentation)
    np.testing.assert_allclose(ours.depth, expected.depth, rtol=1e-5)
    colours = images.quantize(expected.rgb) if expected.rgb.dtype != np.uint8 else expected.rgb
    difference = np.abs(ours.rgb.astype(int) - np.asarray(colours, int))
    assert difference.max() <= 1 and difference.mean() <= 0.125
    if given["more"] == PANES:
        assert set(np.unique(expected.segmentation)) >= {mj_model.geom(name).id for name in ("pane", "bubble")}


@pytest.mark.parametrize("lens", ["", ORTHOGRAPHIC], ids=["perspective", "orthographic"])
def test_rasterization_finds_the_triangles_that_the_plain_search_finds(lens: str) -> None:
    """The second of two images lacks one of two meshes that coincide. One mesh is cut by the near plane."""
    scene, mj_model, poses = prepared(lens)
    later, earlier = (scene.object_ids.index(mj_model.geom(name).id) for name in ("later", "earlier"))
    places = jnp.stack([poses.geom_xpos, poses.geom_xpos.at[mj_model.geom("later").id].set(jnp.nan)])
    layout = blocks.layout(scene)

    def find(nearest: Any) -> blocks.Nearest:
        def find_one(geom_xpos: jax.Array) -> blocks.Nearest:
            unit = prepare(scene, SimpleNamespace(**{**vars(poses), "geom_xpos": geom_xpos})).unit
            return nearest(scene, unit, camera.pixel_rays(scene, layout.rows, layout.columns))

        return jax.tree.map(np.asarray, jaxrl_vis_envs.jit(jax.vmap(find_one), runs_once=True)(places))

    ours, expected = find(raster.nearest), find(blocks.nearest)
    np.testing.assert_array_equal(ours.triangle, expected.triangle)
    # An orthographic camera's rays are composed in another order, which may round differently.
    assert np.abs(ours.key - expected.key).max() <= (raycast.code_mask(scene) + 1 if lens else 0)
    rows = ours.key & raycast.code_mask(scene)
    assert (ours.triangle >= 0).mean() > 0.2 and len(np.unique(rows)) > 15
    assert later in rows[0] and earlier not in rows[0] and later not in rows[1] and earlier in rows[1]
    assert scene.object_ids.index(mj_model.geom("close").id) in rows[0]


def test_lists_of_several_images_are_independent() -> None:
    """Cameras, poses and meshes differ along two axes of a batch."""
    scene, _, poses = prepared()
    outputs = Outputs(rgb=False, depth=True)
    fovy = jnp.array([40.0, 25.0, 60.0])
    shift = jnp.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.2]])

    def draw(scene: Scene, shift: jax.Array) -> jax.Array:
        moved = SimpleNamespace(**{**vars(poses), "geom_xpos": poses.geom_xpos + shift})
        return passes.draw(outputs, scene, *prepare(scene, moved)).depth

    def draw_all(fovy: jax.Array, shift: jax.Array, triangles: jax.Array) -> tuple[jax.Array, jax.Array]:
        by_shift = jax.vmap(lambda fovy, shift: draw(scene.replace(fovy=fovy), shift), in_axes=(None, 0))
        by_mesh = jax.vmap(lambda triangles: draw(scene.replace(triangles=triangles), shift[0]))
        return jax.vmap(by_shift, in_axes=(0, None))(fovy, shift), by_mesh(triangles)

    hidden = jnp.zeros_like(scene.triangles).at[:, 11].set(1.0)
    depths, of_meshes = jaxrl_vis_envs.jit(draw_all, runs_once=True)(fovy, shift, jnp.stack([scene.triangles, hidden]))
    one = jaxrl_vis_envs.jit(lambda fovy, shift: draw(scene.replace(fovy=fovy), shift), runs_once=True)
    for row, column in np.ndindex(3, 2):
        np.testing.assert_array_equal(depths[row, column], one(fovy[row], shift[column]))
    assert not np.array_equal(depths[0, 0], depths[0, 1]) and not np.array_equal(depths[0, 0], depths[1, 0])
    assert np.mean(of_meshes[0] < of_meshes[1] - 1e-3) > 0.1  # without triangles, primitives and the sky remain


def test_scenes_that_the_passes_do_not_support_are_only_rasterized() -> None:
    supported = prepared(more=PANES)[0]
    assert passes.can_render(supported, FACES) and raster.can_search(supported)
    for scene in (
        prepared(shadows=True)[0],
        prepared()[0].replace(haze=(0, 0.1)),
        prepared(glass='material="glass"')[0],  # a transparent mesh
        prepared(more=9 * PANES.splitlines()[2].replace('name="bubble" ', ""))[0],
        prepared(plane_backs=True)[0],
    ):
        assert not passes.can_render(scene, FACES) and images._fast(scene, FACES) is images._draw_rasterized
    assert passes.can_render(prepared(shadows=True)[0], Outputs(rgb=False, depth=True))
    assert not passes.can_render(supported, FACES._replace(quantized=False))


def test_gradients_are_those_of_the_plain_renderer() -> None:
    scene, mj_model, poses = prepared()
    lump = mj_model.geom("later").id
    outputs = Outputs(rgb=False, depth=True)

    def depth(way: Any) -> jax.Array:
        def total(y: jax.Array) -> jax.Array:
            moved = poses.geom_xpos.at[lump, 1].set(y)
            given = SimpleNamespace(**{**vars(poses), "geom_xpos": moved})
            return way(outputs, scene, *prepare(scene, given)).depth.sum()

        return jaxrl_vis_envs.jit(jax.grad(total), runs_once=True)(poses.geom_xpos[lump, 1])

    def chosen(outputs: Outputs, *arguments: Any) -> Planes:
        return images._draw_along(images._Path(images._fast(scene, outputs), "cpu"), outputs, *arguments)

    ours = depth(chosen)
    np.testing.assert_allclose(ours, depth(images._draw), rtol=1e-6)
    assert ours > 1.0
