"""Command ``jaxrl-vis sweep``: train several tasks with several methods and seeds."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from jaxrl_vis.cli.checks import check_counts, check_env
from jaxrl_vis.cli.figure import UNFINISHED
from jaxrl_vis.cli.parsing import DefaultText, FieldsOf
from jaxrl_vis.cli.train import describe_default, describe_default_preset
from jaxrl_vis.config import PRESETS, Config
from jaxrl_vis.config.methods import MethodName
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.host.devices import guess_accelerator
from jaxrl_vis.report.outputs import check_writable


@dataclasses.dataclass(frozen=True)
class Sweep:
    """Train several tasks with several methods and seeds, one run per device or per cluster job, and print a table.

    The sweep may be interrupted and started again at any time: finished runs are kept, and unfinished ones resumed. The exit
    status is 3 if something is still missing.
    """

    env: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Environments; VisualFetchReach if not given."""
    method: tuple[MethodName, ...] = ()
    """Methods; oracle if not given."""
    preset: Annotated[str, DefaultText(describe_default_preset)] = "auto"
    """paper, fast, cpu or debug; auto is fast on an accelerator, else cpu."""
    changes: Annotated[Mapping[str, Any], FieldsOf(Config, describe_default)] = dataclasses.field(default_factory=dict)
    seeds_per_run: int | None = None
    """Maximum number of seeds per program, to spread them over more devices; all of them if not given."""
    runs: Path | None = None
    """Folder of all run folders and logs; runs/sweep if not given."""
    minutes: float | None = None
    """Time limit in minutes: runs are saved, and the next start resumes."""
    executor: Literal["local", "slurm"] | None = None
    """Start each run as a submitit job, on Slurm or on this machine; as processes, one per device, if not given."""
    jobs: int = 64
    """Maximum number of simultaneous jobs (--executor slurm)."""
    job_options: tuple[str, ...] = ()
    """Parameters of submitit's executor as name=value, such as timeout_min=600 slurm_partition=gpu cpus_per_task=8."""


def run(options: Sweep) -> int:
    """Run a sweep; return `UNFINISHED` if one of its runs is not finished."""
    name = options.preset
    if name not in ("auto", *PRESETS):
        raise RequestError(f"unknown preset {name!r}{nearest(name, ['auto', *PRESETS])}")
    if name == "auto":
        name = "fast" if guess_accelerator() else "cpu"
    check_counts(seeds_per_run=options.seeds_per_run, jobs=options.jobs)
    if options.minutes is not None and options.minutes <= 0:
        raise RequestError(f"--minutes must be positive, not {options.minutes:g}")
    if options.job_options and options.executor is None:
        raise RequestError("--job-options go with --executor")
    tasks = options.env or ("VisualFetchReach",)
    for task in tasks:
        check_env(task, options.changes.get("env_folder"))
    runs = options.runs or Path("runs") / "sweep"
    check_writable(runs, "--runs", folder=True)
    # Nothing below initialises JAX in this process: the accelerator's memory is for the runs.
    from jaxrl_vis.studies.engine.sweep import Request, run_sweep

    request = Request(
        tasks=tuple(dict.fromkeys(tasks)),
        methods=tuple(dict.fromkeys(options.method or ("oracle",))),
        preset=name,
        changes=options.changes,
        runs=runs,
        seeds_per_run=options.seeds_per_run,
        seconds=None if options.minutes is None else 60.0 * options.minutes,
        executor=options.executor,
        jobs=options.jobs,
        job_options=options.job_options,
    )
    return 0 if run_sweep(request) else UNFINISHED
