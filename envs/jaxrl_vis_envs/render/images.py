"""Rendering of one environment: `render` for viewing and files, `render_planes` for the hot path. Use `jax.vmap` for a batch.

There are three stages: all linear work, once per environment (`pixel.shapes`, `pixel.lights`); the nearest object of each pixel
(`pixel.raycast`, `pixel.triangles`), an integer that is never differentiated; and, once per pixel, depth, normal and colour of
that object from a row of a table (`pixel.surface`, `pixel.shade`). For most scenes the last two stages are one kernel on a GPU
(`gpu.kernel`), and passes without redundant computation on a CPU (`cpu.passes`). In scenes with meshes or height fields, a
kernel on a GPU searches for their triangles (`gpu.search`), and a CPU rasterises them (`cpu.raster`).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.compiling.compilation import dispatch_by_platform, target_platform, tracing_for
from jaxrl_vis_envs.render import camera, cords
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.cpu import passes, raster
from jaxrl_vis_envs.render.gpu import kernel, search
from jaxrl_vis_envs.render.outputs import Frame, Outputs, Planes
from jaxrl_vis_envs.render.pixel import blocks, lights, lookup, raycast, shade, shapes, surface, transparent, triangles
from jaxrl_vis_envs.render.pixel.prepare import check_poses, prepare
from jaxrl_vis_envs.render.scene import Scene

# Scene leaves that are not float32.
_INTEGERS = {"texels": jnp.uint32, "texture": jnp.int32, "cluster_places": jnp.int32}


class _View(NamedTuple):
    """Quantities computed once per environment.

    Attributes:
        rotation: [3, 3] float32, see `camera.camera_pose`.
        unit: Rendered objects.
        table: `lookup.object_table`.
        lights: Lights, from `lights.pack`.
        blocked: `search.blocked`, or a function of this form.
    """

    rotation: jax.Array
    unit: shapes.UnitShapes
    table: jax.Array
    lights: jax.Array
    blocked: Callable[..., jax.Array]


class _Search(NamedTuple):
    """Search for objects.

    Attributes:
        layout: Order of the pixels.
        nearest: `blocks.nearest`, or a function of this form.
        blocked: `search.blocked`.
    """

    layout: Callable[[Scene], blocks.Layout]
    nearest: Callable[..., blocks.Nearest]
    blocked: Callable[..., jax.Array]


_PLAIN = _Search(blocks.layout, blocks.nearest, search.blocked)
_BY_PIXELS = _Search(blocks.layout, raster.nearest, search.blocked)
_BY_KERNELS = _Search(search.layout, search.nearest, functools.partial(search.blocked, walk=search.traverse_on_gpu))


class _Path(NamedTuple):
    """Rendering path: the fast function (None for `_draw`), and the platform it is traced for."""

    fast: Callable[..., Planes] | None
    platform: str


def render_planes(
    scene: Scene,
    data: Any,
    rgb: bool = True,
    depth: bool = True,
    segmentation: bool = False,
    normals: bool = False,
    distance: bool = False,
    quantized: bool = False,
) -> Planes:
    """Render one environment as planes. Planes that are not requested are not computed.

    Args:
        scene: Scene and camera.
        data: Poses of one environment: `mjx.Data` or `mujoco.MjData` after forward kinematics (`mjx.kinematics` is enough), or
            any object with ``geom_xpos`` [ngeom, 3], ``geom_xmat`` [ngeom, 3, 3] or [ngeom, 9], and likewise ``site_xpos`` and
            ``site_xmat`` if sites are rendered. Cameras and lights attached to, tracking or aiming at bodies also need ``xpos``
            and ``xmat``; those that follow a centre of mass also need ``xipos``. Geoms with a non-finite pose are not rendered.
        rgb: Compute colours.
        depth: Compute the planar depth.
        segmentation: Compute the object id of each pixel.
        normals: Compute surface normals.
        distance: Compute the distance along the rays.
        quantized: Return colours as from `quantize`, [3, H, W] uint8, which is less memory traffic.

    Returns:
        The requested planes.

    Raises:
        ValueError: ``scene`` is not a Scene, or ``data`` has no poses, poses that kinematics has not computed yet (detected for
            concrete arrays, not while tracing), those of several environments, or those of another model.
    """
    outputs = Outputs(rgb, depth, segmentation, normals, distance, quantized)
    check_poses(scene, data, rgb)
    if not any(outputs[:-1]):  # the fast paths cannot render nothing
        return Planes(None, None, None)
    scene = _in_32_bits(scene)
    if rgb and any(path.shows_limits for path in scene.tendon_paths):
        scene = cords.coloured(scene, data)
    if not scene.object_ids:
        return _quantized(outputs, _draw_nothing(scene, data, outputs))

    def draw(scene: Scene, *prepared: Any) -> Planes:
        return _draw_along(_Path(_fast(scene, outputs), target_platform()), outputs, scene, *prepared)

    return dispatch_by_platform(draw, scene, *prepare(scene, data, rgb))


def _in_32_bits(scene: Scene) -> Scene:
    """Convert the leaves, which may be Python numbers or 64-bit arrays, to the dtypes that `Scene` documents."""
    leaves = [field.name for field in dataclasses.fields(scene) if not field.metadata.get("static")]
    leaves.remove("hierarchies")  # built once, never replaced
    dtypes = {name: _INTEGERS.get(name, jnp.float32) for name in leaves}
    return scene.replace(**{name: jnp.asarray(getattr(scene, name), dtype) for name, dtype in dtypes.items()})


def _fast(scene: Scene, outputs: Outputs) -> Callable[..., Planes] | None:
    """Return the fast rendering function for these outputs on the platform being traced for, None if there is none."""
    for path in (kernel, passes):
        if path.can_render(scene, outputs):
            return path.draw
    if raster.can_search(scene):
        return _draw_rasterized
    return _draw_walking if search.can_search(scene) else None


@functools.partial(jax.jit, static_argnums=(0, 1))
def _draw_along(path: _Path, outputs: Outputs, *arguments: Any) -> Planes:
    """Render with ``path``. Jitted so that it is traced only once for all programs that contain it."""
    with tracing_for(path.platform):
        return _draw(outputs, *arguments) if path.fast is None else _draw_fast(path, outputs, *arguments)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _draw_fast(
    path: _Path, outputs: Outputs, scene: Scene, rotation: jax.Array, unit: shapes.UnitShapes, light_table: jax.Array
) -> Planes:
    """Render as `_draw` does, by one GPU kernel or by passes on a CPU, with the derivatives of `_draw`."""
    assert path.fast is not None
    return path.fast(outputs, scene, rotation, unit, light_table)


@_draw_fast.defjvp
def _differentiate(path: _Path, outputs: Outputs, primals: tuple, tangents: tuple) -> tuple[Planes, Planes]:
    with tracing_for(path.platform):
        return jax.jvp(functools.partial(_draw, outputs), primals, tangents)


def _draw_walking(
    outputs: Outputs, scene: Scene, rotation: jax.Array, unit: shapes.UnitShapes, light_table: jax.Array
) -> Planes:
    """Render as `_draw` does, with the nearest objects found by GPU kernels."""
    return _draw(outputs, scene, rotation, unit, light_table, _BY_KERNELS)


def _draw_rasterized(
    outputs: Outputs, scene: Scene, rotation: jax.Array, unit: shapes.UnitShapes, light_table: jax.Array
) -> Planes:
    """Render as `_draw` does, with the nearest triangles found by rasterisation."""
    return _draw(outputs, scene, rotation, unit, light_table, _BY_PIXELS)


def _draw(
    outputs: Outputs,
    scene: Scene,
    rotation: jax.Array,
    unit: shapes.UnitShapes,
    light_table: jax.Array,
    searches: _Search = _PLAIN,
) -> Planes:
    """Render the requested planes of a scene with objects, in plain JAX.

    Args:
        outputs: Requested planes.
        scene: The scene.
        rotation: [3, 3] float32, see `camera.camera_pose`.
        unit: Rendered objects.
        light_table: Lights, from `lights.pack`.
        searches: Search for objects.
    """
    layout = searches.layout(scene)
    rays = camera.pixel_rays(scene, layout.rows, layout.columns)
    # Barrier: XLA would otherwise repeat the per-object work in every pixel.
    unit = camera.barrier(unit)
    beyond_depth = outputs.rgb or outputs.segmentation or outputs.normals
    if not (beyond_depth or blocks.is_tiled(scene) or any(scene.transparent)):
        far = blocks.scan(lambda rays: raycast.nearest_distance(scene, unit, rays), rays)
        depth = length = None
        if outputs.depth:
            depth = blocks.restore(scene, layout, far)
        if outputs.distance:
            along = jnp.where(far < scene.zfar, far * camera.ray_length(scene, rays), scene.zfar)
            length = blocks.restore(scene, layout, along)
        return Planes(None, depth, None, None, length)
    # Barriers: XLA would otherwise search for the nearest object again for each output.
    near = jax.lax.optimization_barrier(searches.nearest(scene, unit, rays))
    rows = lookup.object_table(scene, unit)
    view = _View(rotation, unit, rows, light_table, searches.blocked)
    pixels = (rays, near)
    if near.triangle is None or not any(scene.light_shadows):  # shadows of triangles need pixels that are close together
        pixels = blocks.merge_blocks(pixels)
    planes = blocks.scan(lambda *block: _finish(scene, view, outputs, *block), *pixels)
    planes = jax.lax.optimization_barrier(planes)
    planes = jax.tree.map(lambda plane: blocks.restore(scene, layout, plane), planes)
    vectors = {name: jnp.stack(vector) for name in ("rgb", "normals") if (vector := getattr(planes, name)) is not None}
    return _quantized(outputs, planes._replace(**vectors))


def _finish(scene: Scene, view: _View, outputs: Outputs, rays: Rays, nearest: blocks.Nearest) -> Planes:
    """Compute the requested planes of a block of pixels [P] from their nearest objects; vectors as three components."""
    near, index = raycast.decode(scene, nearest.key, nearest.row)
    hit_mask = index >= 0
    far = near
    colour: Any = None
    normal: Any = None
    length = labels = None
    shown = _declared_last(scene, view, rays, nearest, index) if outputs.segmentation and scene.reordered else index
    if outputs.rgb or outputs.depth or outputs.normals or outputs.distance or any(scene.transparent):
        row = lookup.fetch(view.table, index)
        hit = surface.intersect(scene, row, lookup.fetch_triangle(scene, nearest.triangle), rays, near)
        far = jnp.where(hit_mask, hit.depth, scene.zfar)
        normal = tuple(jnp.where(hit_mask, component, 0.0) for component in hit.normal)
        sheets = transparent.intersect_sheets(scene, view.unit, view.table, rays, far)
        if outputs.rgb:
            blocked = _make_occlusion_test(scene, view, hit_mask) if nearest.triangle is not None else None
            front = shade.shade(scene, view.unit, lights.unpack(scene, view.lights), row, hit, rays, blocked)
            background = shade.sky(scene, view.rotation, rays)
            colour = tuple(jnp.where(hit_mask, one, other) for one, other in zip(front, background, strict=True))
            if scene.haze[0] >= 0:
                colour = shade.haze(scene, view.unit, rays, far, colour)
            colour = transparent.blend(scene, view.unit, view.table, view.lights, sheets, rays, far, colour)
        far, shown, normal = transparent.nearest(sheets, far, shown, normal)
    if outputs.distance:
        length = jnp.where(shown >= 0, far * camera.ray_length(scene, rays), scene.zfar)
    if outputs.segmentation:
        # The extra last entry is the sky's label, selected by index -1.
        labels = jnp.asarray(np.array([*scene.object_ids, -1], np.int32))[shown]
    return Planes(colour, far if outputs.depth else None, labels, normal if outputs.normals else None, length)


def _make_occlusion_test(scene: Scene, view: _View, shown: jax.Array) -> Callable[..., jax.Array]:
    """Return the test for triangles on segments from pixels [P], False unless ``shown``."""

    def blocked(segments: triangles.Segments, light: lights.Light) -> jax.Array:
        return view.blocked(scene, view.unit, segments._replace(farthest=jnp.where(shown, segments.farthest, 0.0)), light)

    return blocked


def _declared_last(scene: Scene, view: _View, rays: Rays, nearest: blocks.Nearest, index: jax.Array) -> jax.Array:
    """Replace rows ``index`` [P] by the reflecting object's row where it coincides with an object declared before it.

    There, MuJoCo renders the colour of the other object, but the segmentation label of the reflecting object.
    """
    mask = raycast.code_mask(scene)
    last = len(scene.object_ids) - 1
    key = raycast.object_key(scene, jax.lax.stop_gradient(view.unit), last, rays, jnp.full_like(nearest.key, -1), mask)
    before = np.append(np.array(scene.object_ids[:-1]) < scene.object_ids[-1], [False, False])  # the object itself, and the sky
    return jnp.where(((key ^ nearest.key) & ~mask == 0) & jnp.asarray(before)[index], last, index)


def _draw_nothing(scene: Scene, data: Any, outputs: Outputs) -> Planes:
    """Render a scene without objects: only sky."""
    shape = (scene.height, scene.width)
    colour = None
    if outputs.rgb:
        rows, columns = np.indices(shape)
        rays = camera.pixel_rays(scene, rows, columns)
        colour = jnp.stack(shade.sky(scene, camera.camera_pose(scene, data)[1], rays))
    far = jnp.broadcast_to(scene.zfar, shape)
    return Planes(
        colour,
        far if outputs.depth else None,
        jnp.full(shape, -1, jnp.int32) if outputs.segmentation else None,
        jnp.zeros((3, *shape), jnp.float32) if outputs.normals else None,
        far if outputs.distance else None,
    )


def _quantized(outputs: Outputs, planes: Planes) -> Planes:
    """Quantize the colours, if requested and not done yet."""
    if not outputs.quantized or planes.rgb is None or planes.rgb.dtype == jnp.uint8:
        return planes
    return planes._replace(rgb=quantize(planes.rgb))


def render(scene: Scene, data: Any, normals: bool = False, distance: bool = False) -> Frame:
    """Render colour, depth and segmentation of one environment. Use `jax.vmap` for a batch.

    Args:
        scene: Scene and camera.
        data: Poses of one environment, as in `render_planes`.
        normals: Also compute surface normals.
        distance: Also compute the distance along the rays.

    Returns:
        The image.

    Raises:
        ValueError: As in `render_planes`.
    """
    planes = render_planes(scene, data, rgb=True, depth=True, segmentation=True, normals=normals, distance=distance)
    assert planes.rgb is not None and planes.depth is not None and planes.segmentation is not None
    channels_last = None if planes.normals is None else jnp.moveaxis(planes.normals, 0, -1)
    return Frame(quantize(jnp.moveaxis(planes.rgb, 0, -1)), planes.depth, planes.segmentation, channels_last, planes.distance)


def quantize(colour: jax.Array) -> jax.Array:
    """Quantize colours in [0, 1] to uint8, rounding to the nearest as OpenGL does; any shape."""
    return jnp.floor(jnp.clip(colour, 0.0, 1.0) * 255.0 + 0.5).astype(jnp.uint8)
