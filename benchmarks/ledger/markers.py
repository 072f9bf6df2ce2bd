"""Tables of a page between markers ``<!-- NAME: begin -->`` and ``<!-- NAME: end -->``; text may follow ``begin``."""

import re

from jaxrl_vis.errors import RequestError

WIDTH = 127
"""Columns of the prose of a page."""


def fill(text: str, name: str, table: str) -> str:
    """Return ``text`` with ``table`` between the markers of ``name``.

    Raises:
        RequestError: A marker is missing.
    """
    pattern = re.compile(rf"(<!-- {name}: begin[^>]*-->\n).*?(<!-- {name}: end -->)", re.DOTALL)
    if not pattern.search(text):
        raise RequestError(f"there are no markers <!-- {name}: begin --> and <!-- {name}: end -->")
    return pattern.sub(lambda match: match[1] + table.rstrip("\n") + "\n" + match[2], text)
