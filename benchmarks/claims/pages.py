"""Tables of the learning studies by page and marker, and differences between pages and tables."""

import collections
import difflib
import functools
from collections.abc import Iterator

from benchmarks.claims import ablations, contrastive_view, goals, indicator, ol_aux, thesis, weightings
from benchmarks.ledger.markers import fill
from benchmarks.ledger.records import CHECKOUT


@functools.cache
def tables() -> dict[str, dict[str, str]]:
    """Compute all tables: page (path below the root) -> name in its markers -> text."""
    pages: dict[str, dict[str, str]] = collections.defaultdict(dict)
    for module in (ol_aux, indicator, ablations, thesis, weightings, goals, contrastive_view):
        for page, texts in module.tables().items():
            pages[page] |= texts
    return dict(pages)


def differences() -> Iterator[str]:
    """Yield the lines of pages that differ from the records, as a unified diff.

    Raises:
        RequestError: A marker is missing.
    """
    for page, texts in tables().items():
        text = (CHECKOUT / page).read_text(encoding="utf-8")
        new = functools.reduce(lambda text, item: fill(text, *item), texts.items(), text)
        yield from difflib.unified_diff(text.splitlines(), new.splitlines(), page, "records", n=0, lineterm="")
