"""`doctor --report`: a dated record of the machine, the libraries, and what ran there.

Records of `benchmarks/results/platforms` are the rows of docs/where_it_ran.md.
"""

import contextlib
import datetime
import io
import json
import os
import platform
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from jaxrl_vis.errors import StorageError
from jaxrl_vis.host import doctor, provenance
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.run.storage.folder import RunFolder

SCHEMA = 1
_TASK = "VisualReacher"


def driver_version() -> str | None:
    """Return the version of the NVIDIA driver; None if there is none."""
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return None
    lines = done.stdout.split()
    return lines[0] if done.returncode == 0 and lines else None


def processor() -> str:
    """Return the name of the processor."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


class Training:
    """Smoke test: a complete training run of the smallest preset with images.

    Attributes:
        results: Results of the last run: ``task``, ``env_steps``, ``env_steps_per_s`` (without compilation) and ``wall_s``;
            None before it.
    """

    results: dict[str, Any] | None = None

    def __call__(self) -> str:
        """Train, and return a line for the report; the trainer raises an error if a number is not finite."""
        import jaxrl_vis

        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
            run = RunFolder(Path(folder) / "run")
            for _ in jaxrl_vis.make_trainer(jaxrl_vis.preset("debug", env=_TASK), run.path).run():
                pass
            row = run.rows()[-1]
        speed, done, wall = float(row["time/env_steps_per_s"]), int(row["env_steps"]), time.perf_counter() - start
        self.results = {
            "task": _TASK,
            "env_steps": done,
            "env_steps_per_s": round(speed, 1),
            "wall_s": round(wall, 1),
        }
        return f"{done} steps of {_TASK} at {speed:,.0f} steps/s, in {wall:.0f} s with compilation"


def report(path: Path) -> int:
    """Run all checks of `doctor` and a smoke training, and write the record.

    Args:
        path: The file, or an existing folder, in which the file is named after machine and versions.

    Returns:
        The exit status of `doctor.main`; without a device there is no record.

    Raises:
        StorageError: The file cannot be written.
    """
    training, findings = Training(), {}
    status = doctor.main([("training", training)], findings)
    if status == 2:
        return status
    record = to_record(findings, training.results)
    file = path / f"{file_name(record)}.json" if path.is_dir() else path
    try:
        write_atomically(file, json.dumps(record, indent=1) + "\n")
    except OSError as error:
        raise StorageError(f"cannot write {file}: {error.strerror or error}") from error
    print(f"record: {file}")
    return status


def to_record(findings: dict[str, Any], training: dict[str, Any] | None) -> dict[str, Any]:
    """Return the record of what ran on this machine.

    Args:
        findings: From `doctor.main`.
        training: `Training.results`; None if it failed.
    """
    device = provenance.device_record()
    return {
        "platform_schema": SCHEMA,
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "system": " ".join([platform.system(), *platform.libc_ver()]).strip(),
        "machine": platform.machine(),
        "processor": processor(),
        "cores": os.cpu_count(),
        "accelerator": None if device["platform"] == "cpu" else f"{device['kind']} x{device['count']}",
        "backend": device["platform"],
        "driver": driver_version(),
        "versions": provenance.versions(),
        "revision": provenance.revision(12),
        "checks": {name: finding["passed"] for name, finding in findings.items()},
        "training": training,
    }


def file_name(record: dict[str, Any]) -> str:
    """Return a name for a record: device, Python and JAX, such as ``amd-epyc-python3.11-jax0.10``."""
    device = str(record["accelerator"] or record["processor"]).lower()
    words = "".join(letter if letter.isalnum() else " " for letter in device).split()
    minor = {name: ".".join(record["versions"][name].split(".")[:2]) for name in ("python", "jax")}
    return "-".join([*words, f"python{minor['python']}", f"jax{minor['jax']}"])
