"""MuJoCo's own OpenGL renderer with the interface of `Frame`, the reference of tests and benchmarks.

It needs a GL library (``MUJOCO_GL=egl`` or ``osmesa`` without a display), makes one MuJoCo call per image, and uses NumPy only.
GL is initialised when a `ReferenceRenderer` is constructed, not on import.
"""

from typing import Any, Self

import mujoco
import numpy as np

from jaxrl_vis_envs.render.model.cameras import FREE_CAMERA, Camera
from jaxrl_vis_envs.render.model.reading import check_size
from jaxrl_vis_envs.render.outputs import Frame


class ReferenceRenderer:
    """Renderer of `mujoco.MjData` based on `mujoco.Renderer`. Close it, or use it as a context manager.

    Args:
        mj_model: MuJoCo model. Its ``vis.global_.offwidth`` and ``offheight`` limit the image size.
        height: H, pixels.
        width: W, pixels.
        effects: Render what `render` does not: shadows, reflections, haze, skins, flexes and rangefinders.
        site_groups: Visible site groups.
        tendon_groups: Visible groups of tendons.
        haze: Render the haze at the horizon even without ``effects``.

    Raises:
        ValueError: The image is larger than the model's offscreen buffer, or a size is not a positive integer.
        RuntimeError: There is no usable GL library.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        height: int,
        width: int,
        effects: bool = False,
        site_groups: tuple[int, ...] = (),
        tendon_groups: tuple[int, ...] = (0, 1, 2),
        haze: bool = False,
    ):
        check_size(height=height, width=width)
        buffer = mj_model.vis.global_
        if height > buffer.offheight or width > buffer.offwidth:
            raise ValueError(
                f"the model's offscreen buffer has {buffer.offheight} x {buffer.offwidth} pixels, fewer than {height} x"
                f" {width}: set vis.global_.offheight and offwidth of the model first"
            )
        self._model = mj_model
        try:
            self._renderer = mujoco.Renderer(mj_model, height, width)
        except (ImportError, AttributeError, mujoco.FatalError) as error:
            raise RuntimeError(f"no usable GL library (set MUJOCO_GL to egl or osmesa): {error}") from error
        self._options = mujoco.MjvOption()
        self._options.sitegroup[:] = [group in site_groups for group in range(len(self._options.sitegroup))]
        self._options.tendongroup[:] = [group in tendon_groups for group in range(len(self._options.tendongroup))]
        # Other objects have no segmentation label and are not supported by `render`.
        vis_flags = mujoco.mjtVisFlag
        for flag in (
            vis_flags.mjVIS_RANGEFINDER,
            vis_flags.mjVIS_SKIN,
            vis_flags.mjVIS_FLEXEDGE,
            vis_flags.mjVIS_FLEXSKIN,
        ):
            self._options.flags[flag] = effects
        flags = mujoco.mjtRndFlag
        for flag in (flags.mjRND_SHADOW, flags.mjRND_REFLECTION):
            self._renderer.scene.flags[flag] = effects
        self._renderer.scene.flags[flags.mjRND_HAZE] = effects or haze

    def __call__(self, mj_data: mujoco.MjData, camera: Camera) -> Frame:
        """Render an image as NumPy arrays: a `Frame` of rgb [H, W, 3] uint8, depth [H, W] float32 and segmentation [H, W]
        int32.

        Args:
            mj_data: Physics data with the poses.
            camera: Camera, as in `Scene.from_mjmodel`.

        Raises:
            ValueError: There is no such camera.
        """
        self._renderer.update_scene(mj_data, FREE_CAMERA if camera is None else camera, self._options)
        colour = self._renderer.render().copy()
        self._renderer.enable_depth_rendering()
        depth = self._renderer.render().astype(np.float32)
        self._renderer.disable_depth_rendering()
        self._renderer.enable_segmentation_rendering()
        ids, kinds = np.moveaxis(self._renderer.render(), -1, 0)
        self._renderer.disable_segmentation_rendering()
        labels = np.where(kinds == mujoco.mjtObj.mjOBJ_GEOM, ids, -1)
        for kind, first in (
            (mujoco.mjtObj.mjOBJ_SITE, self._model.ngeom),
            (mujoco.mjtObj.mjOBJ_TENDON, self._model.ngeom + self._model.nsite),
        ):
            labels = np.where(kinds == kind, ids + first, labels)
        return Frame(colour, depth, labels.astype(np.int32))  # pyright: ignore[reportArgumentType]

    def close(self) -> None:
        """Free the GL context."""
        self._renderer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *details: Any) -> None:
        self.close()
