"""Learning curves of the ablations, in one compressed table: benchmarks/results/ablations.jsonl.gz, one curve per line.

name        unique name of the curve
task        environment
preset      preset of the revision
options     options that the docs state for the curve, with remarks in parentheses; null if they state none
revision    measured revision; null if the docs state none
device      measured device; null if the docs state none
page        page of docs that quotes the curve, or null
stored      commit that stored the curve, an upper bound of the revision
metrics     columns of metrics.jsonl: name -> values, one per seed and evaluation
"""

import dataclasses
import gzip
import json
import statistics
from pathlib import Path
from typing import Any, Self

from benchmarks.ledger.records import RESULTS
from benchmarks.ledger.tables.lab_results import format_short

FILE = "ablations.jsonl.gz"
UNKNOWN = "unknown"
_PREFIX = "docs/"  # folder of pages, relative to the repository's root


@dataclasses.dataclass(frozen=True)
class Curve:
    """Learning curve and its origin; see the module's docstring for the fields."""

    name: str
    task: str
    preset: str
    options: str | None
    revision: str | None
    device: str | None
    page: str | None
    stored: str
    metrics: dict[str, list[Any]]

    @classmethod
    def parse(cls, line: str) -> Self:
        """Parse a line of the table."""
        return cls(**json.loads(line))

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Rows as in metrics.jsonl, one per seed and evaluation."""
        return [dict(zip(self.metrics, values, strict=True)) for values in zip(*self.metrics.values(), strict=True)]

    @property
    def command(self) -> str | None:
        """Training command, as far as the docs state the options; None if they state none."""
        if self.options is None:
            return None
        seeds, steps = sorted(set(self.metrics["seed"])), max(self.metrics["env_steps"])
        first = f"--seed {seeds[0]} " if seeds[0] else ""
        count = f"--seeds {len(seeds)} " if len(seeds) > 1 else ""
        command = f"jaxrl-vis train {self.task} --preset {self.preset} {first}{count}--env-steps {steps} {self.options}"
        return command.rstrip()


def read_curves(results: Path = RESULTS) -> dict[str, Curve]:
    """Read the curves of all ablations, by name, in the order of the file."""
    with gzip.open(results / FILE, "rt", encoding="utf-8") as file:
        curves = map(Curve.parse, file)
        return {curve.name: curve for curve in curves}


def index_table(results: Path = RESULTS) -> str:
    """Return the table of docs/lab/ablations.md as Markdown: every curve with its command and origin."""
    lines = ["| curve | command | revision | device | success at the end | page |", "|---|---|---|---|---|---|"]
    for curve in read_curves(results).values():
        rows = curve.rows
        end = max(row["env_steps"] for row in rows)
        success = statistics.median(row["eval/success"] for row in rows if row["env_steps"] == end)
        command = f"`{curve.command}`" if curve.command else f"{UNKNOWN}; {curve.task}, `{curve.preset}`"
        page = "" if curve.page is None else f"[{Path(curve.page).stem}](../{curve.page.removeprefix(_PREFIX)})"
        revision = curve.revision or f"{UNKNOWN}, until {curve.stored}"
        ending = f"{success:.2f} at {format_short(end)}"
        lines.append(f"| {curve.name} | {command} | {revision} | {curve.device or UNKNOWN} | {ending} | {page} |")
    return "\n".join(lines)
