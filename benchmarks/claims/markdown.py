"""Rows of records as a table in Markdown."""

import collections
import dataclasses
import textwrap
from collections.abc import Sequence

from benchmarks.claims.columns import Column
from benchmarks.claims.records import Record
from benchmarks.ledger.markers import WIDTH

NO_RECORD = "no record kept"


@dataclasses.dataclass(frozen=True)
class Row:
    """Row of a table.

    Attributes:
        label: First cell.
        record: Run from which the other cells are computed; None if no record is stored.
        cells: Cells between the label and the computed ones.
    """

    label: str
    record: Record | None
    cells: Sequence[str] = ()


def table(headers: Sequence[str], rows: Sequence[Row], columns: Sequence[Column]) -> str:
    """Format a table as Markdown, followed by revision and device of the records, if known.

    Args:
        headers: Titles of the label and of `Row.cells`.
        rows: Rows.
        columns: Computed columns.
    """
    lines = [_line([*headers, *(column.title for column in columns)]), "|" + "---|" * (len(headers) + len(columns))]
    for row in rows:
        cells = [NO_RECORD, *[""] * (len(columns) - 1)] if row.record is None else [c.cell(row.record) for c in columns]
        lines.append(_line([row.label, *row.cells, *cells]))
    made = origin_sentence([row.record for row in rows if row.record is not None])
    return "\n".join([*lines, *(["", made] if made else [])])


def origin_sentence(records: Sequence[Record]) -> str:
    """Return a sentence on the revisions and devices of records; empty if none is known."""
    devices = collections.defaultdict(set)
    for text in {text for record in records for text in record.origins}:
        revision, _, device = text.partition(" on ")
        devices[device].add(revision)
    parts = [f"{', '.join(sorted(revisions))} on {device}" for device, revisions in sorted(devices.items())]
    some = "" if all(record.origins for record in records) else " (records that say so)"
    return textwrap.fill(f"Made by {'; '.join(parts)}{some}.", WIDTH) if parts else ""


def _line(cells: Sequence[str]) -> str:
    return "|" + "".join(f" {cell} |" if cell else " |" for cell in cells)
