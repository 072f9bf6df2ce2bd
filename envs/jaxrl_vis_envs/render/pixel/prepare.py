"""What is computed once per environment, before any pixel: where the camera is, the drawn objects and the lights before it."""

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
    """What pixels are drawn from, beside the scene.

    Attributes:
        rotation: [3, 3] float32, see `camera.camera_pose`.
        unit: The drawn objects.
        lights: From `lights.pack`; of no lights where nothing is shaded.
    """

    rotation: jax.Array
    unit: shapes.UnitShapes
    lights: jax.Array


def prepare(scene: Scene, data: Any, rgb: bool = True) -> Prepared:
    """What the pixels of one environment are drawn from.

    Args:
        scene: The scene.
        data: Poses of one environment, as in `render_planes`.
        rgb: Whether anything is shaded.
    """
    return _prepared(rgb, scene, {name: getattr(data, name) for name in _POSES if hasattr(data, name)})


def check_poses(scene: Any, data: Any, rgb: bool) -> None:
    """Refuses what cannot be drawn from: JAX would take the last geom's pose for every one that is missing.

    Args:
        scene: What is drawn.
        data: What is to hold the poses, see `render_planes`.
        rgb: Whether anything is shaded.

    Raises:
        ValueError: ``scene`` is no scene, or ``data`` has no poses, none that kinematics have filled in, those of several
            environments, or those of another model.
    """
    if not isinstance(scene, Scene):
        raise ValueError(
            f"a scene comes first, from Scene.from_mjmodel(mj_model), and then the data; got {type(scene).__name__}"
        )
    if scene.object_ids:
        _check_kind(data, "geom_", scene.geom_count, is_exact=True)
    if any(index >= scene.geom_count for index in scene.object_ids):
        _check_kind(data, "site_", len(scene.size) - scene.geom_count, is_exact=True)
    mounts = (scene.camera_mount, *(scene.light_mounts if rgb else ()))
    posed = max(mount.posed for mount in mounts)
    if posed > 0:
        _check_kind(data, "", posed + 1)
    if any(mount.weighed >= 0 for mount in mounts):
        _check_array(data, "xipos", ((3,),), len(scene.body_parents), is_exact=True)
    if scene.object_ids:
        _check_filled(data)


def _check_kind(data: Any, kind: str, count: int, is_exact: bool = False) -> None:
    """Refuses ``data`` unless it holds poses of ``count`` objects of a kind, or of more where that is not exact."""
    _check_array(data, f"{kind}xpos", ((3,),), count, is_exact)
    _check_array(data, f"{kind}xmat", ((3, 3), (9,)), count, is_exact)


def _check_array(data: Any, name: str, shapes_of_one: tuple[tuple[int, ...], ...], count: int, is_exact: bool) -> None:
    """Refuses ``data`` without an array ``name`` of ``count`` rows of one of the shapes, or more where that is not exact."""
    if not hasattr(data, name):
        mend = ", such as state.data" if hasattr(getattr(data, "data", None), name) else ""
        raise ValueError(f"poses are read from mjx.Data or mujoco.MjData{mend}; {type(data).__name__} has no {name}")
    shape = np.shape(getattr(data, name))
    if shape[1:] not in shapes_of_one:
        expected = (count if is_exact else "...", *shapes_of_one[0])
        raise ValueError(f"{name} of one environment has the shape {expected}, got {shape}; jax.vmap over a batch")
    if shape[0] < count or (is_exact and shape[0] != count):
        least = "" if is_exact else "at least "
        raise ValueError(f"{name} holds {shape[0]} poses and the scene's model has {least}{count}: the models differ")


def _check_filled(data: Any) -> None:
    """Refuses poses that nothing has filled in yet, where they can be looked at: a rotation is never all zeros."""
    rotations = data.geom_xmat
    if isinstance(rotations, jax.Array) and (isinstance(rotations, jax.core.Tracer) or not rotations.is_fully_addressable):
        return
    if np.any(np.asarray(rotations)):
        return
    raise ValueError("all poses are zero: run mjx.kinematics on mjx.Data, or mujoco.mj_forward on MjData, before drawing")


@functools.partial(jax.jit, static_argnums=0)
def _prepared(rgb: bool, scene: Scene, poses: dict[str, Any]) -> Prepared:
    """Jitted so that it is traced once, in however many programs it is, and compiled as a whole where it is in none."""
    data = SimpleNamespace(**poses)
    position, rotation, finite = camera.camera_pose(scene, data)
    unit = shapes.unit_shapes(scene, data, position, rotation, finite)
    return Prepared(rotation, unit, lights.pack(lights.camera_lights(scene, data, position, rotation) if rgb else []))
