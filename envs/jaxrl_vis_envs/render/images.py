"""Images of one environment: `render` for people and files, `render_planes` for the hot path. `jax.vmap` them for a batch.

Three steps: once per environment, everything linear (`shapes`, `lights`); per pixel, which object is nearest (`raycast`,
`triangles`), which gives integers and is never differentiated; per pixel, once, depth, normal and colour of that object from
the row of a table (`surface`, `shade`). For most scenes the last two are one kernel on a GPU (`gpu_kernel`), and passes that do
nothing twice on a CPU (`cpu_passes`).
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import blocks, camera, cpu_passes, gpu_kernel, lights, raycast, shade, shapes, surface, transparent
from jaxrl_vis_envs.render.scene import Scene


class Frame(NamedTuple):
    """An image as people and files want it.

    Attributes:
        rgb: [H, W, 3] uint8.
        depth: [H, W] float32, planar metres (distance along the camera's axis), the scene's ``zfar`` for the sky.
        segmentation: [H, W] int32: geom id, ngeom + site id for a site, -1 for the sky.
        normals: [H, W, 3] float32, unit, in the camera's frame (x right, y up, z towards the viewer), 0 for the sky; or None.
        distance: [H, W] float32, metres along the ray, ``zfar`` for the sky; or None.
    """

    rgb: jax.Array
    depth: jax.Array
    segmentation: jax.Array
    normals: jax.Array | None = None
    distance: jax.Array | None = None


class Planes(NamedTuple):
    """An image as the hot path wants it: planes, not quantised, and only those that were asked for.

    Attributes:
        rgb: [3, H, W] float32 in [0, 1], or uint8 where that was asked for; or None.
        depth: [H, W] float32 as in `Frame`, or None.
        segmentation: [H, W] int32 as in `Frame`, or None.
        normals: [3, H, W] float32 as in `Frame`, or None.
        distance: [H, W] float32 as in `Frame`, or None.
    """

    rgb: jax.Array | None
    depth: jax.Array | None
    segmentation: jax.Array | None
    normals: jax.Array | None = None
    distance: jax.Array | None = None


class _View(NamedTuple):
    """What is prepared once per environment."""

    rotation: jax.Array
    unit: shapes.UnitShapes
    table: jax.Array
    lights: list[lights.Light]


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
        data: Poses of one environment: `mjx.Data` or `mujoco.MjData` after forward kinematics, or anything with ``geom_xpos``
            [ngeom, 3], ``geom_xmat`` [ngeom, 3, 3] or [ngeom, 9], and likewise ``cam_xpos``, ``cam_xmat`` and, for the lights,
            ``xpos``, ``xmat``. A geom whose pose is not finite is not drawn.
        rgb: Whether to shade.
        depth: Whether to return the planar depth.
        segmentation: Whether to say which object each pixel sees.
        normals: Whether to return the normals of the surfaces.
        distance: Whether to return the depth along the rays.
        quantized: Whether to return the colours as `quantize` makes them, [3, H, W] uint8: less to write.

    Returns:
        The planes that were asked for.
    """
    wanted = (rgb, depth, segmentation, normals, distance)
    if not scene.object_ids:
        planes = _draw_nothing(scene, data, wanted)
    else:
        position, rotation, finite = camera.camera_pose(scene, data)
        unit = shapes.unit_shapes(scene, data, position, rotation, finite)
        table = lights.pack(lights.camera_lights(scene, data, position, rotation) if rgb else [])
        outputs = (wanted, quantized)
        planes = _drawn(_fast_way(scene, outputs), outputs, scene, rotation, unit, table)
    if quantized and planes.rgb is not None and planes.rgb.dtype != jnp.uint8:
        planes = planes._replace(rgb=quantize(planes.rgb))
    return planes


def _fast_way(scene: Scene, outputs: tuple) -> Any:
    """The module that draws these outputs of a scene faster than `_draw`, if there is one for this device."""
    (rgb, _, _, normals, distance), quantized = outputs
    if gpu_kernel.takes(scene):
        return gpu_kernel
    if (quantized or not rgb) and not (normals or distance) and cpu_passes.takes(scene):
        return cpu_passes
    return None


@functools.partial(jax.jit, static_argnums=(0, 1))
def _drawn(way: Any, outputs: tuple, *arguments: Any) -> Planes:
    """`_draw`, in the faster way that there is, if any. Jitted so that it is traced once, in however many programs it is."""
    return _draw(outputs, *arguments) if way is None else _draw_fast(way, outputs, *arguments)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _draw_fast(
    way: Any, outputs: tuple, scene: Scene, rotation: jax.Array, unit: shapes.UnitShapes, light_table: jax.Array
) -> Planes:
    """`_draw` as one GPU kernel, or as passes on a CPU (``way`` is the module), with the derivatives of `_draw`."""
    (rgb, depth, segmentation, normals, distance), quantized = outputs
    wanted = (rgb, depth, normals, distance, segmentation)
    colour, near, normal, length, labels = way.draw(wanted, quantized, scene, rotation, unit, light_table)
    return Planes(colour, near, labels, normal, length)


@_draw_fast.defjvp
def _differentiate(way: Any, outputs: tuple, primals: tuple, tangents: tuple) -> tuple[Planes, Planes]:
    return jax.jvp(functools.partial(_draw, outputs), primals, tangents)


def _draw(outputs: tuple, scene: Scene, rotation: jax.Array, unit: shapes.UnitShapes, light_table: jax.Array) -> Planes:
    """The wanted planes of a scene with objects.

    Args:
        outputs: Which planes, as `render_planes` takes them, and whether colours are bytes.
        scene: The scene.
        rotation: [3, 3] float32, see `camera.camera_pose`.
        unit: The drawn objects.
        light_table: From `lights.pack`.
    """
    (rgb, depth, segmentation, normals, distance), quantized = outputs
    layout = blocks.layout(scene)
    u, v = camera.pixel_rays(scene, layout.rows, layout.columns)
    # A barrier, because XLA would otherwise redo the work per object in every pixel.
    unit = _barrier(unit)
    if not (rgb or segmentation or normals or blocks.tiled(scene) or any(scene.transparent)):
        far = blocks.scan(lambda u, v: raycast.nearest_distance(scene, unit, u, v), u, v)
        near = length = None
        if depth:
            near = blocks.restore(scene, layout, far)
        if distance:
            along = jnp.where(far < scene.zfar, far * _ray_length(scene, u, v), scene.zfar)
            length = blocks.restore(scene, layout, along)
        return Planes(None, near, None, None, length)
    key, triangle = blocks.nearest(scene, unit, u, v)
    # Barriers here too: each output would otherwise look for the nearest object again.
    key, triangle = jax.lax.optimization_barrier((key, triangle))
    view = _View(rotation, unit, surface.object_table(scene, unit), lights.unpack(scene, light_table) if rgb else [])
    pixels = blocks.joined((u, v, key, triangle))
    planes = blocks.scan(lambda *block: _finish(scene, view, outputs[0], *block), *pixels)
    planes = jax.lax.optimization_barrier(planes)
    planes = _collect(outputs[0], [blocks.restore(scene, layout, plane) for plane in planes])
    return planes._replace(rgb=quantize(planes.rgb)) if quantized and planes.rgb is not None else planes


@jax.custom_jvp
def _barrier(tree: Any) -> Any:
    """What XLA computes once, and not again for every use. JAX 0.11 cannot transpose its own."""
    return jax.lax.optimization_barrier(tree)


@_barrier.defjvp
def _barrier_tangents(primals: tuple, tangents: tuple) -> tuple:
    return _barrier(*primals), tangents[0]


def _finish(scene: Scene, view: _View, wanted: tuple, u: Any, v: Any, key: Any, triangle: Any) -> tuple:
    """Everything about a block of pixels whose nearest objects are known: the wanted planes, [P] each, one after the other."""
    rgb, depth, segmentation, normals, distance = wanted
    near, index = raycast.decode(scene, key)
    sees = index >= 0
    planes: list[jax.Array] = []
    far = near
    normal: tuple = ()
    if rgb or depth or normals or distance or any(scene.transparent):
        row = surface.fetch(view.table, index)
        hit = surface.meet(scene, row, surface.fetch_triangle(scene, triangle), u, v, near)
        far = jnp.where(sees, hit.depth, scene.zfar)
        normal = tuple(jnp.where(sees, component, 0.0) for component in hit.normal)
        sheets = transparent.sheets(scene, view.unit, view.table, u, v, far)
        if rgb:
            colour = shade.shade(scene, view.unit, view.lights, row, hit, u, v)
            background = shade.sky(scene, view.rotation, u, v)
            colour = tuple(jnp.where(sees, front, back) for front, back in zip(colour, background, strict=True))
            if scene.haze[0] >= 0:
                colour = shade.haze(scene, view.unit, u, v, far, colour)
            planes.extend(transparent.blend(scene, view.unit, view.lights, sheets, u, v, colour))
        far, index, normal = transparent.nearest(sheets, far, index, normal)
    if depth:
        planes.append(far)
    if normals:
        planes.extend(normal)
    if distance:
        planes.append(jnp.where(index >= 0, far * _ray_length(scene, u, v), scene.zfar))
    if segmentation:
        # One entry more than there are drawn objects, so that -1 finds the sky's label at the end.
        planes.append(jnp.asarray(np.array([*scene.object_ids, -1], np.int32))[index])
    return tuple(planes)


def _collect(wanted: tuple, planes: list[jax.Array]) -> Planes:
    """Sorts the planes of `_finish`, [H, W] each, into `Planes`."""
    rgb, depth, segmentation, normals, distance = wanted
    left = list(planes)

    def take(want: bool, count: int = 1) -> jax.Array | None:
        if not want:
            return None
        taken = [left.pop(0) for _ in range(count)]
        return jnp.stack(taken) if count > 1 else taken[0]

    colour, near, normal, length = take(rgb, 3), take(depth), take(normals, 3), take(distance)
    return Planes(colour, near, take(segmentation), normal, length)


def _draw_nothing(scene: Scene, data: Any, wanted: tuple) -> Planes:
    """A scene without objects: sky."""
    rgb, depth, segmentation, normals, distance = wanted
    shape = (scene.height, scene.width)
    colour = None
    if rgb:
        rows, columns = np.indices(shape)
        u, v = camera.pixel_rays(scene, rows, columns)
        colour = jnp.stack(shade.sky(scene, camera.camera_pose(scene, data)[1], u, v))
    far = jnp.broadcast_to(scene.zfar, shape)
    return Planes(
        colour,
        far if depth else None,
        jnp.full(shape, -1, jnp.int32) if segmentation else None,
        jnp.zeros((3, *shape)) if normals else None,
        far if distance else None,
    )


def _ray_length(scene: Scene, u: jax.Array, v: jax.Array) -> jax.Array | float:
    """Metres along the ray for each metre of depth."""
    return 1.0 if scene.projection == "orthographic" else jnp.sqrt(u * u + v * v + 1.0)


def render(scene: Scene, data: Any, normals: bool = False, distance: bool = False) -> Frame:
    """Draws one environment: colour, depth and segmentation. `jax.vmap` it for a batch.

    Args:
        scene: What is drawn, and from which camera.
        data: Poses of one environment, as in `render_planes`.
        normals: Whether to return the normals of the surfaces too.
        distance: Whether to return the depth along the rays too.

    Returns:
        The frame.
    """
    planes = render_planes(scene, data, rgb=True, depth=True, segmentation=True, normals=normals, distance=distance)
    assert planes.rgb is not None and planes.depth is not None and planes.segmentation is not None
    upright = None if planes.normals is None else jnp.moveaxis(planes.normals, 0, -1)
    return Frame(quantize(jnp.moveaxis(planes.rgb, 0, -1)), planes.depth, planes.segmentation, upright, planes.distance)


def quantize(colour: jax.Array) -> jax.Array:
    """Colours in [0, 1] as uint8, rounded to the nearest as OpenGL does; any shape."""
    return jnp.floor(jnp.clip(colour, 0.0, 1.0) * 255.0 + 0.5).astype(jnp.uint8)
