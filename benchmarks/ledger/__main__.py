"""Tables from records, and the age of records.

python -m benchmarks.ledger tables     write the tables of README and docs
python -m benchmarks.ledger stale      list stale records, rows without a record, and outdated tables; exit 1 if there are any
"""

import argparse
import sys
from pathlib import Path

from benchmarks.ledger import pages
from benchmarks.ledger.check import check
from benchmarks.ledger.records import CHECKOUT, RESULTS
from jaxrl_vis import provenance
from jaxrl_vis.errors import RequestError


def main(arguments: list[str] | None = None, checkout: Path = CHECKOUT) -> int:
    """Run the command line; return the exit status: 0, 1 with complaints, 2 for a wrong request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("tables", "stale"))
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of records")
    options = parser.parse_args(arguments)
    try:
        if options.action == "tables":
            for page, changed in pages.write_pages(options.results, checkout):
                print(f"{page.relative_to(checkout)}: {'written' if changed else 'unchanged'}")
            return 0
        complaints = check(options.results, checkout)
    except RequestError as error:
        print(error, file=sys.stderr)
        return 2
    everything = "every record is up to date with the code, and every row has one"
    good = everything if provenance.is_checkout(checkout) else "no complaints about what could be checked"
    print("\n".join(complaints) or good)
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
