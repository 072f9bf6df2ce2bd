"""Writes the tables of the documentation from the records.

python -m benchmarks.claims            # write
python -m benchmarks.claims --check    # list what differs, exit 1 if anything does
"""

import argparse
import sys

from .pages import tables
from .writer import differences, write


def main() -> int:
    """Read the command line, and write or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare, and write nothing")
    if parser.parse_args().check:
        found = list(differences(tables()))
        print("\n".join(found) if found else "all tables are those of the records")
        return int(bool(found))
    for page in write(tables()):
        print(f"written: {page}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
