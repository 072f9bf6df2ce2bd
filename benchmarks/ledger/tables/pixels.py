"""Tables of docs/pixels.md: Playground's tasks and training from their images, from the records of `benchmarks.pixels`."""

import json
from pathlib import Path
from typing import Any

from benchmarks.ledger.tables.lab_results import format_short
from jaxrl_vis.bench.record import load

_PARITY = "pixels_parity.json"
_SPEED = {"two cores": "pixels-amd-epyc-2-cores.json", "H100": "pixels-nvidia-h100-80gb-hbm3-x1.json"}
_TARGET = "pixels/speed_to_"
_MEASURES = (
    ("segmentation", "segmentation, %", 100.0, 2),
    ("matched", "worst match", 1.0, 3),
    ("depth", "depth, %", 100.0, 2),
    ("bare_mean", "colours", 1.0, 2),
)


def tasks_table(results: Path) -> str | None:
    """Return a table of camera, parity and, for each device with records, steps per second of all tasks; None without rows."""
    if not (results / _PARITY).exists():
        return None
    rows = json.loads((results / _PARITY).read_text())["rows"]
    speeds = {title: _speeds(results / name) for title, name in _SPEED.items() if (results / name).exists()}
    head = ["task", "camera", *(title for _, title, _, _ in _MEASURES), *(f"steps/s, {title}" for title in speeds)]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        cells = [row["task"], f"`{row['camera']}`", *(_cell(row, *measure) for measure in _MEASURES)]
        cells += [speed.get(row["task"], "") for speed in speeds.values()]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def training_table(results: Path) -> str | None:
    """Return a table of environment steps and times of `benchmarks.pixels.train` up to the targets; None without records."""
    records = [record for record in load(results / _SPEED["H100"]) if record["name"].startswith(_TARGET)]
    if not records:
        return None
    head = ["task", "target", "reached", "steps", "training, s", "with evaluations, s", "last evaluation", "revision"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for record in records:
        details, target = record["details"], float(record["name"].removeprefix(_TARGET))
        measure = next(name for name in details["evaluations"][0] if name not in ("env_steps", "wall_s", "training_s"))
        last = details["evaluations"][-1]
        cells = [
            record["config"]["task"],
            f"{measure} {target:g}",
            f"{details[measure]:g}",
            f"{details['env_steps']:,}",
            f"{details['training_s']:.0f}",
            f"{details['wall_s']:.0f}",
            f"{last[measure]:g} after {last['env_steps']:,}",
            record["revision"],
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(row: dict[str, Any], name: str, title: str, scale: float, digits: int) -> str:
    """Format a measure of a row, multiplied by ``scale``, with a number of ``digits``; in bold if it violates its bound."""
    value = row["measures"][name]
    text = "" if value is None else f"{scale * value:.{digits}f}"
    return f"**{text}**" if name in row["failures"] else text


def _speeds(path: Path) -> dict[str, str]:
    """Return the steps per second without and with images, as text, by task; tasks without both are missing."""
    values: dict[str, dict[str, float]] = {}
    for record in load(path):
        if record["name"] in ("pixels/steps", "pixels/steps_with_images"):
            values.setdefault(record["config"]["task"], {})[record["name"]] = record["value"]
    complete = {task: pair for task, pair in values.items() if len(pair) == 2}
    return {
        task: f"{format_short(pair['pixels/steps'])} / {format_short(pair['pixels/steps_with_images'])}"
        for task, pair in complete.items()
    }
