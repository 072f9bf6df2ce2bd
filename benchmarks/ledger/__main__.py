"""Tables from records, staleness of records, and evidence for learning figures.

python -m benchmarks.ledger tables         write the tables of README and docs
python -m benchmarks.ledger stale          list stale records, rows without a record, and outdated tables; exit 1 if any
python -m benchmarks.ledger keep RUN NAME  store the evaluations of a run under a name of `tables.lab_rows.LEARNING`
"""

import argparse
import sys
from pathlib import Path

from benchmarks.ledger import evidence, pages, staleness
from benchmarks.ledger.records import CHECKOUT, RESULTS
from benchmarks.ledger.tables import lab_results as tables
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import provenance


def complaints(results: Path, checkout: Path) -> list[str]:
    """List stale records, rows of docs/lab/results.md without one, and pages with outdated tables, one line each.

    Args:
        results: Folder of records.
        checkout: Checkout of the records' revisions, with the pages; without git, staleness is not checked.

    Raises:
        RequestError: The folder of records is missing, or a file in it cannot be read.
    """
    lines = []
    if provenance.is_checkout(checkout):
        lines += [str(stale) for stale in staleness.stale_records(results, checkout)]
    if (checkout / tables.PAGE).exists():
        lines += [f"{tables.PAGE}: {complaint}" for complaint in tables.missing_rows(results)]
    return lines + list(pages.outdated_page_messages(results, checkout))


def main(arguments: list[str] | None = None, checkout: Path = CHECKOUT) -> int:
    """Run the command line; return the exit status: 0, 1 with complaints, 2 for an invalid request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    actions = parser.add_subparsers(dest="action", required=True)
    commands = {name: actions.add_parser(name) for name in ("tables", "stale", "keep")}
    commands["keep"].add_argument("run", type=Path, help="run folder")
    commands["keep"].add_argument("name", help="name of the evidence")
    for command in commands.values():
        command.add_argument("--results", type=Path, default=RESULTS, help="folder of records")
    options = parser.parse_args(arguments)
    try:
        if options.action == "tables":
            for page, changed in pages.write_pages(options.results, checkout):
                print(f"{page.relative_to(checkout)}: {'written' if changed else 'unchanged'}")
            return 0
        if options.action == "keep":
            print(*evidence.keep_run(options.run, options.name, options.results), sep="\n")
            return 0
        lines = complaints(options.results, checkout)
    except RequestError as error:
        print(error, file=sys.stderr)
        return 2
    if provenance.is_checkout(checkout):
        print("\n".join(lines) or "every record is up to date with the code, and every row has one")
    else:
        print("\n".join([*lines, f"{checkout} is not a git checkout: the age of records is unknown"]))
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
