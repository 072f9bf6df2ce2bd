"""The README's tables, written from the records: the rows are declared in `table_rows`, the figures are not.

`jaxrl-vis bench --tables` writes what lies between the markers; a test compares. A figure without a record reads `MISSING`, and
`jaxrl-vis bench --check` lists it.
"""

import dataclasses
import re
import statistics
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from jaxrl_vis.bench import learning, record
from jaxrl_vis.bench.table_rows import DEVICES, LEARNING, SPEED, Figure, Learning
from jaxrl_vis.config import config_from_dict
from jaxrl_vis.errors import RequestError
from jaxrl_vis.files import write_atomically
from jaxrl_vis.report.learning import curve, steps_to
from jaxrl_vis.run.command import training_command

MISSING = "not measured yet"


def short(value: float) -> str:
    """Three significant digits: 176 k, 1.73 M, 901, 12.3."""
    rounded = float(f"{value:.3g}")
    for factor, letter in ((1e6, " M"), (1e3, " k")):
        if rounded >= factor:
            return _three_digits(rounded / factor) + letter
    return _three_digits(rounded)


def _three_digits(value: float) -> str:
    return f"{value:.{max(0, 2 - len(str(int(value))) + 1)}f}"


def find(figure: Figure, device: str, records: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The record that a figure shows; None where there is none."""
    found = [
        kept
        for kept in records
        if kept["name"] == figure.name
        and kept["device"] == device
        and all(kept["config"].get(name) == value for name, value in figure.config.items())
    ]
    if figure.least is not None:
        return min(found, key=lambda kept: kept["details"][figure.least], default=None)
    return max(found, key=lambda kept: kept["value"], default=None)


def _words(kept: dict[str, Any]) -> dict[str, Any]:
    """What a figure's text may mention."""
    config = kept["config"]
    words = {**kept["details"], **config, "value": short(kept["value"])}
    if "mbyte" in words.get("roofline", {}):
        words["moved_gib"] = words["roofline"]["mbyte"] * 1e6 / 2**30
    if "pixels" in config:
        words["pixels"] = {"rgbd": "RGB-D", "rgb": "RGB", "depth": "depth"}.get(config["pixels"], config["pixels"])
    if "poses" in config:
        without = [word for word in ("textures", "highlights") if not config[word]]
        words["variant"] = f"{config['poses']} poses" + (f" without {' and '.join(without)}" if without else "")
    return words


def speed_cell(figures: tuple[Figure, ...], device: str, records: list[dict[str, Any]]) -> str:
    """The figures of one device in words."""
    found = [(figure, find(figure, device, records)) for figure in figures]
    return "; ".join(MISSING if kept is None else figure.text.format(**_words(kept)) for figure, kept in found)


def speed_table(results: Path) -> str:
    """The speed table, as Markdown."""
    records = [kept for _, kept in record.read_all(results) if kept["name"] != learning.NAME]
    lines = [f"| what | {' | '.join(DEVICES)} |", "|---" * (1 + len(DEVICES)) + "|"]
    for row in SPEED:
        cells = (speed_cell(row.figures.get(column, ()), device, records) for column, device in DEVICES.items())
        lines.append(f"| {row.label} | {' | '.join(cells)} |")
    return "\n".join(lines)


# What a run leaves on the disk, and by which way it finds the same gradients: not what it learns.
_NO_MATTER = ("checkpoint_interval", "full_checkpoint_interval", "aux_gradients")
_OF_LOGARITHMS = ("actor_log",)


def evidence_of(row: Learning, results: Path) -> list[learning.Evidence]:
    """The runs behind a row; none where one is missing.

    Raises:
        RequestError: A run was trained with another configuration than the row says.
    """
    found = []
    for name, config in row.runs.items():
        evidence = learning.load(name, results)
        if evidence is None:
            return []
        made_with = config_from_dict(evidence.record["config"])
        no_matter = (*_NO_MATTER, *_OF_LOGARITHMS) if config.weighting in ("none", "sum") else _NO_MATTER
        made_with = made_with.replace(**{field: getattr(config, field) for field in no_matter})
        if made_with != config:
            names = [field.name for field in dataclasses.fields(config)]
            differ = [each for each in names if getattr(made_with, each) != getattr(config, each)]
            raise RequestError(
                f"evidence {name} was made by `{evidence.record['command']}`, "
                f"and the README says `{training_command(config)}`, "
                f"which has other {', '.join(differ)}: train it anew, then benchmarks/keep_learning.py"
            )
        found.append(evidence)
    return found


def learning_text(row: Learning, found: list[learning.Evidence]) -> str:
    """What the runs reached, in words."""
    rows = [line for evidence in found for line in evidence.rows]
    points = curve(rows, row.metric)
    parts = []
    for target in row.targets:
        steps = steps_to(points, target, row.least)
        reached = "not reached" if steps is None else f"by {short(steps)} steps"
        parts.append(row.word.format(target) + f" {reached}")
    for asked in row.steps:
        steps, value = max(point for point in points if point[0] <= asked)
        parts.append(row.word.format(value) + f" at {short(steps)} steps")
    end, median = points[-1]
    finals = sorted(line[row.metric] for line in rows if line["env_steps"] == end)
    spread = f" ({finals[0]:.3g} to {finals[-1]:.3g})" if finals[0] != finals[-1] else ""
    parts.append(row.word.format(median) + f"{spread} at the end, {short(end)} steps")
    wall, compiling = (statistics.median(parts) for parts in zip(*(learning.seconds(each.rows) for each in found), strict=True))
    return (
        f"{'; '.join(parts)} (median of {len(finals)} seeds); {minutes(wall)}{' each' if len(found) > 1 else ''}, "
        f"of which {minutes(compiling)} compiling"
    )


def minutes(seconds: float) -> str:
    """43 s, or 1 min 37 s."""
    whole = round(seconds)
    return f"{whole} s" if whole < 60 else f"{whole // 60} min {whole % 60} s"


def _machine(device: dict[str, Any]) -> str:
    if device["platform"] == "cpu":
        return f"{device['cpu_count']} CPU cores"
    return device["kind"] if device["count"] == 1 else f"{device['count']} x {device['kind']}"


def results_table(results: Path) -> str:
    """The results table, as Markdown."""
    lines = ["| what | machine | figure | command |", "|---|---|---|---|"]
    for row in LEARNING:
        found = evidence_of(row, results)
        command = row.command or training_command(next(iter(row.runs.values())))
        machine = _machine(found[0].record["device"]) if found else ""
        lines.append(f"| {row.label} | {machine} | {learning_text(row, found) if found else MISSING} | `{command}` |")
    return "\n".join(lines)


TABLES: dict[str, Callable[[Path], str]] = {"results table": results_table, "speed table": speed_table}
"""Name in the markers -> what writes it."""


def filled(text: str, results: Path) -> str:
    """``text`` with every table between its markers written anew.

    Raises:
        RequestError: A marker is missing, evidence contradicts its row, or records cannot be read.
    """
    for name, write in TABLES.items():
        pattern = re.compile(rf"(<!-- {name}: begin[^>]*-->\n).*?(<!-- {name}: end -->)", re.DOTALL)
        if not pattern.search(text):
            raise RequestError(f"there are no markers <!-- {name}: begin --> and <!-- {name}: end -->")
        table = write(results)
        text = pattern.sub(lambda found, table=table: found[1] + table + "\n" + found[2], text)
    return text


def write_tables(readme: Path, results: Path) -> bool:
    """Writes the tables of ``readme`` anew; whether that changed something.

    Raises:
        RequestError: See `filled`; or there is no such file.
    """
    if not readme.exists():
        raise RequestError(f"there is no {readme}: the tables are those of a checkout")
    before = readme.read_text(encoding="utf-8")
    after = filled(before, results)
    if after != before:
        write_atomically(readme, after)
    return after != before


def missing_rows(results: Path) -> Iterator[str]:
    """The rows and figures that have no record."""
    for row in LEARNING:
        missing = [name for name in row.runs if learning.load(name, results) is None]
        if missing:
            yield f"row {row.label!r} has no evidence {', '.join(missing)}"
    records = [kept for _, kept in record.read_all(results)]
    for row in SPEED:
        for column, figures in row.figures.items():
            for figure in figures:
                if find(figure, DEVICES[column], records) is None:
                    yield f"row {row.label!r} has no record {figure.name} {figure.config} of {DEVICES[column]}"
