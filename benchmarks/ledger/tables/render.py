"""Tables of docs/lab/renderer_speed.md and docs/lab/meshes.md, from records of our and other renderers on the same poses."""

from pathlib import Path
from typing import Any

from benchmarks.ledger.tables.lab_results import format_short
from jaxrl_vis.bench.record import load

_WARP_RECORDS, _MUJOCO_RECORDS = "render-nvidia-h200-x1.json", "render-amd-epyc-2-cores.json"
_MESH_RECORDS = {"H100": "render-nvidia-h100-80gb-hbm3-x1.json", "H200": _WARP_RECORDS}
_OURS, _WARP, _MUJOCO = "render/scene", "render/peer_warp", "render/peer_mujoco"
_ORDER = ("finger", "fetch_reach", "primitives")
_TEXTURED = ("finger", "primitives")  # fetch_reach has no textures to omit
_OUTPUTS = {"rgbd": "RGB-D", "depth": "depth"}


def _label(config: dict[str, Any]) -> str:
    """Describe scene, poses and omitted features."""
    names = ("textures", "highlights") if config["scene"] in _TEXTURED else ()
    without = " and ".join(name for name in names if not config[name])
    poses = f"{config['poses']} poses" if config["scene"] == "primitives" else ""
    return ", ".join(part for part in (config["scene"], poses, without and f"without {without}") if part)


def _rank(record: dict[str, Any]) -> tuple[Any, ...]:
    config = record["config"]
    return _ORDER.index(config["scene"]), config["poses"], config["highlights"], config["textures"], config["image_size"]


def _rows(file: Path, peer: str) -> list[tuple[dict[str, Any], dict[str, Any] | None]]:
    """Pair our records with the peer's on the same poses; None for an output that the peer lacks."""
    records = load(file)
    peers = {str({**record["config"], "images": 0}): record for record in records if record["name"] == peer}
    ours = [record for record in records if record["name"] == _OURS and record["config"]["pixels"] in _OUTPUTS]
    ours = [record for record in ours if record["config"]["scene"] in _ORDER]
    drawn = [record for record in ours if record["config"]["scene"] in _TEXTURED or not record["config"]["textures"]]
    drawn = sorted(drawn, key=_rank)
    return [(record, peers.get(str({**record["config"], "images": 0}))) for record in drawn]


def _table(file: Path, peer: str, title: str, with_depth: bool) -> str:
    lines = [f"| scene | images | ours | {title} | ratio |", "|---|---|---|---|---|"]
    for ours, other in _rows(file, peer):
        if other is None and not with_depth:
            continue
        config = ours["config"]
        images = f"{config['image_size']}x{config['image_size']} {_OUTPUTS[config['pixels']]}, {config['images']:,}"
        rate, ratio = ("", "") if other is None else (format_short(other["value"]), f"{other['details']['ours_over_peer']:.3g}")
        lines.append(f"| {_label(config)} | {images} | {format_short(ours['value'])} | {rate} | {ratio} |")
    return "\n".join(lines)


def warp_table(results: Path) -> str:
    """Return a table that compares MuJoCo Warp's renderer with ours, in images per second, as Markdown."""
    return _table(results / _WARP_RECORDS, _WARP, "MuJoCo Warp 4.0.0", with_depth=False)


def mujoco_table(results: Path) -> str:
    """Return a table that compares MuJoCo's own renderer with ours, in images per second, as Markdown."""
    return _table(results / _MUJOCO_RECORDS, _MUJOCO, "`mujoco.Renderer`", with_depth=True)


def gpu_mesh_table(results: Path) -> str:
    """Return a table that compares MuJoCo Warp's renderer with ours on scenes of meshes, in images per second, as Markdown."""
    rows = [f"| {gpu} {row}" for gpu, file in _MESH_RECORDS.items() for row in _mesh_rows(results / file, _WARP)]
    return "\n".join(["| GPU | scene | images | ours | MuJoCo Warp 4.0.0 | ratio |", "|---|---|---|---|---|---|", *rows])


def cpu_mesh_table(results: Path) -> str:
    """Return a table that compares MuJoCo's own renderer with ours on scenes of meshes, in images per second, as Markdown."""
    title = ["| scene | images | ours | `mujoco.Renderer` | ratio |", "|---|---|---|---|---|"]
    return "\n".join([*title, *_mesh_rows(results / _MUJOCO_RECORDS, _MUJOCO)])


def _mesh_rows(file: Path, peer: str) -> list[str]:
    records = [record for record in load(file) if record["config"]["pixels"] == "rgbds"]
    ours = {str(record["config"]): record for record in records if record["name"] == _OURS}
    rows = []
    for record in records:
        if record["name"] != peer:
            continue
        config, size = record["config"], record["config"]["image_size"]
        names = [name for name in ("textures", "shadows") if config.get(name)]
        scene = config["scene"] + (f", with {' and '.join(names)}" if names else "")
        rates = (format_short(rate["value"]) for rate in (ours[str(config)], record))
        cells = [scene, f"{size}x{size}, {config['images']:,}", *rates, f"{record['details']['ours_over_peer']:.3g}"]
        rows.append(f"| {' | '.join(cells)} |")
    return rows
