"""Recompute every published number derived from learning records or audits, and list those that differ.

python benchmarks/check_claims.py    # exit 1 if anything differs

Covers the tables of docs/lab/results.md, docs/lab/target_decay.md and docs/lab/ablations.md, the audit of rewards in
docs/indicator_rewards.md, all tables of `benchmarks.claims.pages`, and the numbers in sentences of README.md, docs/index.md and
the pages of the studies (`benchmarks.claims.sentences`).
"""

import sys
from collections.abc import Iterator

from benchmarks.claims import pages, prose, sentences
from benchmarks.ledger import pages as ledger
from benchmarks.ledger.records import CHECKOUT

LEARNING_TABLES = {
    "docs/lab/results.md": "results table",
    "docs/lab/target_decay.md": "tables",
    "docs/lab/ablations.md": "curves",
    "docs/indicator_rewards.md": "audit",
}
"""Tables of the ledger derived from learning records or audits: page -> name in its markers."""


def ledger_differences() -> Iterator[str]:
    """Yield a line for each table of `LEARNING_TABLES` that differs from the records."""
    for page, name in LEARNING_TABLES.items():
        text = (CHECKOUT / page).read_text(encoding="utf-8")
        if ledger.fill_page(text, {name: ledger.PAGES[page][name]}) != text:
            yield f"{page}: the table {name!r} differs from the records: make tables"


def main() -> int:
    """Print all differences, and return the exit status: 1 if there are any, else 0."""
    differences = [*ledger_differences(), *pages.differences(), *prose.differences(sentences.sentences())]
    print("\n".join(differences) if differences else "all figures are those of the records")
    return int(bool(differences))


if __name__ == "__main__":
    sys.exit(main())
