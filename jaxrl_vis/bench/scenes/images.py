"""Our renderer on the scenes of `models`: images per second of every output, size and batch.

Poses are in world coordinates; images have 8-bit colours and float32 depth in metres, those of meshes also labels. A
renderer's own preparation for a new pose (culling, refitting of bounding volumes) is included in its time.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
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
from jaxrl_vis.bench.variation import assert_new_images, cycle_batches
from jaxrl_vis_envs.render import Scene, quantize, render_planes

CPU_COUNTS = (64,)
ACCELERATOR_COUNTS = (4096,)
SCENE_CPU_COUNTS = {"clutter": (4,)}  # one of each camera, of which each takes a second
SCENE_ACCELERATOR_COUNTS = {"primitives": (8192,), "clutter": (8192,)}
CAMERAS = {"clutter": 4}
"""Number of cameras that view a scene, starting with its first; one if not listed."""
OUTPUTS = ("rgbd", "rgbd8", "depth")
MESH_OUTPUTS = ("rgbds", "rgbd", "depth")  # as the scenes of meshes that MuJoCo Warp publishes figures of: with labels
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
    "clutter": tuple({**VARIANTS[0], "shadows": shadows} for shadows in (False, True)),  # it has no textures
    **{
        scene: (*VARIANTS, {**VARIANTS[0], "shadows": True})  # the last if a light of theirs casts any
        for scene in models.MESH_SCENES
        if scene != "clutter"
    },
}
_CAMERA_LEAVES = ("camera_position", "camera_axes", "camera_shift", "camera_turn", "fovy", "focal", "principal", "sensor")


@dataclasses.dataclass(frozen=True)
class Case:
    """One scene in one variant, batch and image size.

    Attributes:
        config: Entries of a record: scene, poses, textures, highlights, image_size, images; shadows, for variants that differ
            in them; and cameras, if there are several.
        mj_model: Model; its first cameras are used.
        batches: Two sets of poses, see `models.random_poses`; the first `worlds` of each are rendered.
    """

    config: dict[str, Any]
    mj_model: mujoco.MjModel
    batches: list[dict[str, np.ndarray]]

    @property
    def cameras(self) -> int:
        """Number of cameras, of which each renders an image of every pose."""
        return self.config.get("cameras", 1)

    @property
    def worlds(self) -> int:
        """Number of poses in a batch."""
        return self.config["images"] // self.cameras

    @property
    def outputs(self) -> tuple[str, ...]:
        """Outputs to measure; peers render the first. Depth alone is omitted with shadows, which it does not show."""
        outputs = MESH_OUTPUTS if self.config.get("scene") in models.MESH_SCENES else OUTPUTS
        return tuple(output for output in outputs if output != "depth" or not self.config.get("shadows"))


def cases(scene: str, settings: Settings, sizes: tuple[int, ...], min_poses: int = 0) -> Iterator[Case]:
    """Yield every variant, batch and image size of a scene.

    Args:
        scene: Name or path, see `models.load`.
        settings: Settings, of which ``envs`` and ``on_accelerator`` are used.
        sizes: Heights and widths of the images.
        min_poses: Minimum number of poses in a batch.
    """
    cameras = CAMERAS.get(scene, 1)
    for variant in SCENE_VARIANTS.get(scene, VARIANTS):
        mj_model = models.load(scene, variant["textures"], variant["highlights"], variant.get("shadows", False))
        if variant.get("shadows") and not np.any(mj_model.light_castshadow & mj_model.light_active):
            continue
        spread = models.SPREADS[variant["poses"]]
        counts = (SCENE_CPU_COUNTS.get(scene, CPU_COUNTS), SCENE_ACCELERATOR_COUNTS.get(scene, ACCELERATOR_COUNTS))
        for count in settings.batch_sizes(*counts):
            worlds = -(-count // cameras)
            batches = [models.random_poses(mj_model, max(worlds, min_poses), seed, spread) for seed in (1, 2)]
            for size in sizes:
                config = {"scene": scene, **variant, "image_size": size, "images": worlds * cameras}
                yield Case(config | ({"cameras": cameras} if cameras > 1 else {}), mj_model, batches)


def measure(settings: Settings, sizes: tuple[int, ...]) -> Iterator[Measurement]:
    """Yield images per second for each case of ``settings.scene`` and each output.

    Args:
        settings: Settings with a scene.
        sizes: Heights and widths of the images.
    """
    assert settings.scene is not None
    for case in cases(settings.scene, settings, sizes):
        for output in case.outputs:
            yield measure_output(case, output, settings.repeats)


def make_scene(case: Case) -> Scene:
    """Build the scene of a case, seen by its first camera."""
    size = case.config["image_size"]
    return Scene.from_mjmodel(case.mj_model, 0, size, size, shadows=case.config.get("shadows", False))


def draw_all(case: Case, scene: Scene, poses: dict[str, jax.Array], draw: Callable[[Scene, Any], Any]) -> Any:
    """Render all images of a batch.

    Args:
        case: The case.
        scene: From `make_scene`.
        poses: Poses of the batch, [worlds, ...].
        draw: Function from a scene and the poses of one world to the arrays of one image.

    Returns:
        The arrays, [worlds, ...], or [worlds * cameras, ...] by pose and then by camera.
    """
    if case.cameras == 1:
        return jax.vmap(lambda one: draw(scene, SimpleNamespace(**one)))(poses)
    others = [Scene.from_mjmodel(case.mj_model, camera, 8, 8) for camera in range(case.cameras)]
    assert all(other.camera_mount == scene.camera_mount and other.projection == scene.projection for other in others)
    views = {name: jnp.stack([getattr(other, name) for other in others]) for name in _CAMERA_LEAVES}
    by_camera = jax.vmap(lambda view, one: draw(scene.replace(**view), SimpleNamespace(**one)), in_axes=(0, None))
    drawn = jax.vmap(by_camera, in_axes=(None, 0))(views, poses)
    return jax.tree.map(lambda plane: plane.reshape(-1, *plane.shape[2:]), drawn)


def _image(scene: Scene, poses: Any, output: str) -> Any:
    """Render one image as planes: rgbd (uint8 and float32 metres), rgbds (with int32 labels), rgbd8 (all uint8) or depth
    (float32 metres).
    """
    planes = render_planes(scene, poses, rgb=output != "depth", segmentation=output == "rgbds", quantized=True)
    assert planes.depth is not None
    if planes.rgb is None:
        return planes.depth
    if planes.segmentation is not None:
        return planes.rgb, planes.depth, planes.segmentation
    return planes.rgb, planes.depth if output == "rgbd" else quantize(planes.depth / _DEPTH_RANGE)


def measure_output(case: Case, output: str, repeats: int) -> Measurement:
    """Measure images per second of one output.

    Args:
        case: Scene, poses and sizes.
        output: One of ``case.outputs``.
        repeats: Maximum number of timed repeats.
    """
    config, mj_model = {**case.config, "pixels": output}, case.mj_model
    count, size = config["images"], config["image_size"]
    scene = make_scene(case)
    batches = [{name: jnp.asarray(rows[: case.worlds]) for name, rows in batch.items()} for batch in case.batches]

    # Tables of thousands of triangles are not constants of a program, unlike all that a scene without them has.
    scene_argument = None if scene.hierarchies is None else scene

    def draw(scene_argument: Scene | None, poses: dict[str, jax.Array]) -> Any:
        return draw_all(case, scene_argument or scene, poses, lambda scene, poses: _image(scene, poses, output))

    program, compile_s = compile_timed(jaxrl_vis_envs.jit(draw), scene_argument, batches[0])
    compiled = functools.partial(program, scene_argument)
    assert_new_images(compiled, batches)
    timing = measure_time(cycle_batches(compiled, batches), repeats)
    sample = {name: rows[:_SAMPLE] for name, rows in case.batches[0].items()}
    tests = models.needed_tests(mj_model, sample, size)
    pixel_operations = operations.operations_per_pixel(scene, tests, coloured=output != "depth")
    details = _cost_details(program, count * size * size, timing.median_s, float(np.sum(tests)), pixel_operations)
    details["drawn"] = len(scene.object_ids)
    return Measurement("render/scene", count / timing.median_s, "images/s", config, timing.details(compile_s, **details))


def _cost_details(compiled: Any, pixels: int, seconds: float, tests: float, pixel_operations: float | None) -> dict[str, Any]:
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
