"""What mkdocs needs to know about these pages, which are read in the checkout as well as on the site.

Links that leave docs/ (to a notebook, a record, a test) work in the checkout. The site does not hold these files, so there
the path takes the place of the link.

Search runs in a worker, which browsers refuse to start from a file: a page without a server starts one from the worker's text.
"""

import json
import re
from pathlib import Path
from typing import Any

_LINK_OUT_OF_DOCS = re.compile(r"(?<!!)\[([^\]]+)\]\((?:\.\./)+([^)#]+)\)")


def name_files_outside(markdown: str) -> str:
    """``[text](../path)`` becomes ``text``, and the path in code unless the text names it already."""

    def named(link: re.Match[str]) -> str:
        text, path = link.group(1).strip("`"), link.group(2)
        return f"`{path}`" if text == path else f"{text} (`{path}`)"

    return _LINK_OUT_OF_DOCS.sub(named, markdown)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Called by mkdocs for the text of every page."""
    return markdown if page.file.src_uri.startswith("api/") else name_files_outside(markdown)


_WORKER = """if (location.protocol === "file:") {
  const source = new Blob([%s], {type: "text/javascript"});
  const Started = window.Worker;
  window.Worker = class extends Started {
    constructor() { super(URL.createObjectURL(source)); }
  };
}
"""


def on_post_build(config: Any, **_: Any) -> None:
    """Called by mkdocs when all pages are written."""
    assets = Path(config.site_dir) / "assets"
    (worker,) = (assets / "javascripts" / "workers").glob("search.*.min.js")
    (assets / "local-iframe-worker.js").write_text(_WORKER % json.dumps(worker.read_text(encoding="utf-8")), encoding="utf-8")
