"""Tables as CSV that no spreadsheet takes for a program.

What begins with one of a few signs, a spreadsheet computes: a folder's name may then read files or start programs. An
apostrophe before it says that it is text. Numbers stay as they are.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

_SIGNS = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")


def to_csv(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> str:
    """Rows under the columns' names, those of the first row if none are given; None is an empty field.

    Raises:
        ValueError: A row has a column that is not named.
    """
    text = io.StringIO()
    columns = list(rows[0] if rows else ()) if columns is None else columns
    if not columns:
        return ""
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writerow({name: cell(name) for name in columns})
    writer.writerows({name: cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def cell(value: Any) -> Any:
    """Text of a cell: one that a spreadsheet would compute gets an apostrophe; see `text_of`."""
    # One that is there already must not be taken for ours.
    return f"'{value}" if isinstance(value, str) and _needs_mark(value) else value


def text_of(written: str) -> str:
    """The text for which `cell` wrote this."""
    return written[1:] if written.startswith("'") and _needs_mark(written[1:]) else written


def _needs_mark(text: str) -> bool:
    begin = text.lstrip("' ")
    return begin.startswith(_SIGNS) and not _is_number(text)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return not text.startswith(("\t", "\r", "\n"))
