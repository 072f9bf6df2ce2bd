"""What is computed once per environment, before any pixel: where the camera is, the drawn objects and the lights before it."""

import functools
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax

from jaxrl_vis_envs.render import camera
from jaxrl_vis_envs.render.pixel import lights, shapes
from jaxrl_vis_envs.render.scene import Scene

_POSES = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat", "xpos", "xmat", "subtree_com")


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


@functools.partial(jax.jit, static_argnums=0)
def _prepared(rgb: bool, scene: Scene, poses: dict[str, Any]) -> Prepared:
    """Jitted so that it is traced once, in however many programs it is, and compiled as a whole where it is in none."""
    data = SimpleNamespace(**poses)
    position, rotation, finite = camera.camera_pose(scene, data)
    unit = shapes.unit_shapes(scene, data, position, rotation, finite)
    return Prepared(rotation, unit, lights.pack(lights.camera_lights(scene, data, position, rotation) if rgb else []))
