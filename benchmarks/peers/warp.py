"""Speed of MuJoCo Warp's renderer on the poses of our scenes, in the same call as ours. Needs an NVIDIA GPU, mujoco-warp 4.0.0.

    python -m benchmarks.peers.warp [--scene primitives] [--envs 8192] [--image-size 64]

Scenes of meshes are named: ``--scene clutter``, ``fetch_mesh``, ``shadow_hand``, ``aloha``; their images have labels, too, and
are rendered without and with shadows, if a light casts any. ``clutter`` is seen by four cameras.

The timed work is that of a simulation of many environments: refit the bounding volumes, then render, captured in one CUDA
graph. Poses are input in world coordinates, so its own kinematics never run. Two graphs read two sets of poses, so that every
launch renders new images without copies in between. Only the options that the scene needs are enabled.

JAX takes most of a GPU's memory when it starts; if Warp then runs out, set XLA_PYTHON_CLIENT_MEM_FRACTION=.5.
"""

import dataclasses
import importlib.metadata
import sys
import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from benchmarks.peers import command
from benchmarks.peers.image_comparison import MAX_DIFFERENCE, Comparison, measure_beside_ours, textured_geoms
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.variation import assert_new_images, cycle_batches
from jaxrl_vis.errors import RequestError
from jaxrl_vis_envs.render import Scene

VERSION = "4.0.0"

# Warp reads the nearest texel of the finest level, while OpenGL and we filter, and multiplies by the texture before clamping
# the light to 1, while OpenGL and we do so afterwards. Observed: 8 grey levels in `finger`, 20 in `primitives`.
MAX_TEXTURED_DIFFERENCE = 25.0
# Warp lights every pixel of a mesh, while OpenGL and we light the corners of its triangles. Observed: 3.9 in `aloha`.
MAX_LIT_DIFFERENCE = 5.0


def check() -> None:
    """Check for the package and a GPU.

    Raises:
        RequestError: One of them is missing, or the package has another version than `VERSION`.
    """
    try:
        version = importlib.metadata.version("mujoco-warp")
        import mujoco_warp  # noqa: F401  # pyright: ignore[reportMissingImports]
        import warp as wp  # pyright: ignore[reportMissingImports]
    except ImportError as error:  # PackageNotFoundError is one
        raise RequestError(f"the peer warp needs MuJoCo Warp: pip install mujoco-warp=={VERSION} ({error})") from error
    if version != VERSION:
        raise RequestError(f"the peer warp is for mujoco-warp {VERSION}, not {version}: pip install mujoco-warp=={VERSION}")
    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    if not wp.get_cuda_device_count():
        raise RequestError("the peer warp needs an NVIDIA GPU that Warp can use (its CPU device is for debugging)")


def measure(comparison: Comparison) -> Measurement:
    """Measure images per second: 8-bit colours and float32 planar depth in metres, and labels if ours have them.

    Raises:
        AssertionError: Its images differ from ours.
    """
    start = time.perf_counter()
    options = render_options(comparison.scene, comparison.mj_model, comparison.batches)
    context, draws = prepare(comparison, options)
    compile_s = time.perf_counter() - start

    import warp as wp  # pyright: ignore[reportMissingImports]

    size = comparison.config["image_size"]

    def raw(draw: Callable[[], None]) -> list[np.ndarray]:
        draw()
        wp.synchronize_device()
        # By world and camera; copies, because a CPU's arrays are views of buffers that the next image overwrites.
        planes = (context.rgb_data, context.depth_data, *([context.seg_data] if comparison.has_labels else []))
        return [np.array(plane.numpy()).reshape(comparison.config["images"], size * size, -1) for plane in planes]

    assert_new_images(raw, draws)
    rgb, metres, *marks = raw(draws[0])
    colours, depth = images(rgb[..., 0], metres[..., 0], size)
    labels = marks[0][..., 0].astype(np.int32).reshape(-1, size, size) if marks else None
    max_difference = MAX_LIT_DIFFERENCE if comparison.scene.hierarchies is not None else MAX_DIFFERENCE
    agreement = comparison.agreement(colours, depth, MAX_TEXTURED_DIFFERENCE, max_difference, labels)
    timing = measure_time(cycle_batches(lambda draw: draw(), draws), comparison.repeats, wait=lambda _: wp.synchronize_device())
    value = comparison.config["images"] / timing.median_s
    return Measurement(
        name="render/peer_warp",
        value=value,
        unit="images/s",
        config=comparison.config,
        details=timing.details(
            compile_s,
            **agreement,
            ours_over_peer=round(comparison.rate / value, 2),
            options=[name for name, on in options.items() if on],
            mujoco_warp=importlib.metadata.version("mujoco-warp"),
            warp=wp.config.version,
        ),
    )


def images(rgb: np.ndarray, depth: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Convert Warp's buffers to images.

    Args:
        rgb: Packed colours [N, size * size] uint32, blue in the lowest byte.
        depth: Planar metres [N, size * size] float32, 0 for the sky.
        size: Height and width.

    Returns:
        [N, size, size, 3] uint8 colours, and [N, size, size] float32 metres, inf for the sky.
    """
    channels = np.ascontiguousarray(rgb).view(np.uint8).reshape(-1, size, size, 4)
    return channels[..., 2::-1], np.where(depth > 0.0, depth, np.inf).reshape(-1, size, size)


def render_options(scene: Scene, mj_model: mujoco.MjModel, batches: list[dict[str, np.ndarray]]) -> dict[str, bool]:
    """Select the optional features of Warp that a scene needs; others would cost time without changing a pixel.

    The choice follows our scene, because our renderer omits unused features automatically. Normals at corners are for meshes.

    Args:
        scene: Our scene.
        mj_model: Model.
        batches: Poses to render.
    """
    drawn, lights = np.array(scene.object_ids, int), np.asarray(scene.light_ambient)
    per_light_ambient = bool(np.any(lights > 0))
    return {
        "use_textures": bool(np.any(textured_geoms(mj_model)[drawn])),
        "render_skybox": bool(np.any(mj_model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)),
        "use_shadows": any(scene.light_shadows),
        "use_ambient_lighting": per_light_ambient
        or (scene.headlight and bool(np.any(np.asarray(scene.headlight_ambient) > 0))),
        "enable_per_light_ambient": per_light_ambient,
        "enable_specular": any(scene.light_highlights[:-1]) or (scene.headlight and scene.light_highlights[-1]),
        "enable_emission": bool(np.any(np.asarray(scene.emission)[drawn] > 0)),
        "enable_vertex_normals": scene.hierarchies is not None,
        "enable_backface_culling": may_show_backs(scene, mj_model, batches),
    }


def may_show_backs(scene: Scene, mj_model: mujoco.MjModel, batches: list[dict[str, np.ndarray]]) -> bool:
    """Return True if the first camera may see a surface from inside: in a geom's bounding sphere, or if there are triangles.

    Planes do not count: our renderer renders both sides of them, as does Warp without culling.
    """
    if {mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF} & set(scene.object_types):
        return True
    bounded = [geom for geom in scene.object_ids if mj_model.geom_rbound[geom] > 0]
    reach = mj_model.geom_rbound[bounded] + float(scene.znear)
    return any(
        bool(np.any(np.linalg.norm(poses["geom_xpos"][:, bounded] - poses["cam_xpos"][:, :1], axis=-1) <= reach))
        for poses in batches
    )


def prepare(comparison: Comparison, options: dict[str, bool]) -> tuple[Any, list[Callable[[], None]]]:
    """Build the render context, and a function per batch that renders it.

    Args:
        comparison: Scene and poses.
        options: Options from `render_options`.

    Returns:
        Warp's render context, whose ``rgb_data`` [images, H * W] (packed uint32) and ``depth_data`` [images, H * W] (float32)
        every call overwrites, and the functions. On Warp's CPU device, which has no graphs, they launch the kernels directly.
    """
    import mujoco_warp as mjw  # pyright: ignore[reportMissingImports]
    import warp as wp  # pyright: ignore[reportMissingImports]

    count, size, mj_model = (
        comparison.config["images"] // comparison.cameras,
        comparison.config["image_size"],
        comparison.mj_model,
    )
    model = mjw.put_model(mj_model)
    context = mjw.create_render_context(
        mj_model,
        nworld=count,
        cam_res=(size, size),
        render_rgb=True,
        render_depth=True,
        render_seg=comparison.has_labels,
        cam_active=list(range(comparison.cameras)),
        shadow_light_fraction=0.0,  # as in OpenGL and ours: nothing of a light reaches what lies in its shadow
        **options,
    )
    # Buffers of one environment suffice, because only poses are read; those of thousands of free bodies would fill the memory.
    blank = mjw.make_data(mj_model, nworld=1)
    datas = [_set_poses(blank, {name: rows[:count] for name, rows in batch.items()}) for batch in comparison.batches]

    def launch(data: Any) -> None:
        mjw.refit_bvh(model, data, context)
        mjw.render(model, data, context)

    for data in datas:  # compiles the kernels, which must not happen inside a capture
        launch(data)
    wp.synchronize()
    if not wp.get_device().is_cuda:
        return context, [lambda data=data: launch(data) for data in datas]

    def replay(graph: Any, *_referenced: Any) -> Callable[[], None]:
        # A graph does not keep references to its inputs and outputs.
        return lambda: wp.capture_launch(graph) if _referenced else None

    draws = []
    for data in datas:
        with wp.ScopedCapture() as capture:
            launch(data)
        draws.append(replay(capture.graph, model, data))
    return context, draws


def _set_poses(blank: Any, poses: dict[str, np.ndarray]) -> Any:
    """Make Warp's Data of these poses, with one environment (Warp: world) per row."""
    import warp as wp  # pyright: ignore[reportMissingImports]

    count = len(poses["geom_xpos"])
    vectors = {name: poses[name] for name in ("geom_xpos", "cam_xpos", "light_xpos", "light_xdir")}
    matrices = {name: poses[name].reshape(count, -1, 3, 3) for name in ("geom_xmat", "cam_xmat")}
    arrays = {name: wp.array(rows, dtype=wp.vec3) for name, rows in vectors.items()}
    arrays |= {name: wp.array(rows, dtype=wp.mat33) for name, rows in matrices.items()}
    return dataclasses.replace(blank, nworld=count, **arrays)


if __name__ == "__main__":
    sys.exit(command.run("render", measure_beside_ours(check, measure), __doc__, ("scene", "envs", "image_size")))
