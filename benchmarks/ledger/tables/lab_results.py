"""Tables of docs/lab/results.md: rows from `lab_rows`, figures from the records.

A figure without a record is written as `MISSING`, and `make stale` lists it.
"""

import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.ledger import evidence
from benchmarks.ledger.evidence import Evidence
from benchmarks.ledger.records import read_all
from benchmarks.ledger.tables.lab_rows import DEVICES, LEARNING, SPEED, Figure, Learning
from jaxrl_vis.config import config_from_dict
from jaxrl_vis.errors import RequestError
from jaxrl_vis.report.learning import curve, steps_to
from jaxrl_vis.run.command import training_command

PAGE = "docs/lab/results.md"
MISSING = "not measured yet"


def format_short(value: float) -> str:
    """Format a figure with three significant digits: 176 k, 1.73 M, 901, 12.3."""
    rounded = float(f"{value:.3g}")
    for factor, letter in ((1e6, " M"), (1e3, " k")):
        if rounded >= factor:
            return _three_digits(rounded / factor) + letter
    return _three_digits(rounded)


def _three_digits(value: float) -> str:
    return f"{value:.{max(0, 2 - len(str(int(value))) + 1)}f}"


def find_record(figure: Figure, device: str, records: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Select the record of a figure; return None if none matches.

    Of several matching records, the one with the largest value counts, or the smallest detail ``figure.minimum_of``.
    """
    matches = [
        record
        for record in records
        if record["name"] == figure.name
        and record["device"] == device
        and all(record["config"].get(name) == value for name, value in figure.config.items())
    ]
    if figure.minimum_of is not None:
        return min(matches, key=lambda record: record["details"][figure.minimum_of], default=None)
    return max(matches, key=lambda record: record["value"], default=None)


def _format_fields(record: dict[str, Any]) -> dict[str, Any]:
    """Return the fields for the format string of a figure."""
    config = record["config"]
    words = {**record["details"], **config, "value": format_short(record["value"])}
    if "mbyte" in words.get("roofline", {}):
        words["moved_gib"] = words["roofline"]["mbyte"] * 1e6 / 2**30
    if "pixels" in config:
        words["pixels"] = {"rgbd": "RGB-D", "rgb": "RGB", "depth": "depth"}.get(config["pixels"], config["pixels"])
    if "poses" in config:
        without = [word for word in ("textures", "highlights") if not config[word]]
        words["variant"] = f"{config['poses']} poses" + (f" without {' and '.join(without)}" if without else "")
    return words


def speed_cell(figures: tuple[Figure, ...], device: str, records: list[dict[str, Any]]) -> str:
    """Format the figures of one device, separated by semicolons; `MISSING` for those without a record."""
    shown = [(figure, find_record(figure, device, records)) for figure in figures]
    return "; ".join(MISSING if record is None else figure.text.format(**_format_fields(record)) for figure, record in shown)


def speed_table(results: Path) -> str:
    """Return the speed table as Markdown."""
    records = [record for _, record in read_all(results) if record["name"] != evidence.NAME]
    lines = [f"| benchmark | {' | '.join(DEVICES)} |", "|---" * (1 + len(DEVICES)) + "|"]
    for row in SPEED:
        cells = (speed_cell(row.figures.get(column, ()), device, records) for column, device in DEVICES.items())
        lines.append(f"| {row.label} | {' | '.join(cells)} |")
    return "\n".join(lines)


# Fields without an effect on learning; that of the logarithm has none if no loss takes one.
_NEUTRAL = ("checkpoint_interval", "full_checkpoint_interval")
_LOGARITHMIC = ("actor_log",)


def load_runs(row: Learning, results: Path) -> list[Evidence]:
    """Load the runs of a row; return an empty list if one is missing.

    Raises:
        RequestError: A run has a different configuration than the row, or its files are damaged.
    """
    runs = []
    for name, config in row.runs.items():
        run = evidence.load(name, results)
        if run is None:
            return []
        made_with = config_from_dict(run.record["config"])
        no_matter = (*_NEUTRAL, *_LOGARITHMIC) if config.auxiliary.weighting in ("none", "sum") else _NEUTRAL
        made_with = made_with.replace(**{name: config.value(name) for name in no_matter})
        if made_with != config:
            differing = [name for name, value in config.flat().items() if made_with.value(name) != value]
            raise RequestError(
                f"evidence {name} was made by `{run.record['command']}`, and the table says `{training_command(config)}`, "
                f"which has other {', '.join(differing)}: train again, then python -m benchmarks.ledger keep"
            )
        runs.append(run)
    return runs


def learning_text(row: Learning, runs: list[Evidence]) -> str:
    """Format the learning results of the runs of a row."""
    rows = [line for run in runs for line in run.rows]
    points = curve(rows, row.metric)
    parts = []
    for target in row.targets:
        steps = steps_to(points, target, row.lower_is_better)
        reached = "not reached" if steps is None else f"by {format_short(steps)} steps"
        parts.append(row.value_format.format(target) + f" {reached}")
    for budget in row.steps:
        steps, value = max(point for point in points if point[0] <= budget)
        parts.append(row.value_format.format(value) + f" at {format_short(steps)} steps")
    end, median = points[-1]
    finals = sorted(line[row.metric] for line in rows if line["env_steps"] == end)
    spread = f" ({finals[0]:.3g} to {finals[-1]:.3g})" if finals[0] != finals[-1] else ""
    parts.append(row.value_format.format(median) + f"{spread} at the end, {format_short(end)} steps")
    wall, compiling = (statistics.median(times) for times in zip(*(evidence.seconds(run.rows) for run in runs), strict=True))
    return (
        f"{'; '.join(parts)} (median of {len(finals)} seeds); {format_minutes(wall)}{' each' if len(runs) > 1 else ''}, "
        f"of which {format_minutes(compiling)} compiling"
    )


def format_minutes(seconds: float) -> str:
    """Format a duration in seconds: 43 s, or 1 min 37 s."""
    rounded = round(seconds)
    return f"{rounded} s" if rounded < 60 else f"{rounded // 60} min {rounded % 60} s"


def _machine(device: dict[str, Any]) -> str:
    if device["platform"] == "cpu":
        return f"{device['cpu_count']} CPU cores"
    return device["kind"] if device["count"] == 1 else f"{device['count']} x {device['kind']}"


def results_table(results: Path) -> str:
    """Return the results table as Markdown.

    Raises:
        RequestError: A run has a different configuration than its row, or its files are damaged.
    """
    lines = ["| experiment | machine | result | command |", "|---|---|---|---|"]
    for row in LEARNING:
        runs = load_runs(row, results)
        command = row.command or training_command(next(iter(row.runs.values())))
        machine = _machine(runs[0].record["device"]) if runs else ""
        lines.append(f"| {row.label} | {machine} | {learning_text(row, runs) if runs else MISSING} | `{command}` |")
    return "\n".join(lines)


def missing_rows(results: Path) -> Iterator[str]:
    """Yield a line of text for each row and figure without a record."""
    for row in LEARNING:
        missing = [name for name in row.runs if evidence.load(name, results) is None]
        if missing:
            yield f"row {row.label!r} has no evidence {', '.join(missing)}"
    records = [record for _, record in read_all(results)]
    for row in SPEED:
        for column, figures in row.figures.items():
            for figure in figures:
                if find_record(figure, DEVICES[column], records) is None:
                    yield f"row {row.label!r} has no record {figure.name} {figure.config} of {DEVICES[column]}"
