"""MuJoCo's own OpenGL renderer behind the same `Frame`: the truth for tests, and the better image for videos.

It needs a GL library (``MUJOCO_GL=egl`` or ``osmesa`` without a display), one MuJoCo call per image, and NumPy only. GL is
touched when a `ReferenceRenderer` is made, not when this module is imported.
"""

from typing import Any, Self

import mujoco
import numpy as np

from jaxrl_vis_envs.render.model.cameras import FREE_CAMERA, Camera
from jaxrl_vis_envs.render.model.reading import check_size
from jaxrl_vis_envs.render.outputs import Frame


class ReferenceRenderer:
    """Draws `mujoco.MjData` with `mujoco.Renderer`. Close it, or use it in a ``with`` statement.

    Args:
        mj_model: The model. Its ``vis.global_.offwidth`` and ``offheight`` bound the image's size.
        height: H, pixels.
        width: W, pixels.
        effects: Whether to draw what `render` does not: shadows, reflections, haze, tendons, skins, flexes and rangefinders.
        site_groups: Site groups that are drawn.
        haze: Whether to draw the horizon's haze all the same.

    Raises:
        ValueError: The image is larger than the model's offscreen buffer, or a size is no positive integer.
        RuntimeError: There is no usable GL library.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        height: int,
        width: int,
        effects: bool = False,
        site_groups: tuple[int, ...] = (),
        haze: bool = False,
    ):
        check_size(height=height, width=width)
        buffer = mj_model.vis.global_
        if height > buffer.offheight or width > buffer.offwidth:
            raise ValueError(
                f"the model's buffer has {buffer.offheight} x {buffer.offwidth} pixels, fewer than {height} x {width}: set"
                " vis.global_.offheight and offwidth of the model first"
            )
        self._model = mj_model
        try:
            self._renderer = mujoco.Renderer(mj_model, height, width)
        except (ImportError, AttributeError, mujoco.FatalError) as error:
            raise RuntimeError(f"no usable GL library (set MUJOCO_GL to egl or osmesa): {error}") from error
        self._options = mujoco.MjvOption()
        self._options.sitegroup[:] = [group in site_groups for group in range(len(self._options.sitegroup))]
        # What is not a geom or a site has no label in a segmentation, and `render` does not draw it.
        marks = mujoco.mjtVisFlag
        for mark in (marks.mjVIS_TENDON, marks.mjVIS_RANGEFINDER, marks.mjVIS_SKIN, marks.mjVIS_FLEXEDGE, marks.mjVIS_FLEXSKIN):
            self._options.flags[mark] = effects
        flags = mujoco.mjtRndFlag
        for flag in (flags.mjRND_SHADOW, flags.mjRND_REFLECTION):
            self._renderer.scene.flags[flag] = effects
        self._renderer.scene.flags[flags.mjRND_HAZE] = effects or haze

    def __call__(self, mj_data: mujoco.MjData, camera: Camera) -> Frame:
        """The image as NumPy arrays: a `Frame` of rgb [H, W, 3] uint8, depth [H, W] float32 and segmentation [H, W] int32.

        Args:
            mj_data: The poses.
            camera: As `Scene.from_mjmodel` takes it.

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
        labels = np.where(kinds == mujoco.mjtObj.mjOBJ_SITE, ids + self._model.ngeom, labels)
        return Frame(colour, depth, labels.astype(np.int32))  # pyright: ignore[reportArgumentType]

    def close(self) -> None:
        """Frees the GL context."""
        self._renderer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *details: Any) -> None:
        self.close()
