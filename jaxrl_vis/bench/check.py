"""`jaxrl-vis bench --check`: records that are older than the code they measured, and rows of the README without a record."""

from pathlib import Path

from jaxrl_vis import provenance
from jaxrl_vis.bench import record, staleness, tables
from jaxrl_vis.errors import RequestError

README = provenance.CHECKOUT / "README.md"


def check(results: Path | None = None, readme: Path = README, checkout: Path = provenance.CHECKOUT) -> list[str]:
    """What is wrong, one line each; empty where all is well. Where there is no git, prints that it could not look.

    Args:
        results: The folder of records; None for the checkout's own.
        readme: The file with the tables.
        checkout: The git checkout that the records' revisions belong to.

    Raises:
        RequestError: The folder of records is missing, or a file in it cannot be read.
    """
    results = results or record.results_folder()
    complaints = []
    if provenance.is_checkout(checkout):
        complaints += [str(stale) for stale in staleness.stale_records(results, checkout)]
    else:
        print(f"{checkout} is not a git checkout: whether records are older than the code they measured is unknown")
    if not readme.exists():
        return complaints
    complaints += [f"{readme.name}: {what}" for what in tables.missing_rows(results)]
    text = readme.read_text(encoding="utf-8")
    try:
        if tables.filled(text, results) != text:
            complaints.append(f"{readme.name}: its tables are not those of the records: jaxrl-vis bench --tables writes them")
    except RequestError as error:
        complaints.append(f"{readme.name}: {error}")
    return complaints
