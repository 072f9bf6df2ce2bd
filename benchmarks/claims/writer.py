"""Tables as Markdown, and the pages that hold them between markers.

A page holds `<!-- tables: begin NAME -->` and `<!-- tables: end -->` around what `tables()` gives for NAME.
"""

import collections
import dataclasses
import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from .columns import Column
from .records import Record

ROOT = Path(__file__).resolve().parents[2]
NO_RECORD = "no record kept"
Pages = Mapping[str, Mapping[str, str]]
"""Page, as a path below the root -> name of the marker -> text."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of a table.

    Attributes:
        label: First cell.
        record: Run that the other cells are computed from; None where no record is kept.
        more: Cells between the label and the computed ones.
    """

    label: str
    record: Record | None
    more: Sequence[str] = ()


def table(heads: Sequence[str], rows: Sequence[Row], columns: Sequence[Column]) -> str:
    """A table in Markdown, and below it the revision and device of the records where these are kept.

    Args:
        heads: Titles of the label and of the cells in ``more``.
        rows: Rows.
        columns: Computed columns.
    """
    lines = [_line([*heads, *(column.title for column in columns)]), "|" + "---|" * (len(heads) + len(columns))]
    for row in rows:
        cells = [NO_RECORD, *[""] * (len(columns) - 1)] if row.record is None else [c.cell(row.record) for c in columns]
        lines.append(_line([row.label, *row.more, *cells]))
    made = made_by([row.record for row in rows if row.record is not None])
    return "\n".join([*lines, *(["", made] if made else [])])


def made_by(records: Sequence[Record]) -> str:
    """Sentence on the revisions and devices of some records; empty where none is kept."""
    devices = collections.defaultdict(set)
    for text in {text for record in records for text in record.made}:
        revision, _, device = text.partition(" on ")
        devices[device].add(revision)
    parts = [f"{', '.join(sorted(revisions))} on {device}" for device, revisions in sorted(devices.items())]
    some = "" if all(record.made for record in records) else " (records that say so)"
    return f"Made by {'; '.join(parts)}{some}." if parts else ""


def _line(cells: Sequence[str]) -> str:
    return re.sub(r"\|  (?=\|)", "| ", "| " + " | ".join(cells) + " |")


def filled(page: str, texts: Mapping[str, str]) -> str:
    """Text of a page with all of its tables written anew.

    Raises:
        LookupError: A marker is missing, or there is one for which there is no table.
    """
    text = (ROOT / page).read_text(encoding="utf-8")
    markers = re.findall(r"<!-- tables: begin (\S+) -->", text)
    if sorted(markers) != sorted(texts):
        raise LookupError(f"{page} has the markers {sorted(markers)}, and there are tables for {sorted(texts)}")
    for name, content in texts.items():
        pattern = rf"(<!-- tables: begin {re.escape(name)} -->\n).*?(<!-- tables: end -->)"
        text = re.sub(pattern, lambda match, content=content: f"{match[1]}{content}\n{match[2]}", text, flags=re.DOTALL)
    return text


def differences(pages: Pages) -> Iterator[str]:
    """Lines of pages that differ from the records, as a unified diff."""
    for page, texts in pages.items():
        now = (ROOT / page).read_text(encoding="utf-8")
        new = filled(page, texts)
        yield from difflib.unified_diff(now.splitlines(), new.splitlines(), page, "records", n=0, lineterm="")


def write(pages: Pages) -> list[str]:
    """Write all tables, and return the pages that changed."""
    changed = []
    for page, texts in pages.items():
        now, new = (ROOT / page).read_text(encoding="utf-8"), filled(page, texts)
        if now != new:
            (ROOT / page).write_text(new, encoding="utf-8")
            changed.append(page)
    return changed
