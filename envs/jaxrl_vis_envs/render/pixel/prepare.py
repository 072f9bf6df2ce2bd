"""Work done once per environment, before any pixel: camera pose, unit shapes and lights in the camera's frame."""

import functools
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.pixel import lights, shapes
from jaxrl_vis_envs.render.scene import Scene

_POSES = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "xpos", "xmat", "xipos")


class Prepared(NamedTuple):
    """Inputs of the per-pixel stages, besides the scene.

    Attributes:
        rotation: [3, 3] float32, see `camera.camera_pose`.
        unit: Rendered objects.
        lights: Lights from `lights.pack`; empty without shading.
    """

    rotation: jax.Array
    unit: shapes.UnitShapes
    lights: jax.Array


def prepare(scene: Scene, data: Any, rgb: bool = True) -> Prepared:
    """Compute the inputs of the per-pixel stages for one environment.

    Args:
        scene: The scene.
        data: Poses of one environment, as in `render_planes`.
        rgb: True if colours are rendered.
    """
    return _prepare(rgb, scene, {name: getattr(data, name) for name in _POSES if hasattr(data, name)})


def check_poses(scene: Any, data: Any, rgb: bool) -> None:
    """Check scene and poses, because JAX would silently substitute the last geom's pose for missing ones.

    Args:
        scene: The scene.
        data: Poses, see `render_planes`.
        rgb: True if colours are rendered.

    Raises:
        ValueError: ``scene`` is not a Scene, or ``data`` has no poses, poses that kinematics has not computed yet, those of
            several environments, or those of another model.
    """
    if not isinstance(scene, Scene):
        raise ValueError(
            f"the scene, from Scene.from_mjmodel(mj_model), comes first, before the data; got {type(scene).__name__}"
        )
    if scene.object_ids:
        _check_kind(data, "geom_", scene.geom_count, is_exact=True)
    if any(index >= scene.geom_count for index in scene.object_ids):
        _check_kind(data, "site_", scene.site_count, is_exact=True)
    mounts = (scene.camera_mount, *(scene.light_mounts if rgb else ()))
    last_posed_body = max(mount.last_posed_body for mount in mounts)
    if last_posed_body > 0:
        _check_kind(data, "", last_posed_body + 1)
    if any(mount.weighed_body >= 0 for mount in mounts):
        _check_array(data, "xipos", ((3,),), len(scene.body_parents), is_exact=True)
    if scene.object_ids:
        _check_filled(data)


def _check_kind(data: Any, kind: str, count: int, is_exact: bool = False) -> None:
    """Check that ``data`` has poses of ``count`` objects of a kind, or of at least that many unless ``is_exact``."""
    _check_array(data, f"{kind}xpos", ((3,),), count, is_exact)
    _check_array(data, f"{kind}xmat", ((3, 3), (9,)), count, is_exact)


def _check_array(data: Any, name: str, row_shapes: tuple[tuple[int, ...], ...], count: int, is_exact: bool) -> None:
    """Check that ``data`` has an array ``name`` of ``count`` rows (at least that many unless ``is_exact``) of a valid shape."""
    if not hasattr(data, name):
        hint = ", such as state.data" if hasattr(getattr(data, "data", None), name) else ""
        raise ValueError(f"poses are read from mjx.Data or mujoco.MjData{hint}; {type(data).__name__} has no {name}")
    shape = np.shape(getattr(data, name))
    if shape[1:] not in row_shapes:
        expected = (count if is_exact else "...", *row_shapes[0])
        raise ValueError(f"{name} of one environment has the shape {expected}, got {shape}; jax.vmap over a batch")
    if shape[0] < count or (is_exact and shape[0] != count):
        minimum = "" if is_exact else "at least "
        raise ValueError(f"{name} holds {shape[0]} poses and the scene's model has {minimum}{count}: the models differ")


def _check_filled(data: Any) -> None:
    """Check that concrete poses have been computed: rotation matrices are never all zeros."""
    rotations = data.geom_xmat
    if isinstance(rotations, jax.Array) and (isinstance(rotations, jax.core.Tracer) or not rotations.is_fully_addressable):
        return
    if np.any(np.asarray(rotations)):
        return
    raise ValueError("all poses are zero: run mjx.kinematics on mjx.Data, or mujoco.mj_forward on MjData, before drawing")


@functools.partial(jax.jit, static_argnums=0)
def _prepare(rgb: bool, scene: Scene, poses: dict[str, Any]) -> Prepared:
    """Compute `Prepared`. Jitted to be traced only once for all programs that contain it, and compiled as a whole."""
    data = SimpleNamespace(**poses)
    position, rotation, finite = camera.camera_pose(scene, data)
    unit = shapes.unit_shapes(scene, data, position, rotation, finite)
    return Prepared(rotation, unit, lights.pack(lights.camera_lights(scene, data, position, rotation) if rgb else []))
