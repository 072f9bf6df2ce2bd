"""Measure images of MuJoCo Playground's dm_control suite: parity with `mujoco.Renderer`, and steps per second.

    MUJOCO_GL=egl python -m benchmarks.pixels [TASK ...] [--only parity|speed] [--envs N] [--gallery FILE]

All 25 tasks are measured if none is named, each with the first camera of its model. Parity needs a GL library and has the
bounds of `benchmarks.render_parity`; the exit status is 1 if one is violated. Needs MuJoCo Playground (pip install
playground). Records: pixels_parity.json, pixels-DEVICE.json.
"""

import argparse
import json
import os
import pathlib
import sys
from collections.abc import Sequence
from typing import Any

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "envs"), str(ROOT / "tests")]
if sys.platform == "linux" and "DISPLAY" not in os.environ:
    os.environ.setdefault("MUJOCO_GL", "egl")

import jax  # noqa: E402

from benchmarks.ledger.records import RESULTS  # noqa: E402
from benchmarks.pixels import gallery, playground, speed  # noqa: E402
from jaxrl_vis.bench.conditions import ConditionMonitor  # noqa: E402
from jaxrl_vis.bench.record import compare_and_keep  # noqa: E402
from jaxrl_vis.errors import RequestError  # noqa: E402
from jaxrl_vis.host.provenance import versions  # noqa: E402

PARITY = "pixels_parity.json"
GALLERY = ROOT / "docs" / "images" / "figure_pixels.png"
PARITY_SIZE, IMAGE_SIZE = 128, 64  # pixels


def measure_parity(tasks: Sequence[str], results: pathlib.Path, page: pathlib.Path | None) -> int:
    """Compare tasks with `mujoco.Renderer`, store their rows, and return the number of tasks that violate a bound.

    Args:
        tasks: Names of the tasks.
        results: Folder of stored records; rows of other tasks in it are kept.
        page: PNG file of the gallery; None for no gallery.
    """
    from benchmarks.pixels import parity  # needs the models of the tests, and GL

    path = results / PARITY
    stored = json.loads(path.read_text())["rows"] if path.exists() else []
    rows, pairs = {row["task"]: row for row in stored}, {}
    for task in tasks:
        comparison = parity.compare(task, PARITY_SIZE)
        rows[task] = row = comparison.row(task, PARITY_SIZE)
        print(f"{task:24} {row['camera']:14} {', '.join(row['failures']) or 'pass':24} {_short(row['measures'])}", flush=True)
        ordered = [rows[name] for name in playground.tasks() if name in rows]
        path.write_text(json.dumps({"versions": versions(), "rows": ordered}, indent=1) + "\n")
        pairs[task] = comparison.ours[0].rgb, comparison.theirs[0].rgb
        if page is not None:
            gallery.save(pairs, page)  # pyright: ignore[reportArgumentType]
    if page is not None:
        print(f"{page}: {page.stat().st_size / 1000:.0f} kB")
    return sum(bool(rows[task]["failures"]) for task in tasks)


def _short(measures: dict[str, Any]) -> str:
    names = ("segmentation", "iou", "matched", "depth", "bare_mean", "textured_mean", "plane_mean", "sky_mean")
    return " ".join(f"{name} {measures[name]:.4g}" for name in names if measures[name] is not None)


def measure_speed(tasks: Sequence[str], results: pathlib.Path, envs: int | None, steps: int | None, repeats: int) -> None:
    """Measure steps per second of tasks, and store the records.

    Args:
        tasks: Names of the tasks.
        results: Folder of stored records.
        envs: Number of environments; None for 1024, or 16 on a CPU.
        steps: Steps per timed call; None for 50, or 10 on a CPU.
        repeats: Maximum number of timed repeats.
    """
    on_cpu = jax.default_backend() == "cpu"
    count, length = envs or (16 if on_cpu else 1024), steps or (10 if on_cpu else 50)
    monitor = ConditionMonitor()
    for task in tasks:
        for measurement in speed.measure(task, count, length, IMAGE_SIZE, repeats):
            compare_and_keep("pixels", measurement, results, monitor.conditions())


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the named tasks, or all; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", metavar="TASK")
    parser.add_argument("--only", choices=("parity", "speed"), help="measure this alone")
    parser.add_argument("--envs", type=int, help="environments of a speed measurement (default: 1024, on a CPU 16)")
    parser.add_argument("--steps", type=int, help="steps per timed call (default: 50, on a CPU 10)")
    parser.add_argument("--repeats", type=int, default=5, help="maximum number of timed repeats; the median counts")
    parser.add_argument("--results", type=pathlib.Path, default=RESULTS, help="folder of stored records")
    parser.add_argument(
        "--gallery", type=pathlib.Path, nargs="?", const=GALLERY, help=f"write a page of images ({GALLERY.name})"
    )
    options = parser.parse_args(arguments)
    try:
        known = playground.tasks()
        unknown = set(options.tasks) - set(known)
        if unknown:
            raise RequestError(f"there is no task {', '.join(sorted(unknown))}; there are {', '.join(known)}")
        tasks = options.tasks or known
        failed = 0 if options.only == "speed" else measure_parity(tasks, options.results, options.gallery)
        if options.only != "parity":
            measure_speed(tasks, options.results, options.envs, options.steps, options.repeats)
    except RequestError as error:
        print(error, file=sys.stderr)
        return 2
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
