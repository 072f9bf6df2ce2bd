"""Plans of fields: what is known of each plot (range, row, genotype, replicate, ...), from a CSV or an export of Field Book."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.spreadsheets import unescape_cell
from jaxrl_vis.stalks.phenotyping.io.names import readable
from jaxrl_vis.stalks.phenotyping.io.tables.cells import cells, read_table_text

_MAX_BYTES = 50_000_000
_IDS = (
    "plot_id",
    "plotid",
    "plot_name",
    "plotname",
    "observationunitname",
    "observationunitdbid",
    "unique_id",
    "plotbarcode",
    "plot",
    "plot_no",
    "plotno",
    "plot_number",
    "plotnumber",
)
"""Columns that name plots, in small letters; the first that names plots of the run is taken."""
_SHOWN = 3
_OBSERVED = {"trait", "uservalue", "value", "timetaken", "time_taken", "person", "location", "number", "rep_number", "photo"}
"""Columns of Field Book's export of observations, one a row, that say nothing of the plot."""


def read_field_plan(path: Path, plots: Sequence[str]) -> tuple[list[str], dict[str, dict[str, str]]]:
    """Read the plan of a field: the columns of a table, by plot.

    Args:
        path: A CSV with a row for each plot, or, as Field Book exports observations, several that say the same of it.
        plots: Names of the plots, which are ways in folders: the last part or all of one is what the table calls the plot, with
            or without the word plot and zeros before its number; or it holds the numbers of its range and its row or column.

    Returns:
        Names of the columns in their order, without the one that names plots; and by plot, the texts in them.

    Raises:
        RequestError: The table cannot be read, names no plot of these, or says two things of one.
    """
    columns, rows, _ = cells(path, read_table_text(path, _MAX_BYTES))
    small = [name.lower().replace(" ", "_") for name in columns]
    ids = [small.index(name) for name in _IDS if name in small]
    if not columns or len(set(small)) < len(small):
        raise RequestError(f"{path} is no plan of a field: its first line must name columns, each once")
    table = [
        [unescape_cell(row[place].strip()) if place < len(row) else "" for place in range(len(columns))] for _, row in rows
    ]
    by_column = [(place, _matched([row[place] for row in table], plots)) for place in ids]
    place, matched = max(by_column, key=lambda found: len(found[1]), default=(None, {}))
    if not matched:
        matched, place = _by_range(small, table, plots), None
    if not matched:
        raise RequestError(
            _none_there(path, [columns[one] for one in ids], [row[ids[0]] for row in table] if ids else [], plots)
        )
    kept = [one for one in range(len(columns)) if one != place and small[one] not in _OBSERVED]
    plan: dict[str, dict[str, str]] = {}
    for plot, numbers in matched.items():
        values: dict[str, str] = {}
        for one in kept:
            said = {table[number][one] for number in numbers if table[number][one]}
            if len(said) > 1 and len(numbers) < len(table):
                both = " and ".join(sorted(said)[:2])
                raise RequestError(f"{path} says two things of {columns[one]} of plot {readable(plot)}: {both}")
            values[columns[one]] = said.pop() if len(said) == 1 else ""
        plan[plot] = values
    return [columns[one] for one in kept], plan


def _matched(names: Sequence[str], plots: Sequence[str]) -> dict[str, list[int]]:
    """Numbers of rows by the plot that they are of, by the first way of comparing names that tells the plots apart."""
    for way in (str, _last, _number):
        rows: dict[str, list[int]] = {}
        for number, name in enumerate(names):
            if name and way(name):
                rows.setdefault(way(name), []).append(number)
        found = {plot: rows[way(plot)] for plot in plots if way(plot) in rows}
        if found and len({way(plot) for plot in found}) == len(found):
            return found
    return {}


def _last(name: str) -> str:
    return re.split(r"[/\\]", name)[-1].casefold()


def _number(name: str) -> str:
    """The last number of a name of a plot, without zeros before it."""
    found = re.findall(r"\d+", _last(name))
    return str(int(found[-1])) if found and len(found[-1]) < 20 else ""


def _by_range(columns: Sequence[str], table: Sequence[Sequence[str]], plots: Sequence[str]) -> dict[str, list[int]]:
    """Numbers of rows by the plot whose name holds the numbers of its range and of its row or column."""
    places = {name: columns.index(name) for name in ("range", "row", "column", "col", "pass") if name in columns}
    across = [name for name in places if name != "range"]
    if "range" not in places or not across:
        return {}
    rows = {
        (_number(row[places["range"]]), other, _number(row[places[other]])): [number]
        for number, row in enumerate(table)
        for other in across
    }
    found = {}
    for plot in plots:
        said = {word.lower(): str(int(number)) for word, number in re.findall(r"([A-Za-z]+)[ _-]*(\d{1,9})", plot)}
        for other in across:
            key = (said.get("range", ""), other, said.get(other, said.get({"column": "col"}.get(other, other), "")))
            if key in rows and all(key):
                found[plot] = rows[key]
    return found


def _none_there(path: Path, columns: Sequence[str], names: Sequence[str], plots: Sequence[str]) -> str:
    own = ", ".join(map(readable, plots[:_SHOWN]))
    if not columns:
        return f"{path} names no plots: it needs a column plot_id (or plot, or range and row) with names as {own}"
    theirs = ", ".join(dict.fromkeys(readable(name)[:40] for name in names if name)) or "nothing"
    theirs = ", ".join(theirs.split(", ")[:_SHOWN])
    return f"{path} names no plot of these: its {columns[0]} has {theirs}, and the folders are {own}"


def missing_plots(plan: Mapping[str, object], plots: Sequence[str]) -> str | None:
    """A line that says which plots a plan does not name; None if there are none."""
    missing = [readable(plot) for plot in plots if plot not in plan]
    if not missing:
        return None
    others = f" and {len(missing) - _SHOWN} others" if len(missing) > _SHOWN else ""
    return f"the plan of the field does not name {', '.join(missing[:_SHOWN])}{others}"
