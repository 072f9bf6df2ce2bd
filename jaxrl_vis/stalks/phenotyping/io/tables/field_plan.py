"""Field plans: metadata of each plot (range, row, genotype, replicate, ...) from a CSV or an export of Field Book."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.spreadsheets import unescape_cell
from jaxrl_vis.stalks.phenotyping.io.names import readable
from jaxrl_vis.stalks.phenotyping.io.tables.cells import read_table_text, split_cells

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
"""Lower-case names of columns that may identify plots; the one that matches the most plots is used, the first of equals."""
_MAX_LISTED = 3
_OBSERVED = {"trait", "uservalue", "value", "timetaken", "time_taken", "person", "location", "number", "rep_number", "photo"}
"""Columns of Field Book's export (one observation per row) that do not describe the plot."""


def read_field_plan(path: Path, plots: Sequence[str]) -> tuple[list[str], dict[str, dict[str, str]]]:
    """Read a field plan: the values of a table's columns, by plot.

    Args:
        path: A CSV with one row per plot, or several consistent ones, as in Field Book's export of observations.
        plots: Names of the plots (relative paths of folders). They are matched with identifiers in the table by whole name, by
            last component, or by the last number in that, whichever works first; or else by the numbers of range and row or
            column in them.

    Returns:
        Names of the columns in order, without the identifier and those of single observations in Field Book; and the values in
        them, by plot, "" where a plot has none. Plots that are not in the table are missing.

    Raises:
        RequestError: The table cannot be read, names none of the plots, or has contradictory rows for one.
    """
    columns, rows, _ = split_cells(path, read_table_text(path, _MAX_BYTES))
    small = [name.lower().replace(" ", "_") for name in columns]
    ids = [small.index(name) for name in _IDS if name in small]
    if not columns or len(set(small)) < len(small):
        raise RequestError(f"{path} is not a field plan: its first line must name columns, each once")
    table = [
        [unescape_cell(row[place].strip()) if place < len(row) else "" for place in range(len(columns))] for _, row in rows
    ]
    by_column = [(place, _match_names([row[place] for row in table], plots)) for place in ids]
    place, matched = max(by_column, key=lambda match: len(match[1]), default=(None, {}))
    if not matched:
        matched, place = _match_by_range(small, table, plots), None
    if not matched:
        raise RequestError(
            _no_plot_message(path, [columns[one] for one in ids], [row[ids[0]] for row in table] if ids else [], plots)
        )
    others = [one for one in range(len(columns)) if one != place and small[one] not in _OBSERVED]
    plan: dict[str, dict[str, str]] = {}
    for plot, numbers in matched.items():
        values: dict[str, str] = {}
        for one in others:
            distinct_values = {table[number][one] for number in numbers if table[number][one]}
            if len(distinct_values) > 1 and len(numbers) < len(table):
                both = " and ".join(sorted(distinct_values)[:2])
                raise RequestError(f"{path} states two values of {columns[one]} for plot {readable(plot)}: {both}")
            values[columns[one]] = distinct_values.pop() if len(distinct_values) == 1 else ""
        plan[plot] = values
    return [columns[one] for one in others], plan


def _match_names(names: Sequence[str], plots: Sequence[str]) -> dict[str, list[int]]:
    """Return the row indices of each plot, by the first method of comparing names that matches and tells the plots apart.

    Args:
        names: Identifier in each row.
        plots: Names of the plots.
    """
    for normalize in (str, _last_component, _digits):
        rows: dict[str, list[int]] = {}
        for number, name in enumerate(names):
            if name and normalize(name):
                rows.setdefault(normalize(name), []).append(number)
        matched = {plot: rows[normalize(plot)] for plot in plots if normalize(plot) in rows}
        if matched and len({normalize(plot) for plot in matched}) == len(matched):
            return matched
    return {}


def _last_component(name: str) -> str:
    return re.split(r"[/\\]", name)[-1].casefold()


def _digits(name: str) -> str:
    """Return the last number in a plot's name, without leading zeros; empty if there is none."""
    numbers = re.findall(r"\d+", _last_component(name))
    return str(int(numbers[-1])) if numbers and len(numbers[-1]) < 20 else ""


def _match_by_range(columns: Sequence[str], table: Sequence[Sequence[str]], plots: Sequence[str]) -> dict[str, list[int]]:
    """Return the row indices of the plots whose names hold the numbers of their range and of their row or column."""
    places = {name: columns.index(name) for name in ("range", "row", "column", "col", "pass") if name in columns}
    across = [name for name in places if name != "range"]
    if "range" not in places or not across:
        return {}
    rows = {
        (_digits(row[places["range"]]), other, _digits(row[places[other]])): [number]
        for number, row in enumerate(table)
        for other in across
    }
    matched = {}
    for plot in plots:
        numbers = {word.lower(): str(int(number)) for word, number in re.findall(r"([A-Za-z]+)[ _-]*(\d{1,9})", plot)}
        for other in across:
            key = (numbers.get("range", ""), other, numbers.get(other, numbers.get({"column": "col"}.get(other, other), "")))
            if key in rows and all(key):
                matched[plot] = rows[key]
    return matched


def _no_plot_message(path: Path, columns: Sequence[str], names: Sequence[str], plots: Sequence[str]) -> str:
    own = ", ".join(map(readable, plots[:_MAX_LISTED]))
    if not columns:
        return f"{path} names no plots: it needs a column plot_id (or plot, or range and row) with names as {own}"
    theirs = ", ".join(dict.fromkeys(readable(name)[:40] for name in names if name)) or "nothing"
    theirs = ", ".join(theirs.split(", ")[:_MAX_LISTED])
    return f"{path} names no plot of these: its {columns[0]} has {theirs}, and the folders are {own}"


def missing_plots_message(plan: Mapping[str, object], plots: Sequence[str]) -> str | None:
    """Return a line that lists the plots missing from a plan; None if there are none."""
    missing = [readable(plot) for plot in plots if plot not in plan]
    if not missing:
        return None
    others = f" and {len(missing) - _MAX_LISTED} others" if len(missing) > _MAX_LISTED else ""
    return f"the plan of the field does not name {', '.join(missing[:_MAX_LISTED])}{others}"
