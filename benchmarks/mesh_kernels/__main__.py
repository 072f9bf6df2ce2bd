"""Times two designs of a mesh kernel and MuJoCo Warp on the clutter of 500 meshes, and says go or no-go. Needs an NVIDIA GPU.

    XLA_PYTHON_CLIENT_MEM_FRACTION=.5 python -m benchmarks.mesh_kernels --worlds 2048

All draw depth, geom and a colour of four 64x64 images per world from world poses, and the work on these is timed. A row says
how many pixels agree with the first renderer that drew: depth within 1 cm or 1 %, and the geom. `--interpret` tries all
without a GPU, slowly: `--worlds 1 --instances 24 --image-size 16`.
"""

import argparse
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from benchmarks.mesh_kernels import raster, structure, views, walk
from benchmarks.peers.image_comparison import depth_agreement
from jaxrl_vis.bench.scenes import clutter, models
from jaxrl_vis.bench.timing import compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.bench.variation import alternate

COMPARED = 64
"""Images whose pixels are compared."""
DEPTH_AGREEMENT, GEOM_AGREEMENT = 0.995, 0.99


class Row(NamedTuple):
    """One renderer: its images per second and the first images' depth [K, P] (m) and geom [K, P]."""

    name: str
    rate: float
    spread: float
    compile_s: float
    depth: np.ndarray
    geom: np.ndarray
    note: str = ""


class Setting(NamedTuple):
    """What all renderers draw: model, two batches of poses, worlds, and height and width."""

    mj_model: mujoco.MjModel
    batches: list[dict[str, np.ndarray]]
    worlds: int
    size: int

    @property
    def images(self) -> int:
        """Number of images of a batch."""
        return self.worlds * self.mj_model.ncam

    @property
    def far(self) -> float:
        """Depth of the far plane, m."""
        return float(self.mj_model.vis.map.zfar * self.mj_model.stat.extent)


# Options of MuJoCo Warp: the least that draws what the kernels draw; with its own lighting; and with shadows.
_LEAST = dict(use_textures=False, use_ambient_lighting=False, enable_specular=False, enable_emission=False)
_LEAST |= dict(enable_per_light_ambient=False, enable_vertex_normals=False, enable_backface_culling=False, use_shadows=False)
_LIT = {**_LEAST, "use_ambient_lighting": True, "enable_specular": True, "enable_vertex_normals": True}
WARP = {"Warp, least": _LEAST, "Warp, lit, shadows": {**_LIT, "use_shadows": True}, "Warp, lit": _LIT}


def warp_row(name: str, setting: Setting, repeats: int) -> Row:
    """Measure MuJoCo Warp: the bounding volumes' refit and all cameras, in a CUDA graph for each batch."""
    import mujoco_warp as mjw  # pyright: ignore[reportMissingImports]
    import warp as wp  # pyright: ignore[reportMissingImports]

    from benchmarks.peers import warp

    start = time.perf_counter()
    model = mjw.put_model(setting.mj_model)
    context = mjw.create_render_context(
        setting.mj_model,
        nworld=setting.worlds,
        cam_res=(setting.size, setting.size),
        render_rgb=True,
        render_depth=True,
        render_seg=True,
        **WARP[name],
    )
    blank = mjw.make_data(setting.mj_model, nworld=1)
    datas = [warp._set_poses(blank, batch) for batch in setting.batches]

    def launch(data: Any) -> None:
        mjw.refit_bvh(model, data, context)
        mjw.render(model, data, context)

    for data in datas:
        launch(data)
    wp.synchronize()
    draws: list[Callable[[], None]] = [lambda data=data: launch(data) for data in datas]
    if wp.get_device().is_cuda:
        graphs = []
        for data in datas:
            with wp.ScopedCapture() as capture:
                launch(data)
            graphs.append(capture.graph)
        draws = [lambda graph=graph: wp.capture_launch(graph) for graph in graphs]
    compile_s = time.perf_counter() - start
    draws[0]()
    wp.synchronize()
    pixels = setting.size**2
    # Copies: without a GPU these are views of buffers that the timing overwrites.
    depth = np.array(context.depth_data.numpy().reshape(setting.images, pixels)[:COMPARED])
    geom = context.seg_data.numpy().reshape(setting.images, pixels, -1)[:COMPARED, :, 0].astype(np.int32)
    timing = measure_time(alternate(lambda draw: draw(), draws), repeats, wait=lambda _: wp.synchronize())
    del datas
    return Row(name, setting.images / timing.median_s, timing.spread, compile_s, np.where(depth > 0, depth, np.inf), geom)


def our_row(
    name: str, setting: Setting, draw: Callable[[Any], tuple[walk.Images, jax.Array]], tables: Any, repeats: int
) -> Row:
    """Measure one of our kernels, from world poses to images.

    Args:
        name: Name of the row.
        setting: What is drawn.
        draw: Function of poses and ``tables``.
        tables: Arrays of the meshes, which are an argument so that they are no constants of the program.
        repeats: Maximum number of timed repeats.
    """
    batches = [{name: jnp.asarray(rows) for name, rows in batch.items()} for batch in setting.batches]
    compiled, compile_s = compile_timed(jax.jit(draw), batches[0], tables)
    images, longest = jax.block_until_ready(compiled(batches[0], tables))
    depth = np.asarray(images.depth[:COMPARED])
    geom = np.asarray(images.geom[:COMPARED])
    timing = measure_time(alternate(lambda batch: compiled(batch, tables)[0], batches), repeats)
    depth = np.where(depth < 0.999 * setting.far, depth, np.inf)
    note = f"longest list {int(longest)}" if int(longest) else ""
    return Row(name, setting.images / timing.median_s, timing.spread, compile_s, depth, geom, note)


def variants(setting: Setting, interpret: bool) -> Iterator[tuple[str, Callable[[], tuple[Callable, Any]]]]:
    """Yield names of our kernels in several shapes, most promising first, and functions that make them with their tables."""
    built: dict[int, structure.Structure] = {}

    def structures(leaf: int) -> structure.Structure:
        if leaf not in built:
            built[leaf] = structure.build(setting.mj_model, leaf)
        return built[leaf]

    half = views.half_height(setting.mj_model)
    znear = float(setting.mj_model.vis.map.znear * setting.mj_model.stat.extent)

    def make(leaf: int, draw: Callable[..., Any]) -> Callable[[], tuple[Callable, Any]]:
        def prepared() -> tuple[Callable, Any]:
            meshes = structures(leaf)
            names = ("nodes", "maps", "balls", "small_maps", "cones", "corners")
            tables = {name: jnp.asarray(getattr(meshes, name)) for name in names}
            tables["rgba"] = jnp.asarray(setting.mj_model.geom_rgba.T, jnp.float32)

            def from_poses(poses: dict[str, jax.Array], tables: Any) -> Any:
                seen = views.make_views(setting.mj_model, meshes, setting.size, poses)
                return draw(seen, meshes, tables, setting.size, half, znear)

            return from_poses, tables

        return prepared

    def walking(tile: tuple[int, int], warps: int, steps: int = 4, scan: int = 2, by_block: bool = False) -> Callable:
        shape = walk.Settings(tile, warps, steps, scan, most={32: 96, 64: 128, 128: 192}[tile[0] * tile[1]])
        return lambda *inputs: walk.draw(*inputs, shape, by_block, interpret)

    def binning(design: str, tile: tuple[int, int] = (8, 8), warps: int = 2) -> Callable:
        return lambda *inputs: raster.draw(*inputs, raster.Settings(tile, warps), design, interpret)

    def only_views(seen: views.Views, *_: Any) -> Any:
        return walk.Images(seen.depth + jnp.sum(seen.pose[:, :, 0], 1, keepdims=True) * 1e-20, seen.floor, seen.rectangle), 0

    yield "(b) lanes 4x8, 1 warp, steps 4, leaf 2", make(2, walking((4, 8), 1))
    yield "(a) scatter, 2 warps", make(2, binning("scatter"))
    yield "(b) lanes 8x8, 2 warps, steps 4, leaf 2", make(2, walking((8, 8), 2))
    yield "(b) block 4x8, 1 warp, leaf 2", make(2, walking((4, 8), 1, by_block=True))
    yield "(a) tiles 8x8, 2 warps", make(2, binning("tiles"))
    yield "views alone, no kernel", make(2, only_views)
    yield "(b) lanes 4x8, 1 warp, steps 8, leaf 2", make(2, walking((4, 8), 1, 8))
    yield "(b) lanes 4x8, 1 warp, steps 2, leaf 2", make(2, walking((4, 8), 1, 2, 1))
    yield "(b) lanes 4x8, 1 warp, steps 4, leaf 4", make(4, walking((4, 8), 1))
    yield "(a) scatter, 1 warp", make(2, binning("scatter", warps=1))
    yield "(b) lanes 8x16, 4 warps, steps 4, leaf 2", make(2, walking((8, 16), 4))
    yield "(b) lanes 8x8, 1 warp, steps 4, leaf 2", make(2, walking((8, 8), 1))
    yield "(a) tiles 4x8, 1 warp", make(2, binning("tiles", (4, 8), 1))


def verdict(rows: list[Row]) -> str:
    """Return the rule, and what it says of these rows."""
    rule = "go if (a) or (b) reaches at least the speed of Warp's fastest row without shadows, on images that agree"
    peers = [row for row in rows if row.name.startswith("Warp") and "shadows" not in row.name]
    ours = [row for row in rows if row.name.startswith("(") and agrees(row, rows[0])]
    if not peers or not ours:
        return f"{rule}: undecided, {'no row of Warp' if not peers else 'no kernel drew what was asked'}"
    peer, best = max(peers, key=lambda row: row.rate), max(ours, key=lambda row: row.rate)
    says = "GO" if best.rate >= peer.rate else "NO-GO"
    return f"{rule}: {says}, {best.name} at {best.rate / peer.rate:.2f} times {peer.name}"


def agreement(row: Row, reference: Row) -> tuple[float, float]:
    """Return the shares of pixels whose depth and whose geom agree with those of another renderer."""
    if row.geom.shape != reference.geom.shape or row.name.startswith("views"):
        return 0.0, 0.0
    return depth_agreement(reference.depth, row.depth), float(np.mean(row.geom == reference.geom))


def agrees(row: Row, reference: Row) -> bool:
    """Return True if depth and geom agree on enough pixels."""
    depth, geom = agreement(row, reference)
    return depth >= DEPTH_AGREEMENT and geom >= GEOM_AGREEMENT


def show(row: Row, reference: Row) -> None:
    """Print one row of the table."""
    depth, geom = agreement(row, reference)
    cells = (row.name, f"{row.rate:,.0f}", f"{row.spread:.3f}", f"{depth:.4f}", f"{geom:.4f}", f"{row.compile_s:.0f}", row.note)
    print("| " + " | ".join(cells) + " |", flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Measure, print the table and the verdict; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=2048)
    parser.add_argument("--instances", type=int, default=clutter.INSTANCES)
    parser.add_argument("--image-size", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=420.0, help="time after which no further row starts")
    parser.add_argument("--without-warp", action="store_true")
    parser.add_argument("--only", default="", help="rows whose name contains this")
    parser.add_argument("--interpret", action="store_true", help="run our kernels without a GPU")
    options = parser.parse_args(arguments)
    begin = time.perf_counter()
    mj_model = clutter.clutter_spec(instances=options.instances).compile()
    batches = [models.random_poses(mj_model, options.worlds, seed) for seed in (1, 2)]
    setting = Setting(mj_model, batches, options.worlds, options.image_size)
    device = jax.devices()[0].device_kind
    print(f"{device}, {setting.images} images of {setting.size}x{setting.size}, {mj_model.ngeom} geoms; poses after", end=" ")
    print(f"{time.perf_counter() - begin:.0f} s\n| renderer | images/s | spread | depth | geom | compiled, s | |")
    print("|---|---|---|---|---|---|---|", flush=True)

    def ours(name: str, made: Callable) -> Row:
        return our_row(name, setting, *made(), options.repeats)

    peers = [(name, lambda name=name: warp_row(name, setting, options.repeats)) for name in WARP if not options.without_warp]
    kernels = [(name, lambda name=name, made=made: ours(name, made)) for name, made in variants(setting, options.interpret)]
    work: list[tuple[str, Callable[[], Row]]] = [*peers[:1], *kernels[:6], *peers[1:], *kernels[6:]]
    rows: list[Row] = []
    for name, measure in work:
        if options.only not in name:
            continue
        if time.perf_counter() - begin > options.seconds:
            print(f"| {name} | no time left |", flush=True)
            continue
        try:
            rows.append(measure())
        except Exception as error:  # one design that fails must not hide the others
            print(f"| {name} | failed: {type(error).__name__}: {' '.join(str(error).split())[:300]} |", flush=True)
            traceback.print_exc(limit=-3)
            continue
        show(rows[-1], rows[0])
    if options.interpret:
        print("no verdict without a GPU: only whether the images agree counts")
    else:
        print(verdict(rows) if rows else "nothing was measured")
    return 0


if __name__ == "__main__":
    sys.exit(main())
