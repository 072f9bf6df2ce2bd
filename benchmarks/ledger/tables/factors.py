"""Table of docs/lab/real_stalks.md: training without a group of factors, from the records of benchmarks/stalks/factors.py."""

from pathlib import Path

from benchmarks.claims.markdown import origin_sentence
from benchmarks.claims.records import Record
from benchmarks.stalks.factors import RESULTS, WITHOUT
from jaxrl_vis.bench.record import read_json


def factors_table(results: Path) -> str | None:
    """Return a table with a row for each group of factors as Markdown; None without records."""
    records = {record["group"]: record for record in map(read_json, (results / RESULTS.name).glob("*.json"))}
    if not records:
        return None
    columns = list(next(iter(records.values()))["cells"])
    lines = [f"| trained without | updates | {' | '.join(columns)} |", "|" + "---|" * (len(columns) + 2)]
    lines += [
        f"| {group} | {records[group]['updates']:,} | {' | '.join(records[group]['cells'][column] for column in columns)} |"
        for group in WITHOUT
        if group in records
    ]
    origins = frozenset(f"{(record['revision'] or 'unknown')[:7]} on {record['device']}" for record in records.values())
    made = origin_sentence([Record("factors", (), origins)])
    return "\n".join([*lines, "", made])
