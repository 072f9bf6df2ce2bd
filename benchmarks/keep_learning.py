"""Keeps what a training run evaluated, small, as the evidence behind a learning figure of the README.

    python benchmarks/keep_learning.py RUN_DIR NAME [--results FOLDER]

The names that the README's rows ask for are in `LEARNING` of jaxrl_vis/bench/table_rows.py; `jaxrl-vis bench --check` lists
those that are missing. Afterwards `jaxrl-vis bench --tables` writes the README.
"""

import argparse
import sys
from pathlib import Path

from jaxrl_vis.bench import learning, record
from jaxrl_vis.errors import RequestError


def main() -> int:
    """Reads the command line and does what it asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="the run folder")
    parser.add_argument("name", help="what the evidence is called")
    parser.add_argument("--results", type=Path, default=record.results_folder(), help="the folder of records")
    options = parser.parse_args()
    try:
        for path in learning.keep(options.run, options.name, options.results):
            print(path)
    except RequestError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
