"""Storage of a training run's evaluations, as the evidence behind a learning figure of the README.

    python -m benchmarks.ledger.keep_run RUN_DIR NAME [--results FOLDER]

`LEARNING` of readme_rows has the names that the README's rows need; `make stale` lists the missing ones. Then `make tables`
writes the README.
"""

import argparse
import sys
from pathlib import Path

from benchmarks.ledger import evidence
from benchmarks.ledger.records import RESULTS
from jaxrl_vis.errors import RequestError


def main() -> int:
    """Run the command line; return the exit status: 0, or 2 for a wrong request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("name", help="name of the evidence")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of records")
    options = parser.parse_args()
    try:
        for path in evidence.keep(options.run, options.name, options.results):
            print(path)
    except RequestError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
