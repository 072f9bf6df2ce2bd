"""Pictures of one environment: `render` for people and files, `render_planes` for the hot path. `jax.vmap` them for a batch."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.render import camera, raycast, shade
from jaxrl_vis_envs.render.scene import Scene


class Frame(NamedTuple):
    """A picture as people and files want it.

    Attributes:
        rgb: [H, W, 3] uint8.
        depth: [H, W] float32, planar metres (distance along the camera's axis), the scene's ``zfar`` for the sky.
        segmentation: [H, W] int32: geom id, ngeom + site id for a site, -1 for the sky.
    """

    rgb: jax.Array
    depth: jax.Array
    segmentation: jax.Array


class Planes(NamedTuple):
    """A picture as the hot path wants it: planes, not quantised, and only those that were asked for.

    Attributes:
        rgb: [3, H, W] float32 in [0, 1], or None.
        depth: [H, W] float32, planar metres, the scene's ``zfar`` for the sky; or None.
        segmentation: [H, W] int32 as in `Frame`, or None.
    """

    rgb: jax.Array | None
    depth: jax.Array | None
    segmentation: jax.Array | None


def render_planes(scene: Scene, data: Any, rgb: bool = True, depth: bool = True, segmentation: bool = False) -> Planes:
    """Draws one environment, as planes. What is not asked for is not computed.

    Args:
        scene: What is drawn, and from which camera.
        data: Poses of one environment: `mjx.Data` or `mujoco.MjData` after forward kinematics, or anything with ``geom_xpos``
            [ngeom, 3], ``geom_xmat`` [ngeom, 3, 3] or [ngeom, 9], and likewise ``cam_xpos``, ``cam_xmat`` and, for the lights,
            ``xpos``, ``xmat``. A geom whose pose is not finite is not drawn.
        rgb: Whether to shade.
        depth: Whether to return the depth.
        segmentation: Whether to say which object each pixel sees.

    Returns:
        The planes that were asked for.
    """
    u, v = camera.pixel_rays(scene)
    position, rotation, finite = camera.camera_pose(scene, data)
    blocks = _block_count(u.shape[0])
    u, v = u.reshape(blocks, -1), v.reshape(blocks, -1)
    if scene.object_ids:
        shapes = raycast.unit_shapes(scene, data, position, rotation, finite)
        # A barrier, because XLA would otherwise redo the work per object in every pixel.
        shapes = jax.lax.optimization_barrier(shapes)
        want_winner = rgb or segmentation
        distance, winner = _by_blocks(lambda u, v: raycast.nearest_hit(scene, shapes, u, v, want_winner), u, v)
    else:
        shapes, distance, winner = None, jnp.broadcast_to(scene.zfar, u.shape), jnp.full(u.shape, -1, jnp.int32)
    shape = (scene.height, scene.width)
    colours = labels = None
    if rgb:
        lights = shade.camera_lights(scene, data, position, rotation)
        # Barriers here too: each of the three colours would otherwise look for the nearest object again, and a stack of them
        # would shade three times.
        distance, winner = jax.lax.optimization_barrier((distance, winner))
        colours = _by_blocks(lambda *pixels: _colour(scene, shapes, lights, rotation, *pixels), u, v, distance, winner)
        colours = jnp.stack(jax.lax.optimization_barrier(colours)).reshape(3, *shape)
    if segmentation:
        # One entry more than there are drawn objects, so that -1 finds the sky's label at the end.
        labels = jnp.asarray(np.array([*scene.object_ids, -1], np.int32))[winner].reshape(shape)
    return Planes(colours, distance.reshape(shape) if depth else None, labels)


def _colour(scene: Scene, shapes: Any, lights: list, rotation: jax.Array, u: Any, v: Any, distance: Any, winner: Any) -> tuple:
    """Colour of every pixel, sky included: three arrays [P] in [0, 1]."""
    background = shade.sky(scene, rotation, u, v)
    if shapes is None:
        return background
    surface = shade.shade(scene, shapes, lights, u, v, distance, winner)
    return tuple(jnp.where(winner >= 0, near, far) for near, far in zip(surface, background, strict=True))


# Pixels of one environment that a CPU works on at a time: what lies between two operations then stays in its cache.
_CPU_BLOCK = 512


def _block_count(pixels: int) -> int:
    """Into how many equal blocks the pixels are cut: 1 on an accelerator, on a CPU so that a block is about `_CPU_BLOCK`.

    XLA drops optimization barriers before it fuses for a CPU, and then computes the nearest hit anew for every use of it (60
    times slower with colour). The boundary of a loop is the one that it respects, so on a CPU there are at least two blocks
    wherever the number of pixels can be divided.
    """
    if jax.default_backend() != "cpu":
        return 1
    counts = [count for count in range(2, max(3, pixels // 64)) if pixels % count == 0]
    return min(counts, key=lambda count: abs(np.log(pixels / count / _CPU_BLOCK)), default=1)


def _by_blocks(function: Callable, *pixels: jax.Array) -> Any:
    """Applies ``function``, which takes and gives arrays [P], to arrays [blocks, P], block by block."""
    if pixels[0].shape[0] == 1:
        return jax.tree.map(lambda plane: plane[None], function(*(plane[0] for plane in pixels)))
    return jax.lax.scan(lambda carry, block: (carry, function(*block)), None, pixels)[1]


def render(scene: Scene, data: Any) -> Frame:
    """Draws one environment: colour, depth and segmentation. `jax.vmap` it for a batch.

    Args:
        scene: What is drawn, and from which camera.
        data: Poses of one environment, as in `render_planes`.

    Returns:
        The frame.
    """
    planes = render_planes(scene, data, rgb=True, depth=True, segmentation=True)
    assert planes.rgb is not None and planes.depth is not None and planes.segmentation is not None
    return Frame(quantize(jnp.moveaxis(planes.rgb, 0, -1)), planes.depth, planes.segmentation)


def quantize(colour: jax.Array) -> jax.Array:
    """Colours in [0, 1] as uint8, rounded to the nearest as OpenGL does; any shape."""
    return jnp.floor(jnp.clip(colour, 0.0, 1.0) * 255.0 + 0.5).astype(jnp.uint8)
