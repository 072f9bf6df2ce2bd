"""MuJoCo's own renderer on the same poses, for comparison. Needs OpenGL, which nothing else here does."""

import time
import warnings
from typing import Any

import mujoco
import numpy as np

from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.bench.timing import Timing, assert_varied
from jaxrl_vis.config import RequestError


def check() -> None:
    """Draws one empty picture.

    Raises:
        RequestError: There is no OpenGL.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what is missing is said once, below
            mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), height=8, width=8).close()
    except Exception as error:  # every OpenGL binding fails in its own way
        raise RequestError(
            "--peer mujoco needs OpenGL: install EGL or OSMesa (Debian: libegl1 or libosmesa6) and set MUJOCO_GL=egl or "
            f"MUJOCO_GL=osmesa ({type(error).__name__}: {' '.join(str(error).split())[:120]})"
        ) from error


def measure(settings: Settings, states: Any, size: int, count: int) -> Measurement:
    """Images per second, colours and depth, one pose after the other: that is how this renderer works."""
    mj_model = settings.make_env().mj_model
    positions, mocap = np.asarray(states.data.qpos[:count]), np.asarray(states.data.mocap_pos[:count])
    colours, seconds = [], []
    mj_data = mujoco.MjData(mj_model)
    with mujoco.Renderer(mj_model, height=size, width=size) as renderer:

        def draw() -> np.ndarray:
            renderer.update_scene(mj_data, camera=0)
            picture = renderer.render().copy()
            renderer.enable_depth_rendering()
            renderer.render()
            renderer.disable_depth_rendering()
            return picture

        draw()
        for position, marker in zip(positions, mocap, strict=True):
            mj_data.qpos[:], mj_data.mocap_pos[:] = position, marker
            mujoco.mj_forward(mj_model, mj_data)  # the pose is given: not part of the figure
            start = time.perf_counter()
            colours.append(draw())
            seconds.append(time.perf_counter() - start)
    assert_varied(np.stack(colours), "pictures of mujoco.Renderer")
    median = float(np.median(seconds))
    timing = Timing(median, (max(seconds) - min(seconds)) / median, count)
    return Measurement(
        name="render/peer_mujoco",
        value=1.0 / median,
        unit="images/s",
        config={"env": settings.env, "image_size": size, "pixels": "rgbd"},
        details=timing.details(0.0),
    )
