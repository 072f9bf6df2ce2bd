"""Hooks of mkdocs for pages that are read in the checkout as well as on the site.

Links that leave docs/ (to a notebook, a record, a test) work in the checkout. The site does not contain these files, so a link
is replaced by its path there.

Table columns with long text have a minimum width: `site.css` selects the class ``long``. Long names in code may be broken at
their dots and underscores. On a phone, rows of wide tables are shown as cards.

The libraries and the policy of the playable page are copied from the output of `browser_page.py`, if it was run before.

Search runs in a worker, which browsers refuse to start from a file: a page without a server starts one from the worker's text.
"""

import html
import json
import re
import shutil
from pathlib import Path
from typing import Any


def name_files_outside(markdown: str, depth: int = 0) -> str:
    """Replace each link out of docs/, ``[text](../path)``, by its text and path in code, or by the path if that is the text.

    Args:
        markdown: Text of a page.
        depth: Number of folders between docs/ and the page.
    """
    link_out_of_docs = re.compile(rf"(?<!!)\[([^\]]+)\]\((?:\.\./){{{depth + 1}}}([^)#]+)\)")

    def replacement(link: re.Match[str]) -> str:
        text, path = link.group(1).strip("`"), link.group(2)
        return f"`{path}`" if text == path else f"{text} (`{path}`)"

    return link_out_of_docs.sub(replacement, markdown)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Replace links out of docs/ in the Markdown of a page, unless it is generated from code (hook of mkdocs)."""
    uri = page.file.src_uri
    return markdown if uri.startswith("api/") else name_files_outside(markdown, uri.count("/"))


_CELL = re.compile(r"<(t[dh])\b([^>]*)>(.*?)</\1>", re.DOTALL)
_LONG_TEXT, _LONG_NAME = 40, 20  # letters


def fit_cells(content: str) -> str:
    """Return HTML in which table cells with long text have the class ``long`` and long names in code may be broken."""

    def breakable(code: re.Match[str]) -> str:
        parts = re.split(r"(\s+)", code[1])
        parts = [re.sub(r"(?<=[._/=(,])(?=.)", "<wbr>", part) if len(part) > _LONG_NAME else part for part in parts]
        # An option is typed as it is read: it must not end in two hyphens.
        parts = [re.sub(r"^(--[\w-]+)", r'<span class="option">\1</span>', part) for part in parts]
        return f"<code>{''.join(parts)}</code>"

    def fitted(cell: re.Match[str]) -> str:
        lines = re.split(r"<br ?/?>", cell[3])
        longest = max(len(html.unescape(re.sub(r"<[^>]*>", "", line))) for line in lines)
        kind = ' class="long"' if longest > _LONG_TEXT else ""
        inside = re.sub(r"<code>(.*?)</code>", breakable, cell[3], flags=re.DOTALL)
        return f"<{cell[1]}{cell[2]}{kind}>{inside}</{cell[1]}>"

    return _CELL.sub(fitted, content)


_TABLE = re.compile(r"<table>.*?</table>", re.DOTALL)
_HEAD = re.compile(r"<th\b[^>]*>(.*?)</th>", re.DOTALL)
_ROW = re.compile(r"<tr>(.*?)</tr>", re.DOTALL)


def label_cells(content: str) -> str:
    """Return HTML from `fit_cells` in which wide tables have the attribute ``data-cards`` and their cells ``data-label``.

    On a phone, `site.css` shows a row of such a table as a card: one line per cell, which begins with the label, the
    title of its column. Tables are wide if they have at least three columns and a long cell.
    """

    def labelled(table: re.Match[str]) -> str:
        heads = [html.escape(html.unescape(re.sub(r"<[^>]*>", "", head)), quote=True) for head in _HEAD.findall(table[0])]
        rows = [re.findall(r"<td\b[^>]*>", row) for row in _ROW.findall(table[0])]
        has_long = any('class="long"' in cell for row in rows for cell in row)
        if len(heads) < 3 or not has_long:
            return table[0]

        def row_with_labels(row: re.Match[str]) -> str:
            titles = iter(heads)
            return re.sub(r"<td\b", lambda _: f'<td data-label="{next(titles, "")}"', row[0])

        return _ROW.sub(row_with_labels, table[0].replace("<table>", "<table data-cards>", 1))

    return _TABLE.sub(labelled, content)


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Adapt the tables in the HTML of a page, unless it is generated from code (hook of mkdocs)."""
    return html if page.file.src_uri.startswith("api/") else label_cells(fit_cells(html))


_WORKER = """if (location.protocol === "file:") {
  const source = new Blob([%s], {type: "text/javascript"});
  const Started = window.Worker;
  window.Worker = class extends Started {
    constructor() { super(URL.createObjectURL(source)); }
  };
}
"""


def on_post_build(config: Any, **_: Any) -> None:
    """Write a script that embeds the search worker, for pages opened from files (hook of mkdocs).

    Also copy the data of the playable page, if they exist.
    """
    assets = Path(config.site_dir) / "assets"
    (worker,) = (assets / "javascripts" / "workers").glob("search.*.min.js")
    (assets / "local-iframe-worker.js").write_text(_WORKER % json.dumps(worker.read_text(encoding="utf-8")), encoding="utf-8")
    built = Path(config.config_file_path).parent / "build" / "play"  # by browser_page.py, if it was run
    if built.exists():
        shutil.copytree(built, Path(config.site_dir) / "play" / "data", dirs_exist_ok=True)
