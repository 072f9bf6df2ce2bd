"""Speed of MuJoCo's own renderer on the poses of our scenes, in the same call as ours. Needs OpenGL.

MUJOCO_GL=egl python -m benchmarks.peers.mujoco [--scene fetch_reach] [--image-size 64]
"""

import sys
import time
import warnings

import mujoco
import numpy as np

from benchmarks.peers import command
from benchmarks.peers.image_comparison import Comparison, measure_beside_ours
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.scenes import models
from jaxrl_vis.bench.timing import Timing
from jaxrl_vis.bench.variation import assert_varied
from jaxrl_vis.errors import RequestError

POSES = 64
"""Number of images rendered, one at a time."""


def check() -> None:
    """Render one empty image.

    Raises:
        RequestError: OpenGL is missing.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the error below names what is missing
            mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), height=8, width=8).close()
    except Exception as error:  # each OpenGL binding raises its own exceptions
        raise RequestError(
            "the peer mujoco needs OpenGL: install EGL or OSMesa (Debian: libegl1 or libosmesa6) and set MUJOCO_GL=egl or "
            f"MUJOCO_GL=osmesa ({type(error).__name__}: {' '.join(str(error).split())[:120]})"
        ) from error


def measure(comparison: Comparison) -> Measurement:
    """Measure images per second of colours and depth, one pose at a time, as this renderer works. Every image is timed.

    Shadows are as in ours, reflections and haze are off; multisampling follows the model (`models.load` switches it off).

    Raises:
        AssertionError: Its images differ from ours.
    """
    config, mj_model, poses = comparison.config, comparison.mj_model, comparison.batches[0]
    size, cameras = config["image_size"], comparison.cameras
    count = min(POSES, len(poses["geom_xpos"]) * cameras)
    colours, depths, seconds = [], [], []
    mj_data, flags = mujoco.MjData(mj_model), mujoco.mjtRndFlag
    with mujoco.Renderer(mj_model, height=size, width=size) as renderer:
        for flag in (flags.mjRND_REFLECTION, flags.mjRND_HAZE):
            renderer.scene.flags[flag] = False
        renderer.scene.flags[flags.mjRND_SHADOW] = config.get("shadows", False)
        options = mujoco.MjvOption()
        options.sitegroup[:] = 0

        def draw(camera: int) -> tuple[np.ndarray, np.ndarray]:
            renderer.update_scene(mj_data, camera, options)
            colour = renderer.render().copy()
            renderer.enable_depth_rendering()
            metres = renderer.render().copy()
            renderer.disable_depth_rendering()
            return colour, metres

        for index in [0, *range(count)]:  # the first pose twice: once to warm up
            _set_poses(mj_data, poses, index // cameras)  # not timed: poses are input
            start = time.perf_counter()
            colour, metres = draw(index % cameras)
            seconds.append(time.perf_counter() - start)
            colours.append(colour)
            depths.append(metres)
    assert_varied(np.stack(colours[1:]), "images of mujoco.Renderer")
    median = float(np.median(seconds[1:]))
    timing = Timing(median, (max(seconds[1:]) - min(seconds[1:])) / median, count)
    far = 0.999 * mj_model.vis.map.zfar * mj_model.stat.extent
    depth = np.stack(depths[1:])
    agreement = comparison.agreement(np.stack(colours[1:]), np.where(depth < far, depth, np.inf))
    return Measurement(
        name="render/peer_mujoco",
        value=1.0 / median,
        unit="images/s",
        config={**config, "images": count},
        details=timing.details(0.0, **agreement, ours_over_peer=round(comparison.rate * median, 1)),
    )


def _set_poses(mj_data: mujoco.MjData, poses: dict[str, np.ndarray], index: int) -> None:
    """Copy one row of `models.random_poses` into ``mj_data`` for rendering."""
    for name in models.POSES:
        getattr(mj_data, name)[:] = poses[name][index]


if __name__ == "__main__":
    render = measure_beside_ours(check, measure, POSES)
    sys.exit(command.run("render", render, __doc__, ("scene", "envs", "image_size")))
