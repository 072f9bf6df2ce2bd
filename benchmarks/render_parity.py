"""Compare our renderer with MuJoCo's own on many models, and print a table. Needs a GL library.

    MUJOCO_GL=egl python benchmarks/render_parity.py [MODEL ...] [--poses N] [--size PIXELS] [--out FILE] [--print | --page]
    MUJOCO_GL=egl python benchmarks/render_parity.py FOLDER [--size PIXELS] [--pictures FOLDER]

Every model of tests/render_models.py is rendered in N seeded random poses by both, with shadows, reflections and multisampling
off. Measures and bounds are defined in tests/render_comparison.py. The exit status is 1 if a bound is violated. A model that
our renderer refuses is a row of the table like any other, with the reason. `--page` writes the table of the rows in --out into
docs/lab/renderer_parity.md. With a FOLDER of third-party models (MJCF or URDF, at any depth), these are compared instead, each
in its initial and in a random pose: see `rendering.model_folder`.
"""

import argparse
import json
import os
import pathlib
import sys
import time
from collections.abc import Iterable
from typing import Any

ROOT = pathlib.Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "envs"), str(ROOT / "tests")]
if __name__ == "__main__" and sys.platform == "linux" and "DISPLAY" not in os.environ:
    os.environ.setdefault("MUJOCO_GL", "egl")  # the only choice without a display
os.environ.setdefault("JAX_PLATFORMS", "cpu")  # there are few images, and MuJoCo's renderer dominates the time

import jax  # noqa: E402
import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import render_models  # noqa: E402
from render_comparison import BOUNDS, Tally, surface_kinds  # noqa: E402

from benchmarks.ledger.markers import fill  # noqa: E402
from benchmarks.rendering import model_folder  # noqa: E402
from benchmarks.rendering.reference import ReferenceRenderer  # noqa: E402

TARGET = ROOT / "benchmarks" / "results" / "render_parity.json"
PAGE = ROOT / "docs" / "lab" / "renderer_parity.md"
BATCH = 10  # poses rendered at a time by ours
COLUMNS = {
    "segmentation": ("segm %", 100.0, 3),
    "iou": ("min IoU", 1.0, 3),
    "matched": ("min match", 1.0, 3),
    "depth": ("depth %", 100.0, 3),
    "bare_mean": ("rgb mean", 1.0, 2),
    "bare_p99": ("rgb p99", 1.0, 0),
    "textured_mean": ("textured mean", 1.0, 2),
    "plane_mean": ("plane mean", 1.0, 2),
    "sky_mean": ("sky mean", 1.0, 2),
}


def compare(name: str, poses: int, size: int) -> dict[str, Any]:
    """Render one model with both renderers, and compare the images; return the model's row."""
    entry = render_models.MODELS[name]
    device = jax.devices()[0].device_kind
    row: dict[str, Any] = {"model": name, "source": entry.source, "poses": poses, "size": size, "device": device}
    start = time.perf_counter()
    try:
        mj_model, camera = render_models.build(name)
        scene = render_models.make_scene(name, mj_model, camera, size, size)
    except (ValueError, ModuleNotFoundError) as error:
        return {**row, "refused": " ".join(str(error).split()), "failures": ["refused"]}
    mj_data, tally, ours_s = mujoco.MjData(mj_model), Tally(surface_kinds(mj_model)), 0.0
    with ReferenceRenderer(render_models.build(name, truth=True)[0], size, size, site_groups=entry.site_groups) as reference:
        for first in range(0, poses, BATCH):
            theirs, inputs = [], []
            # The last batch is padded, so that there is one compiled program; the surplus images are dropped.
            for number in range(first, first + BATCH):
                render_models.set_pose(mj_model, mj_data, number)
                inputs.append(render_models.poses_of(mj_data))
                if number < poses:
                    theirs.append(reference(mj_data, camera))
            mark = time.perf_counter()
            ours = render_models.draw(scene, inputs)
            ours_s += time.perf_counter() - mark
            for our, their in zip(ours, theirs, strict=False):
                tally.add(our, their)
    return {
        **row,
        "geoms": len(scene.object_ids),
        "measures": {name: None if np.isnan(value) else round(value, 5) for name, value in tally.measures().items()},
        "worst_iou": describe_worst(mj_model, tally.worst),
        "worst_match": describe_worst(mj_model, tally.worst_match),
        "failures": tally.failures(entry.limits),
        "seconds": {"ours": round(ours_s, 1), "all": round(time.perf_counter() - start, 1)},
    }


def describe_worst(mj_model: mujoco.MjModel, worst: tuple[float, int, int]) -> dict[str, Any]:
    """Return number and name of the geom, and the index of the pose, with the worst value of a measure.

    Args:
        mj_model: The model.
        worst: Value, number of the geom, and index of the pose.
    """
    _, number, pose = worst
    return {"object": number, "name": mj_model.geom(number).name if 0 <= number < mj_model.ngeom else "", "pose": pose}


def table_row(row: dict[str, Any]) -> str:
    """Format one row of the table as Markdown; a value that violates its bound is bold."""
    if "refused" in row:
        return (
            f"| {row['model']} | {row['source']} | | " + " | ".join("" for _ in COLUMNS) + f" | **refused**: {row['refused']} |"
        )
    cells = []
    for name, (_, scale, digits) in COLUMNS.items():
        value = row["measures"][name]
        text = "" if value is None else f"{scale * value:.{digits}f}"
        cells.append(f"**{text}**" if name in row["failures"] else text)
    verdict = "pass" if not row["failures"] else "**fail**: " + ", ".join(row["failures"])
    return f"| {row['model']} | {row['source']} | {row['geoms']} | {row['poses']} | {' | '.join(cells)} | {verdict} |"


def table_head() -> str:
    """Format names and bounds of the columns as Markdown."""
    names = ["model", "from", "drawn", "poses", *(title for title, _, _ in COLUMNS.values()), "verdict"]
    bounds = ["bound", "", "", ""]
    for name, (_, scale, _) in COLUMNS.items():
        bound = BOUNDS.get(name)
        bounds.append(f"{'≥' if bound.at_least else '≤'} {scale * bound.limit:g}" if bound else "")
    return "\n".join("| " + " | ".join(line) + " |" for line in (names, ["---"] * len(names), [*bounds, ""]))


def table(rows: Iterable[dict[str, Any]]) -> str:
    """Format the whole table as Markdown."""
    return "\n".join([table_head(), *map(table_row, rows)]) + "\n"


def read_rows(file: pathlib.Path) -> list[dict[str, Any]]:
    """Read the rows of a record."""
    return json.loads(file.read_text())["rows"]


def main() -> int:
    """Compare the named models, or all; return the exit status: 1 if a bound is violated, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", metavar="MODEL", help="all if none is named; or the path of one folder of models")
    parser.add_argument("--poses", type=int, default=200)
    parser.add_argument("--size", type=int, help="height and width in pixels (default: 128, of a folder 96)")
    parser.add_argument("--out", type=pathlib.Path, default=TARGET, help="rows of other models that this file holds are stored")
    parser.add_argument("--print", action="store_true", help="only print the rows that --out holds")
    parser.add_argument("--page", action="store_true", help=f"only write the rows that --out holds into {PAGE.name}")
    parser.add_argument(
        "--pictures", type=pathlib.Path, help="of a folder: where to write images (ours, MuJoCo's, difference x 8)"
    )
    options = parser.parse_args()
    if len(options.models) == 1 and pathlib.Path(options.models[0]).is_dir():
        return model_folder.report(pathlib.Path(options.models[0]), options.size or 96, options.pictures)
    unknown = set(options.models) - set(render_models.MODELS)
    if unknown:
        parser.error(f"no model {', '.join(sorted(unknown))}; there are {', '.join(render_models.MODELS)}")
    stored = json.loads(options.out.read_text()) if options.out.exists() else {"rows": []}
    rows = {row["model"]: row for row in stored["rows"] if row["model"] in render_models.MODELS}
    versions = render_models.versions()  # first, because a package may be missing
    failed = 0
    if options.page:
        PAGE.write_text(fill(PAGE.read_text(), "table", table(rows.values())))
    if options.print or options.page:
        print(table(rows.values()), end="")
        return int(any(row["failures"] for row in rows.values()))
    print(table_head())
    for name in options.models or render_models.MODELS:
        rows[name] = compare(name, options.poses, options.size or 128)
        failed += bool(rows[name]["failures"])
        print(table_row(rows[name]), flush=True)
        ordered = [rows[model] for model in render_models.MODELS if model in rows]
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps({"versions": versions, "rows": ordered}, indent=1) + "\n")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
