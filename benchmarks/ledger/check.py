"""Complaints about the records: stale ones, rows of the README without one, and tables that differ from them."""

from pathlib import Path

from benchmarks.ledger import pages, readme_tables, staleness
from benchmarks.ledger.records import CHECKOUT, RESULTS
from jaxrl_vis import provenance


def check(results: Path = RESULTS, checkout: Path = CHECKOUT) -> list[str]:
    """List the complaints, one line each. Outside a git checkout, print that the age of records is unknown.

    Args:
        results: Folder of records.
        checkout: Git checkout of the records' revisions, with the pages.

    Raises:
        RequestError: The folder of records is missing, or a file in it cannot be read.
    """
    complaints = []
    if provenance.is_checkout(checkout):
        complaints += [str(stale) for stale in staleness.stale_records(results, checkout)]
    else:
        print(f"{checkout} is not a git checkout: the age of the measured code is unknown")
    if (checkout / "README.md").exists():
        complaints += [f"README.md: {complaint}" for complaint in readme_tables.missing_rows(results)]
    return complaints + list(pages.outdated(results, checkout))
