"""MuJoCo Warp's renderer on the same poses, for comparison. Needs an NVIDIA GPU and the package mujoco-warp 4.0.0.

What is timed is what a simulation of many worlds would do for its images: refit the bounding volumes, then draw, captured in
one CUDA graph. World poses are given, and its own kinematics are never run. Two graphs read two sets of poses, so every launch
draws new images and nothing is copied in between.

JAX takes most of a GPU's memory when it starts; where Warp then finds too little, set XLA_PYTHON_CLIENT_MEM_FRACTION=.5.
"""

import dataclasses
import importlib.metadata
import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.render import alternate, assert_new_images
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.errors import RequestError

VERSION = "4.0.0"


def check() -> None:
    """Looks for the package and a GPU.

    Raises:
        RequestError: One of them is missing.
    """
    try:
        found = importlib.metadata.version("mujoco-warp")
        import mujoco_warp  # noqa: F401  # pyright: ignore[reportMissingImports]
        import warp as wp  # pyright: ignore[reportMissingImports]
    except ImportError as error:  # PackageNotFoundError is one
        raise RequestError(f"--peer warp needs MuJoCo Warp: pip install mujoco-warp=={VERSION} ({error})") from error
    if found != VERSION:
        raise RequestError(f"--peer warp is written for mujoco-warp {VERSION}, not {found}: pip install mujoco-warp=={VERSION}")
    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    if not wp.get_cuda_device_count():
        raise RequestError("--peer warp needs an NVIDIA GPU that Warp can use (its CPU device is for debugging)")


def measure(
    config: dict[str, Any], mj_model: mujoco.MjModel, batches: list, repeats: int, depth: np.ndarray, ours: float
) -> Measurement:
    """Images per second: 8-bit colours and float32 planar depth in metres, no shadows.

    Args:
        config: What the record says was drawn.
        mj_model: The model; its first camera looks.
        batches: Poses, see `render_scenes.random_poses`; ``config["images"]`` of each are drawn.
        repeats: Timed repeats at most.
        depth: [K, H, W] of ours in the first poses, metres, inf for the sky.
        ours: Our images per second.
    """
    from jaxrl_vis.bench.scene_images import agreement

    start = time.perf_counter()
    context, draws = prepare(config, mj_model, batches)
    compile_s = time.perf_counter() - start
    size = config["image_size"]

    import warp as wp  # pyright: ignore[reportMissingImports]

    def images(draw: Callable[[], None]) -> tuple[np.ndarray, np.ndarray]:
        draw()
        wp.synchronize_device()
        return context.rgb_data.numpy(), context.depth_data.numpy()

    assert_new_images(images, draws)
    seen = images(draws[0])[1].reshape(-1, size, size)[: len(depth)]
    share = agreement(depth[: len(seen)], np.where(seen > 0.0, seen, np.inf))  # its sky has depth 0
    timing = measure_time(alternate(lambda draw: draw(), draws), repeats, wait=lambda _: wp.synchronize_device())
    value = config["images"] / timing.median_s
    return Measurement(
        name="render/peer_warp",
        value=value,
        unit="images/s",
        config=config,
        details=timing.details(
            compile_s,
            depth_agreement=round(share, 4),
            ours_over_peer=round(ours / value, 2),
            mujoco_warp=importlib.metadata.version("mujoco-warp"),
            warp=wp.config.version,
        ),
    )


def prepare(config: dict[str, Any], mj_model: mujoco.MjModel, batches: list) -> tuple[Any, list[Callable[[], None]]]:
    """Builds the render context, and for each batch a call that has it drawn.

    Args:
        config: Has ``images``, ``image_size`` and ``textures``.
        mj_model: The model; its first camera looks.
        batches: Poses of at least ``images`` worlds each.

    Returns:
        Warp's render context, whose ``rgb_data`` [images, H * W] (packed uint32) and ``depth_data`` [images, H * W] (float32)
        every call overwrites, and the calls. On Warp's CPU device, which has no graphs, they run the kernels one by one.
    """
    import mujoco_warp as mjw  # pyright: ignore[reportMissingImports]
    import warp as wp  # pyright: ignore[reportMissingImports]

    count, size = config["images"], config["image_size"]
    model = mjw.put_model(mj_model)
    context = mjw.create_render_context(
        mj_model,
        nworld=count,
        cam_res=(size, size),
        render_rgb=True,
        render_depth=True,
        render_seg=False,
        use_textures=config["textures"],
        use_shadows=False,
        cam_active=[0],
        render_skybox=config["textures"],
    )
    # One world's buffers suffice, because only the poses are read; those of thousands of free bodies would fill the memory.
    blank = mjw.make_data(mj_model, nworld=1)
    datas = [_with_poses(blank, {name: rows[:count] for name, rows in batch.items()}) for batch in batches]

    def launch(data: Any) -> None:
        mjw.refit_bvh(model, data, context)
        mjw.render(model, data, context)

    for data in datas:  # compiles the kernels, which must not happen inside a capture
        launch(data)
    wp.synchronize()
    if not wp.get_device().is_cuda:
        return context, [lambda data=data: launch(data) for data in datas]

    def replay(graph: Any, *_kept: Any) -> Callable[[], None]:
        # A graph does not keep alive what it reads and writes.
        return lambda: wp.capture_launch(graph) if _kept else None

    draws = []
    for data in datas:
        with wp.ScopedCapture() as capture:
            launch(data)
        draws.append(replay(capture.graph, model, data))
    return context, draws


def _with_poses(blank: Any, poses: dict[str, np.ndarray]) -> Any:
    """Warp's Data with these world poses, and as many worlds as there are."""
    import warp as wp  # pyright: ignore[reportMissingImports]

    count = len(poses["geom_xpos"])
    vectors = {name: poses[name] for name in ("geom_xpos", "cam_xpos", "light_xpos", "light_xdir")}
    matrices = {name: poses[name].reshape(count, -1, 3, 3) for name in ("geom_xmat", "cam_xmat")}
    arrays = {name: wp.array(rows, dtype=wp.vec3) for name, rows in vectors.items()}
    arrays |= {name: wp.array(rows, dtype=wp.mat33) for name, rows in matrices.items()}
    return dataclasses.replace(blank, nworld=count, **arrays)
