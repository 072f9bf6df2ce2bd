"""Our renderer on the scenes of `render_scenes`, and other renderers beside it in the same run, on the same poses.

All are given poses in world coordinates, and write 8-bit colours and float32 depth in metres, without shadows. What a renderer
does to prepare for a new pose (culling, refitting of bounding volumes) is part of its figure.
"""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis.bench import mujoco_renderer, program_memory, render_operations, render_scenes, warp_renderer
from jaxrl_vis.bench.comparison import compare
from jaxrl_vis.bench.peaks import peak_of
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.bench.timing import compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.variation import alternate, assert_new_images
from jaxrl_vis_envs.compilation import env_jit
from jaxrl_vis_envs.render import Scene, quantize, render_planes

CPU_COUNTS = (64,)
ACCELERATOR_COUNTS = (4096,)
ACCELERATOR_COUNTS_OF = {"primitives": (8192,)}
CPU_SCENES = ("finger", "fetch_reach")
PEERS: dict[str, Any] = {"mujoco": mujoco_renderer, "warp": warp_renderer}
_SAMPLE = 32  # poses in which the needed tests are counted
_DEPTH_RANGE = 10.0  # metres that an 8-bit depth spans

# Without textures first: that is what MuJoCo Warp is fastest at.
VARIANTS = tuple({"poses": "scattered", "textures": textures, "highlights": True} for textures in (False, True))
# Its own scene also as it measures it: at the start, where its bounding volumes fit best, and without highlights.
VARIANTS_OF = {
    "primitives": (
        *VARIANTS,
        *({**variant, "poses": "start"} for variant in VARIANTS),
        {"poses": "start", "textures": False, "highlights": False},
    )
}


def measure(settings: Settings, sizes: tuple[int, ...]) -> Iterator[Measurement]:
    """Images per second of every scene and size: each output of ours, then the peer.

    Args:
        settings: ``scene`` and ``peer`` count, and what `Settings` says of all benchmarks.
        sizes: Heights and widths.
    """
    if settings.peer is not None:
        PEERS[settings.peer].check()  # First: it is the part that may be missing.
    scenes = render_scenes.SCENES if settings.on_accelerator else CPU_SCENES
    for scene in (settings.scene,) if settings.scene else scenes:
        for variant in VARIANTS_OF.get(scene, VARIANTS):
            mj_model = render_scenes.load(scene, variant["textures"], variant["highlights"])
            spread = render_scenes.SPREADS[variant["poses"]]
            for count in settings.counts(CPU_COUNTS, ACCELERATOR_COUNTS_OF.get(scene, ACCELERATOR_COUNTS)):
                most = max(count, mujoco_renderer.POSES)
                batches = [render_scenes.random_poses(mj_model, most, seed, spread) for seed in (1, 2)]
                for size in sizes:
                    config = {"scene": scene, **variant, "image_size": size, "images": count}
                    yield from _measure_size(settings, config, mj_model, batches)


def _measure_size(settings: Settings, config: dict[str, Any], mj_model: mujoco.MjModel, batches: list) -> Iterator[Measurement]:
    """All outputs of ours for one scene, size and batch, and the peer, which has one output: our first."""
    rates = {}
    for output in ("rgbd", "rgbd8", "depth"):
        found = _measure_ours(settings, {**config, "pixels": output}, mj_model, batches)
        rates[output] = found.value
        yield found
    if settings.peer is not None:
        asked = {**config, "pixels": "rgbd"}
        yield PEERS[settings.peer].measure(compare(asked, mj_model, batches, settings.repeats, rates["rgbd"]))


def _image(scene: Scene, poses: dict[str, jax.Array], output: str) -> Any:
    """One image as planes: rgbd (uint8 and float32 metres), rgbd8 (all uint8) or depth (float32 metres)."""
    planes = render_planes(scene, SimpleNamespace(**poses), rgb=output != "depth", quantized=True)
    assert planes.depth is not None
    if planes.rgb is None:
        return planes.depth
    return planes.rgb, planes.depth if output == "rgbd" else quantize(planes.depth / _DEPTH_RANGE)


def _measure_ours(settings: Settings, config: dict[str, Any], mj_model: mujoco.MjModel, batches: list) -> Measurement:
    count, size, output = config["images"], config["image_size"], config["pixels"]
    scene = Scene.from_mjmodel(mj_model, 0, size, size)
    some = [{name: jnp.asarray(rows[:count]) for name, rows in batch.items()} for batch in batches]
    draw = env_jit(jax.vmap(lambda poses: _image(scene, poses, output)))
    compiled, compile_s = compile_timed(draw, some[0])
    assert_new_images(compiled, some)
    timing = measure_time(alternate(compiled, some), settings.repeats)
    sample = {name: rows[:_SAMPLE] for name, rows in batches[0].items()}
    needed = render_scenes.needed_tests(mj_model, sample, size)
    operations = render_operations.operations_per_pixel(scene, needed, coloured=output != "depth")
    details = _effort(compiled, count * size * size, timing.median_s, float(np.sum(needed)), operations)
    details["drawn"] = len(scene.object_ids)
    return Measurement("render/scene", count / timing.median_s, "images/s", config, timing.details(compile_s, **details))


def _effort(compiled: Any, pixels: int, seconds: float, tests: float, operations: float | None) -> dict[str, Any]:
    """What the figure cost: ray-geom tests, operations, and memory.

    Args:
        compiled: The program.
        pixels: Of all images together.
        seconds: Of one call.
        tests: A pixel, which perfect culling would leave.
        operations: A pixel, which these tests and the shading take (`render_operations`); None where that is not known.
    """
    effort: dict[str, Any] = {
        "needed_tests_per_pixel": round(tests, 2),
        "needed_gtests_per_s": round(1e-9 * tests * pixels / seconds, 2),
    }
    if operations is not None:
        effort["needed_operations_per_pixel"] = round(operations)
        effort["needed_tflop_per_s"] = round(1e-12 * operations * pixels / seconds, 4)
        peak = peak_of(jax.devices()[0].device_kind)
        if peak is not None:
            effort["share_of_peak_flops"] = round(operations * pixels / seconds / peak.vector, 4)
    memory = compiled.memory_analysis()
    if memory is not None and memory.output_size_in_bytes:
        output = memory.output_size_in_bytes
        effort["temporaries_over_output"] = round(memory.temp_size_in_bytes / output, 3)
        effort["largest_temporary_over_output"] = round(program_memory.largest_temporary(compiled) / output, 3)
    return effort
