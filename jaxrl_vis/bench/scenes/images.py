"""Our renderer on the scenes of `models`: images per second of every output, size and batch.

Poses are in world coordinates; images have 8-bit colours and float32 depth in metres, without shadows. A renderer's own
preparation for a new pose (culling, refitting of bounding volumes) is included in its time.
"""

import dataclasses
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import jaxrl_vis_envs
from jaxrl_vis.bench.peaks import device_peak
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.scenes import models, operations, program_memory
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.bench.timing import compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.variation import alternate, assert_new_images
from jaxrl_vis_envs.render import Scene, quantize, render_planes

CPU_COUNTS = (64,)
ACCELERATOR_COUNTS = (4096,)
SCENE_CPU_COUNTS = {"clutter": (1,)}  # a single image takes seconds
SCENE_ACCELERATOR_COUNTS = {"primitives": (8192,), "clutter": (16,)}
OUTPUTS = ("rgbd", "rgbd8", "depth")
_SAMPLE = 32  # number of poses over which the needed tests are averaged
_DEPTH_RANGE = 10.0  # range of an 8-bit depth in metres

# Without textures first: MuJoCo Warp is fastest on that variant.
VARIANTS = tuple({"poses": "scattered", "textures": textures, "highlights": True} for textures in (False, True))
# MuJoCo Warp's scene also in its own setting: at the start, where its bounding volumes fit best, and without highlights.
SCENE_VARIANTS = {
    "primitives": (
        *VARIANTS,
        *({**variant, "poses": "start"} for variant in VARIANTS),
        {"poses": "start", "textures": False, "highlights": False},
    ),
    "clutter": VARIANTS[:1],  # it has no textures
}


@dataclasses.dataclass(frozen=True)
class Case:
    """One scene in one variant, batch and image size.

    Attributes:
        config: Entries of a record: scene, poses, textures, highlights, image_size, images.
        mj_model: Model, seen by its first camera.
        batches: Two sets of poses, see `models.random_poses`; the first ``config["images"]`` of each are rendered.
    """

    config: dict[str, Any]
    mj_model: mujoco.MjModel
    batches: list[dict[str, np.ndarray]]


def cases(scene: str, settings: Settings, sizes: tuple[int, ...], min_poses: int = 0) -> Iterator[Case]:
    """Yield every variant, batch and image size of a scene.

    Args:
        scene: Name or path, see `models.load`.
        settings: Settings, of which ``envs`` and ``on_accelerator`` are used.
        sizes: Heights and widths of the images.
        min_poses: Minimum number of poses in a batch.
    """
    for variant in SCENE_VARIANTS.get(scene, VARIANTS):
        mj_model = models.load(scene, variant["textures"], variant["highlights"])
        spread = models.SPREADS[variant["poses"]]
        counts = (SCENE_CPU_COUNTS.get(scene, CPU_COUNTS), SCENE_ACCELERATOR_COUNTS.get(scene, ACCELERATOR_COUNTS))
        for count in settings.counts(*counts):
            batches = [models.random_poses(mj_model, max(count, min_poses), seed, spread) for seed in (1, 2)]
            for size in sizes:
                yield Case({"scene": scene, **variant, "image_size": size, "images": count}, mj_model, batches)


def measure(settings: Settings, sizes: tuple[int, ...]) -> Iterator[Measurement]:
    """Yield images per second for each case of ``settings.scene`` and each output.

    Args:
        settings: Settings with a scene.
        sizes: Heights and widths of the images.
    """
    assert settings.scene is not None
    for case in cases(settings.scene, settings, sizes):
        for output in OUTPUTS:
            yield measure_output(case, output, settings.repeats)


def _image(scene: Scene, poses: dict[str, jax.Array], output: str) -> Any:
    """Render one image as planes: rgbd (uint8 and float32 metres), rgbd8 (all uint8) or depth (float32 metres)."""
    planes = render_planes(scene, SimpleNamespace(**poses), rgb=output != "depth", quantized=True)
    assert planes.depth is not None
    if planes.rgb is None:
        return planes.depth
    return planes.rgb, planes.depth if output == "rgbd" else quantize(planes.depth / _DEPTH_RANGE)


def measure_output(case: Case, output: str, repeats: int) -> Measurement:
    """Measure images per second of one output.

    Args:
        case: Scene, poses and sizes.
        output: One of `OUTPUTS`.
        repeats: Maximum number of timed repeats.
    """
    config, mj_model = {**case.config, "pixels": output}, case.mj_model
    count, size = config["images"], config["image_size"]
    scene = Scene.from_mjmodel(mj_model, 0, size, size)
    batches = [{name: jnp.asarray(rows[:count]) for name, rows in batch.items()} for batch in case.batches]
    draw = jaxrl_vis_envs.jit(jax.vmap(lambda poses: _image(scene, poses, output)))
    compiled, compile_s = compile_timed(draw, batches[0])
    assert_new_images(compiled, batches)
    timing = measure_time(alternate(compiled, batches), repeats)
    sample = {name: rows[:_SAMPLE] for name, rows in case.batches[0].items()}
    tests = models.needed_tests(mj_model, sample, size)
    pixel_operations = operations.operations_per_pixel(scene, tests, coloured=output != "depth")
    details = _effort(compiled, count * size * size, timing.median_s, float(np.sum(tests)), pixel_operations)
    details["drawn"] = len(scene.object_ids)
    return Measurement("render/scene", count / timing.median_s, "images/s", config, timing.details(compile_s, **details))


def _effort(compiled: Any, pixels: int, seconds: float, tests: float, pixel_operations: float | None) -> dict[str, Any]:
    """Return the details of a measurement's cost: ray-geom tests, operations, and memory.

    Args:
        compiled: Compiled program.
        pixels: Total number of pixels of all images.
        seconds: Duration of one call in seconds.
        tests: Tests per pixel under perfect culling.
        pixel_operations: Operations per pixel of these tests and the shading (`operations`); None if unknown.
    """
    effort: dict[str, Any] = {
        "needed_tests_per_pixel": round(tests, 2),
        "needed_gtests_per_s": round(1e-9 * tests * pixels / seconds, 2),
    }
    if pixel_operations is not None:
        effort["needed_operations_per_pixel"] = round(pixel_operations)
        effort["needed_tflop_per_s"] = round(1e-12 * pixel_operations * pixels / seconds, 4)
        peak = device_peak(jax.devices()[0].device_kind)
        if peak is not None:
            effort["share_of_peak_flops"] = round(pixel_operations * pixels / seconds / peak.vector, 4)
    memory = compiled.memory_analysis()
    if memory is not None and memory.output_size_in_bytes:
        output = memory.output_size_in_bytes
        effort["temporaries_over_output"] = round(memory.temp_size_in_bytes / output, 3)
        effort["largest_temporary_over_output"] = round(program_memory.largest_temporary(compiled) / output, 3)
    return effort
