"""Computes every published figure that comes from records of learning again, and lists those that differ.

python benchmarks/check_claims.py    # exit 1 if anything differs

Covered are the README's table of results, docs/lab/target_decay.md, all tables between `<!-- tables: begin NAME -->` and
`<!-- tables: end -->`, and the numbers in sentences of README.md, docs/index.md and the pages of the studies
(`benchmarks.claims.sentences`).
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import target_decay
from claims import pages, prose, sentences, writer

import jaxrl_vis.bench.tables as readme_tables

RESULTS = Path(__file__).parent / "results"


def other_differences() -> Iterator[str]:
    """List tables with a command of their own that are not those of the records."""
    text = (writer.ROOT / "README.md").read_text(encoding="utf-8")
    if readme_tables.results_table(RESULTS) not in text:
        yield "README.md: the table of results is not that of the records: jaxrl-vis bench --tables"
    if target_decay.tables() not in target_decay.PAGE.read_text(encoding="utf-8"):
        yield "docs/lab/target_decay.md: tables are not those of the records: python benchmarks/target_decay.py"


def main() -> int:
    """Print all differences."""
    found = [*other_differences(), *writer.differences(pages.tables()), *prose.differences(sentences.sentences())]
    print("\n".join(found) if found else "all figures are those of the records")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
