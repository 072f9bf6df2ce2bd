"""Images of one environment: `render` for people and files, `render_planes` for the hot path. `jax.vmap` them for a batch.

Three steps: once per environment, everything linear (`pixel.shapes`, `pixel.lights`); per pixel, which object is nearest
(`pixel.raycast`, `pixel.triangles`), which gives integers and is never differentiated; per pixel, once, depth, normal and
colour of that object from the row of a table (`pixel.surface`, `pixel.shade`). For most scenes the last two are one kernel on a
GPU (`gpu.kernel`), and passes that compute nothing twice on a CPU (`cpu.passes`).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.compiling.compilation import dispatch_by_platform, target_platform, tracing_for
from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.camera import Rays
from jaxrl_vis_envs.render.cpu import passes
from jaxrl_vis_envs.render.gpu import kernel
from jaxrl_vis_envs.render.outputs import Frame, Outputs, Planes
from jaxrl_vis_envs.render.pixel import blocks, lights, lookup, raycast, shade, shapes, surface, transparent
from jaxrl_vis_envs.render.pixel.prepare import check_poses, prepare
from jaxrl_vis_envs.render.scene import Scene

# Leaves of a scene that are not float32.
_INTEGERS = {"texels": jnp.uint32, "cluster_places": jnp.int32}


class _View(NamedTuple):
    """What is prepared once per environment."""

    rotation: jax.Array
    unit: shapes.UnitShapes
    table: jax.Array
    lights: jax.Array


class _Path(NamedTuple):
    """How planes are drawn: by which fast function (None: by `_draw`), and for which platform."""

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
    """Draws one environment, as planes. What is not asked for is not computed.

    Args:
        scene: What is drawn, and from which camera.
        data: Poses of one environment: `mjx.Data` or `mujoco.MjData` after forward kinematics (`mjx.kinematics` is enough), or
            anything with ``geom_xpos`` [ngeom, 3], ``geom_xmat`` [ngeom, 3, 3] or [ngeom, 9], and likewise ``site_xpos``,
            ``site_xmat`` where sites are drawn. Cameras and lights are placed from the bodies: those that ride on one, follow
            it or aim at it need ``xpos`` and ``xmat``, those of a centre of mass ``xipos``. A geom whose pose is not finite is
            not drawn.
        rgb: Whether to shade.
        depth: Whether to return the planar depth.
        segmentation: Whether to say which object each pixel sees.
        normals: Whether to return the normals of the surfaces.
        distance: Whether to return the depth along the rays.
        quantized: Whether to return the colours as `quantize` makes them, [3, H, W] uint8: less to write.

    Returns:
        The planes that were asked for.

    Raises:
        ValueError: ``scene`` is no scene, or ``data`` has no poses, none that kinematics have filled in (which is seen where
            they are numbers, not in a function that is being traced), those of several environments, or those of another model.
    """
    outputs = Outputs(rgb, depth, segmentation, normals, distance, quantized)
    check_poses(scene, data, rgb)
    if not any(outputs[:-1]):  # the fast ways draw something in any case
        return Planes(None, None, None)
    scene = _in_32_bits(scene)
    if not scene.object_ids:
        return _quantized(outputs, _draw_nothing(scene, data, outputs))

    def draw(scene: Scene, *prepared: Any) -> Planes:
        return _drawn(_Path(_fast(scene, outputs), target_platform()), outputs, scene, *prepared)

    return dispatch_by_platform(draw, scene, *prepare(scene, data, rgb))


def _in_32_bits(scene: Scene) -> Scene:
    """The scene with leaves as `Scene` states them, whatever it was given: numbers, or the 64 bits that JAX may compute in."""
    leaves = [field.name for field in dataclasses.fields(scene) if not field.metadata.get("static")]
    dtypes = {name: _INTEGERS.get(name, jnp.float32) for name in leaves}
    return scene.replace(**{name: jnp.asarray(getattr(scene, name), dtype) for name, dtype in dtypes.items()})


def _fast(scene: Scene, outputs: Outputs) -> Callable[..., Planes] | None:
    """What draws these outputs of a scene faster than `_draw` on the platform that is being traced for, if anything does."""
    for path in (kernel, passes):
        if path.takes(scene, outputs):
            return path.draw
    return None


@functools.partial(jax.jit, static_argnums=(0, 1))
def _drawn(path: _Path, outputs: Outputs, *arguments: Any) -> Planes:
    """The planes, drawn as ``path`` says. Jitted so that it is traced once, in however many programs it is."""
    with tracing_for(path.platform):
        return _draw(outputs, *arguments) if path.fast is None else _draw_fast(path, outputs, *arguments)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _draw_fast(
    path: _Path, outputs: Outputs, scene: Scene, rotation: jax.Array, unit: shapes.UnitShapes, light_table: jax.Array
) -> Planes:
    """`_draw` as one GPU kernel, or as passes on a CPU, with the derivatives of `_draw`."""
    assert path.fast is not None
    return path.fast(outputs, scene, rotation, unit, light_table)


@_draw_fast.defjvp
def _differentiate(path: _Path, outputs: Outputs, primals: tuple, tangents: tuple) -> tuple[Planes, Planes]:
    with tracing_for(path.platform):
        return jax.jvp(functools.partial(_draw, outputs), primals, tangents)


def _draw(outputs: Outputs, scene: Scene, rotation: jax.Array, unit: shapes.UnitShapes, light_table: jax.Array) -> Planes:
    """The wanted planes of a scene with objects, in plain JAX.

    Args:
        outputs: Which planes, and whether colours are bytes.
        scene: The scene.
        rotation: [3, 3] float32, see `camera.camera_pose`.
        unit: The drawn objects.
        light_table: From `lights.pack`.
    """
    layout = blocks.layout(scene)
    rays = camera.pixel_rays(scene, layout.rows, layout.columns)
    # A barrier, because XLA would otherwise redo the work per object in every pixel.
    unit = camera.barrier(unit)
    beyond_depth = outputs.rgb or outputs.segmentation or outputs.normals
    if not (beyond_depth or blocks.tiled(scene) or any(scene.transparent)):
        far = blocks.scan(lambda rays: raycast.nearest_distance(scene, unit, rays), rays)
        depth = length = None
        if outputs.depth:
            depth = blocks.restore(scene, layout, far)
        if outputs.distance:
            along = jnp.where(far < scene.zfar, far * camera.ray_length(scene, rays), scene.zfar)
            length = blocks.restore(scene, layout, along)
        return Planes(None, depth, None, None, length)
    # Barriers here too: each output would otherwise look for the nearest object again.
    near = jax.lax.optimization_barrier(blocks.nearest(scene, unit, rays))
    rows = lookup.object_table(scene, unit)
    view = _View(rotation, unit, rows, light_table)
    pixels = blocks.joined((rays, near))
    planes = blocks.scan(lambda *block: _finish(scene, view, outputs, *block), *pixels)
    planes = jax.lax.optimization_barrier(planes)
    planes = jax.tree.map(lambda plane: blocks.restore(scene, layout, plane), planes)
    vectors = {name: jnp.stack(vector) for name in ("rgb", "normals") if (vector := getattr(planes, name)) is not None}
    return _quantized(outputs, planes._replace(**vectors))


def _finish(scene: Scene, view: _View, outputs: Outputs, rays: Rays, nearest: blocks.Nearest) -> Planes:
    """The wanted planes of a block of pixels whose nearest objects are known, [P] each; colours and normals in three."""
    near, index = raycast.decode(scene, nearest.key, nearest.row)
    sees = index >= 0
    far = near
    colour: Any = None
    normal: Any = None
    length = labels = None
    shown = _declared_last(scene, view, rays, nearest, index) if outputs.segmentation and scene.reordered else index
    if outputs.rgb or outputs.depth or outputs.normals or outputs.distance or any(scene.transparent):
        row = lookup.fetch(view.table, index)
        hit = surface.meet(scene, row, lookup.fetch_triangle(scene, nearest.triangle), rays, near)
        far = jnp.where(sees, hit.depth, scene.zfar)
        normal = tuple(jnp.where(sees, component, 0.0) for component in hit.normal)
        sheets = transparent.sheets(scene, view.unit, view.table, rays, far)
        if outputs.rgb:
            front = shade.shade(scene, view.unit, lights.unpack(scene, view.lights), row, hit, rays)
            background = shade.sky(scene, view.rotation, rays)
            colour = tuple(jnp.where(sees, one, other) for one, other in zip(front, background, strict=True))
            if scene.haze[0] >= 0:
                colour = shade.haze(scene, view.unit, rays, far, colour)
            colour = transparent.blend(scene, view.unit, view.table, view.lights, sheets, rays, far, colour)
        far, shown, normal = transparent.nearest(sheets, far, shown, normal)
    if outputs.distance:
        length = jnp.where(shown >= 0, far * camera.ray_length(scene, rays), scene.zfar)
    if outputs.segmentation:
        # One entry more than there are drawn objects, so that -1 finds the sky's label at the end.
        labels = jnp.asarray(np.array([*scene.object_ids, -1], np.int32))[shown]
    return Planes(colour, far if outputs.depth else None, labels, normal if outputs.normals else None, length)


def _declared_last(scene: Scene, view: _View, rays: Rays, nearest: blocks.Nearest, index: jax.Array) -> jax.Array:
    """The rows ``index`` [P], but of the object that reflects where it coincides with one that comes before it in the model.

    MuJoCo's colours are those of the other one there, and its labels are not.
    """
    mask = raycast.code_mask(scene)
    last = len(scene.object_ids) - 1
    key = raycast.object_key(scene, jax.lax.stop_gradient(view.unit), last, rays, jnp.full_like(nearest.key, -1), mask)
    before = np.append(np.array(scene.object_ids[:-1]) < scene.object_ids[-1], [False, False])  # itself, and the sky
    return jnp.where(((key ^ nearest.key) & ~mask == 0) & jnp.asarray(before)[index], last, index)


def _draw_nothing(scene: Scene, data: Any, outputs: Outputs) -> Planes:
    """A scene without objects: sky."""
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
    """With colours as bytes, if they are asked for and are not yet."""
    if not outputs.quantized or planes.rgb is None or planes.rgb.dtype == jnp.uint8:
        return planes
    return planes._replace(rgb=quantize(planes.rgb))


def render(scene: Scene, data: Any, normals: bool = False, distance: bool = False) -> Frame:
    """Draws one environment: colour, depth and segmentation. `jax.vmap` it for a batch.

    Args:
        scene: What is drawn, and from which camera.
        data: Poses of one environment, as in `render_planes`.
        normals: Whether to return the normals of the surfaces too.
        distance: Whether to return the depth along the rays too.

    Returns:
        The frame.

    Raises:
        ValueError: As `render_planes`.
    """
    planes = render_planes(scene, data, rgb=True, depth=True, segmentation=True, normals=normals, distance=distance)
    assert planes.rgb is not None and planes.depth is not None and planes.segmentation is not None
    upright = None if planes.normals is None else jnp.moveaxis(planes.normals, 0, -1)
    return Frame(quantize(jnp.moveaxis(planes.rgb, 0, -1)), planes.depth, planes.segmentation, upright, planes.distance)


def quantize(colour: jax.Array) -> jax.Array:
    """Colours in [0, 1] as uint8, rounded to the nearest as OpenGL does; any shape."""
    return jnp.floor(jnp.clip(colour, 0.0, 1.0) * 255.0 + 0.5).astype(jnp.uint8)
