"""Images of one environment from several cameras, with several outputs each, in one call."""

from collections.abc import Iterable, Mapping
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.pixels import labels
from jaxrl_vis_envs.render import Scene, render_planes

Output = Literal["rgb", "depth", "segmentation", "bodies", "normals"]
"""Kind of image: colours, planar depth, geom of each pixel, body of each pixel, or surface normals."""
OUTPUTS: tuple[Output, ...] = get_args(Output)
Camera = str | int | mujoco.MjvCamera | None
Cameras = Camera | Iterable[Camera] | Mapping[str, Camera]
"""A camera of `Scene.from_mjmodel`, several of them, or a dictionary of cameras by the names of their images."""
ImageSize = int | tuple[int, int]
"""Height and width in pixels, or one number for both."""


class Views:
    """Function from the poses of one environment to its images from several cameras.

    Use `jax.vmap` for a batch. Scenes are built once and share their arrays on the device (triangles, textures, colours), so a
    further camera only takes the memory of its lens parameters.

    Args:
        mj_model: MuJoCo model.
        cameras: Name or index of a camera, several of them, or a dictionary of cameras by name; MuJoCo's free camera if None.
        image_size: Height and width in pixels: one number, a pair, or a dictionary of these by camera.
        outputs: One `Output`, several, or a dictionary of these by camera.
        clip_range: Near and far clipping planes (m), or a dictionary of these by camera; the model's if None. The far plane is
            also the depth of the sky.
        **scene_options: Further options of `Scene.from_mjmodel`, such as ``groups`` or ``shadows``.

    Attributes:
        mj_model: The model.
        scenes: Scene by name of the camera. Replace one to change its colours, lights or lens.
        outputs: Outputs by name of the camera.
        geom_names: Name of each label of ``segmentation``.
        body_names: Name of each label of ``bodies``.

    Raises:
        ValueError: There is no such camera or output, no camera or no output is given, two cameras have the same name, the keys
            of a dictionary are not the cameras, ``clip_range`` is not (near, far) with 0 < near < far, or as in
            `Scene.from_mjmodel`.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        cameras: Cameras = None,
        image_size: ImageSize | Mapping[str, ImageSize] = 64,
        outputs: Output | Iterable[Output] | Mapping[str, Output | Iterable[Output]] = "rgb",
        clip_range: tuple[float, float] | Mapping[str, tuple[float, float] | None] | None = None,
        **scene_options: Any,
    ) -> None:
        self.mj_model = mj_model
        by_name = named_cameras(mj_model, cameras)
        sizes, ranges = (
            values_by_camera(by_name, name, value) for name, value in (("image_size", image_size), ("clip_range", clip_range))
        )
        self.outputs = {name: _check_outputs(value) for name, value in values_by_camera(by_name, "outputs", outputs).items()}
        self.scenes: dict[str, Scene] = {}
        for name, camera in by_name.items():
            height, width = sizes[name] if isinstance(sizes[name], tuple | list) else (sizes[name], sizes[name])
            scene = Scene.from_mjmodel(mj_model, camera=camera, height=height, width=width, **scene_options)
            scene = _clip_to_range(scene, ranges[name])
            self.scenes[name] = _share_leaves(scene, next(iter(self.scenes.values()), None))
        self.geom_names, self.body_names = labels.geom_names(mj_model), labels.body_names(mj_model)
        self._bodies = labels.object_bodies(mj_model)

    def __call__(self, data: Any, scenes: Mapping[str, Scene] | None = None) -> dict[str, dict[str, jax.Array]]:
        """Render all images of one environment.

        Args:
            data: Poses of one environment, as in `jaxrl_vis_envs.render.render`.
            scenes: Scenes to render instead of ``self.scenes``, for appearances that differ within a batch.

        Returns:
            Images by name of the camera and output: ``rgb`` [H, W, 3] uint8; ``depth`` [H, W] float32, planar, m;
            ``segmentation`` [H, W] int32: geom id, ngeom + site id for a site, ngeom + nsite + tendon id for a tendon, -1 for
            the sky; ``bodies`` [H, W] int32: body id, -1 for the sky, -2 for a tendon; ``normals`` [H, W, 3] float32 in the
            camera's frame (x right, y up, z towards the viewer).
        """
        scenes = self.scenes if scenes is None else scenes
        return {name: self._render(scenes[name], data, outputs) for name, outputs in self.outputs.items()}

    def _render(self, scene: Scene, data: Any, outputs: tuple[Output, ...]) -> dict[str, jax.Array]:
        planes = render_planes(
            scene,
            data,
            rgb="rgb" in outputs,
            depth="depth" in outputs,
            segmentation="segmentation" in outputs or "bodies" in outputs,
            normals="normals" in outputs,
            quantized=True,
        )
        images: dict[str, Any] = {"depth": planes.depth, "segmentation": planes.segmentation}
        for name, plane in (("rgb", planes.rgb), ("normals", planes.normals)):
            images[name] = None if plane is None else jnp.moveaxis(plane, 0, -1)
        if planes.segmentation is not None:
            images["bodies"] = jnp.asarray(self._bodies)[planes.segmentation]
        return {output: images[output] for output in outputs}


def named_cameras(mj_model: mujoco.MjModel, cameras: Cameras) -> dict[str, Camera]:
    """Return cameras by name: that in the model, ``camera 2`` for one that has none there, ``free`` for the free camera.

    Raises:
        ValueError: There are no cameras, or two have the same name.
    """
    if isinstance(cameras, Mapping):
        by_name: dict[str, Any] = {str(name): camera for name, camera in cameras.items()}
    else:
        single = cameras is None or isinstance(cameras, str | int | np.integer | mujoco.MjvCamera)
        listed: list[Any] = [cameras] if single else list(cameras)  # type: ignore[arg-type]
        by_name = {_camera_name(mj_model, camera): camera for camera in listed}
        if len(by_name) < len(listed):
            raise ValueError(f"two cameras have the same name: name them in a dictionary, got {listed}")
    if not by_name:
        raise ValueError("there must be at least one camera; None is MuJoCo's free camera")
    return by_name


def _camera_name(mj_model: mujoco.MjModel, camera: Camera) -> str:
    if isinstance(camera, str):
        return camera
    if camera is None or isinstance(camera, mujoco.MjvCamera) or camera < 0:
        return "free"
    return (mj_model.camera(int(camera)).name if camera < mj_model.ncam else "") or f"camera {camera}"


def values_by_camera(cameras: Iterable[str], option: str, value: Any) -> dict[str, Any]:
    """Return the values of an option by camera: a copy of a dictionary ``value``, or the same ``value`` for all cameras.

    Raises:
        ValueError: The dictionary lacks a camera or contains an unknown one.
    """
    if not isinstance(value, Mapping):
        return dict.fromkeys(cameras, value)
    if set(value) != set(cameras):
        raise ValueError(f"{option} by camera must name {', '.join(cameras)}, got {', '.join(map(str, value))}")
    return dict(value)


def _check_outputs(outputs: Any) -> tuple[Output, ...]:
    listed: tuple[Any, ...] = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    if not listed or not set(listed) <= set(OUTPUTS):
        raise ValueError(f"outputs must be among {', '.join(OUTPUTS)}, got {outputs!r}")
    return tuple(dict.fromkeys(listed))


def _clip_to_range(scene: Scene, clip_range: tuple[float, float] | None) -> Scene:
    if clip_range is None:
        return scene
    near, far = clip_range
    if not 0.0 < near < far:
        raise ValueError(f"clip_range must be (near, far) with 0 < near < far, got {clip_range}")
    return scene.replace(znear=jnp.float32(near), zfar=jnp.float32(far))


def _share_leaves(scene: Scene, first: Scene | None) -> Scene:
    """Replace leaves of ``scene`` that equal those of ``first`` by the latter, so that the device stores them once."""
    if first is None:
        return scene
    shared = {}
    for name, leaf in vars(first).items():
        mine = getattr(scene, name)
        if isinstance(leaf, jax.Array) and leaf.shape == mine.shape and np.array_equal(leaf, mine):
            shared[name] = leaf
    return scene.replace(**shared)
