"""Record of a soak in a file, and the table of several records."""

import dataclasses
import json
import os
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

from benchmarks.soak.alone import SEPARATE_FAULTS
from benchmarks.soak.faults import FAULTS
from jaxrl_vis.host import provenance

GUARANTEES = {name: fault.guarantee for name, fault in (FAULTS | SEPARATE_FAULTS).items()}


def _machine() -> dict[str, Any]:
    return {
        "commit": provenance.revision(),
        "versions": {"python": platform.python_version(), "jax": version("jax"), "orbax": version("orbax-checkpoint")},
        "cores": os.cpu_count(),
        "root": os.geteuid() == 0,
    }


@dataclasses.dataclass
class Record:
    """Results of one soak, or of several.

    Attributes:
        machine: Commit, versions, number of cores, and True for ``root`` if root ran the soak.
        seed: Seed of the order and times of the faults.
        minutes: Duration, minutes.
        faults: Number of faults of each kind.
        runs: Number of completed training runs.
        exact: Number of completed runs whose metrics.jsonl equals that of an undisturbed run, bit for bit.
        done, begun: Iterations contained in their networks, and iterations begun by all their processes.
        resumes, replays_lost: Number of resumptions, and of resumptions without the replay.
        broken: Violated guarantees, as text.
    """

    machine: dict[str, Any] = dataclasses.field(default_factory=_machine)
    seed: int = 0
    minutes: float = 0.0
    faults: dict[str, int] = dataclasses.field(default_factory=lambda: dict.fromkeys(GUARANTEES, 0))
    runs: int = 0
    exact: int = 0
    done: int = 0
    begun: int = 0
    resumes: int = 0
    replays_lost: int = 0
    broken: list[str] = dataclasses.field(default_factory=list)

    @property
    def total(self) -> int:
        """Total number of faults."""
        return sum(self.faults.values())

    def write(self, path: Path) -> None:
        """Write the record atomically, so that a killed soak leaves one, too."""
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".tmp")
        temporary.write_text(json.dumps(dataclasses.asdict(self), indent=1) + "\n")
        temporary.replace(path)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a record written by `write`."""
        return cls(**json.loads(path.read_text()))

    def table(self) -> str:
        """Format the table of all faults as Markdown."""
        lines = ["| fault | injected | guarantee |", "|---|---|---|"]
        lines += [f"| {name} | {self.faults.get(name, 0)} | {guarantee} |" for name, guarantee in GUARANTEES.items()]
        goodput = self.done / self.begun if self.begun else 1.0
        held = "no violation" if not self.broken else f"**violations: {len(self.broken)}**"
        lines += [
            f"| all | {self.total} | {held}; {self.runs} training runs without missing or duplicate rows; "
            f"metrics.jsonl of {self.exact} bit-identical to an undisturbed run; goodput {goodput:.3f} over {self.resumes} "
            f"resumptions; replay lost {self.replays_lost} times |"
        ]
        return "\n".join(lines) + "\n"


def add_records(records: Sequence[Record]) -> Record:
    """Add up several soaks of one commit, in a record with the machine and seed of the first.

    Raises:
        ValueError: They are of different commits, or two have the same seed.
    """
    if len(commits := {record.machine["commit"] for record in records}) > 1:
        raise ValueError(f"records of different commits: {', '.join(sorted(map(str, commits)))}")
    if len({record.seed for record in records}) < len(records):
        raise ValueError("two records of the same seed: the same piece twice?")
    names = ("minutes", "runs", "exact", "done", "begun", "resumes", "replays_lost")
    sums = {name: sum(getattr(record, name) for record in records) for name in names}
    faults = {name: sum(record.faults.get(name, 0) for record in records) for name in GUARANTEES}
    broken = [line for record in records for line in record.broken]
    return Record(records[0].machine, records[0].seed, faults=faults, broken=broken, **sums)
