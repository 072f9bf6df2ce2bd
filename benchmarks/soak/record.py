"""Record of a soak as a file, and several of them as one table."""

import dataclasses
import json
import os
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

from benchmarks.soak.alone import ALONE
from benchmarks.soak.faults import FAULTS
from jaxrl_vis.host import provenance

PROMISES = {name: fault.promise for name, fault in (FAULTS | ALONE).items()}


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
        machine: Commit, versions, cores.
        seed: Of what happened when.
        minutes: How long it took.
        faults: How often each kind struck.
        runs: Training runs that came to their end.
        exact: Those of them whose metrics.jsonl was that of an undisturbed run, bit for bit.
        done, begun: Iterations in their networks, and those begun by all their processes.
        resumes, replays_lost: How often they were resumed, and how often without their replay.
        broken: What did not hold, in words.
    """

    machine: dict[str, Any] = dataclasses.field(default_factory=_machine)
    seed: int = 0
    minutes: float = 0.0
    faults: dict[str, int] = dataclasses.field(default_factory=lambda: dict.fromkeys(PROMISES, 0))
    runs: int = 0
    exact: int = 0
    done: int = 0
    begun: int = 0
    resumes: int = 0
    replays_lost: int = 0
    broken: list[str] = dataclasses.field(default_factory=list)

    @property
    def total(self) -> int:
        """All faults."""
        return sum(self.faults.values())

    def write(self, path: Path) -> None:
        """Write it, so that whoever is killed leaves a record, too."""
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".tmp")
        temporary.write_text(json.dumps(dataclasses.asdict(self), indent=1) + "\n")
        temporary.replace(path)

    @classmethod
    def read(cls, path: Path) -> Self:
        """The inverse of `write`."""
        return cls(**json.loads(path.read_text()))

    def table(self) -> str:
        """Table of all faults, as Markdown."""
        lines = ["| fault | times | what must hold |", "|---|---|---|"]
        lines += [f"| {name} | {self.faults.get(name, 0)} | {promise} |" for name, promise in PROMISES.items()]
        share = self.done / self.begun if self.begun else 1.0
        held = "all of it held" if not self.broken else f"**{len(self.broken)} times it did not**"
        lines += [
            f"| all | {self.total} | {held}; {self.runs} training runs, none with a row missing or twice, {self.exact} of them "
            f"with the metrics.jsonl of an undisturbed run, bit for bit; goodput {share:.3f} at {self.resumes} resumptions, "
            f"replay lost {self.replays_lost} times |"
        ]
        return "\n".join(lines) + "\n"


def added(records: Sequence[Record]) -> Record:
    """Several soaks of one commit as one.

    Raises:
        ValueError: They are of different commits.
    """
    if len(commits := {record.machine["commit"] for record in records}) > 1:
        raise ValueError(f"records of different commits: {', '.join(sorted(map(str, commits)))}")
    if len({record.seed for record in records}) < len(records):
        raise ValueError("two records of the same seed: the same piece twice?")
    names = ("minutes", "runs", "exact", "done", "begun", "resumes", "replays_lost")
    sums = {name: sum(getattr(record, name) for record in records) for name in names}
    faults = {name: sum(record.faults.get(name, 0) for record in records) for name in PROMISES}
    broken = [line for record in records for line in record.broken]
    return Record(records[0].machine, records[0].seed, faults=faults, broken=broken, **sums)
