"""All tables of all pages."""

import collections

from . import ablations, indicator, ol_aux, thesis


def tables() -> dict[str, dict[str, str]]:
    """Page, as a path below the root -> name of the marker -> text."""
    pages: dict[str, dict[str, str]] = collections.defaultdict(dict)
    for module in (ol_aux, indicator, ablations, thesis):
        for page, texts in module.tables().items():
            pages[page] |= texts
    return dict(pages)
