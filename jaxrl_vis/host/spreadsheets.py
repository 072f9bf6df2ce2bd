"""CSV tables without formula injection.

Spreadsheets evaluate cells that begin with certain characters, so that a folder's name could read files or start programs. A
leading apostrophe marks such a cell as text. Numbers are not changed.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

_SIGNS = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")


def to_csv(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> str:
    """Format rows as CSV with a header; the columns default to those of the first row. None becomes an empty field.

    Cells are escaped by `escape_cell`. Without columns, the result is empty.

    Raises:
        ValueError: A row has a column that is not in ``columns``.
    """
    text = io.StringIO()
    columns = list(rows[0] if rows else ()) if columns is None else columns
    if not columns:
        return ""
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writerow({name: escape_cell(name) for name in columns})
    writer.writerows({name: escape_cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def escape_cell(value: Any) -> Any:
    """Return the value of a cell, with an apostrophe before text that a spreadsheet would evaluate; see `unescape_cell`."""
    # Text that already has one gets another, so that `unescape_cell` is exact.
    return f"'{value}" if isinstance(value, str) and _needs_escape(value) else value


def unescape_cell(written: str) -> str:
    """Return the text that `escape_cell` converts to ``written``."""
    return written[1:] if written.startswith("'") and _needs_escape(written[1:]) else written


def _needs_escape(text: str) -> bool:
    begin = text.lstrip("' ")
    return begin.startswith(_SIGNS) and not _is_number(text)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return not text.startswith(("\t", "\r", "\n"))
