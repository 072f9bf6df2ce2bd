"""Command ``jaxrl-vis search``: search for hyper-parameters with Optuna."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from jaxrl_vis.cli.checks import check_counts, check_env
from jaxrl_vis.cli.figure import UNFINISHED
from jaxrl_vis.cli.parsing import AlsoPositional, DefaultText, FieldsOf
from jaxrl_vis.cli.train import describe_default, describe_default_preset
from jaxrl_vis.config import PRESETS, Config, preset, validate
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.host.devices import guess_accelerator
from jaxrl_vis.report.outputs import check_writable


@dataclasses.dataclass(frozen=True)
class Search:
    """Search for hyper-parameters with Optuna: train trials, one per device, and print the best (needs the extra ``search``).

    A trial's score is the metric of --best-by (success if not given) at its last evaluation. The search may be interrupted and
    started again at any time, also with more --trials. The exit status is 3 if something is still missing.
    """

    env: Annotated[str, AlsoPositional()] = "VisualFetchReach"
    """Environment: a name listed by `jaxrl-vis envs`, or module:Name for a custom one."""
    vary: tuple[str, ...] = ()
    """Search space of one or several options: NAME=LOW..HIGH, NAME=LOW..HIGH,log or NAME=VALUE,VALUE,..., such as
    actor_learning_rate=1e-4..1e-2,log batch_size=128,256."""
    trials: int = 20
    """Number of trials, including those of earlier starts."""
    preset: Annotated[str, DefaultText(describe_default_preset)] = "auto"
    """paper, fast, cpu or debug; auto is fast on an accelerator, else cpu."""
    changes: Annotated[Mapping[str, Any], FieldsOf(Config, describe_default)] = dataclasses.field(default_factory=dict)
    runs: Path | None = None
    """Folder of all run folders, logs and the search's journal; runs/search if not given."""
    minutes: float | None = None
    """Time limit in minutes: runs are saved, and the next start resumes."""


def run(options: Search) -> int:
    """Run a search; return `UNFINISHED` if a trial is missing."""
    name = options.preset
    if name not in ("auto", *PRESETS):
        raise RequestError(f"unknown preset {name!r}{nearest(name, ['auto', *PRESETS])}")
    if name == "auto":
        name = "fast" if guess_accelerator() else "cpu"
    check_counts(trials=options.trials)
    if options.minutes is not None and options.minutes <= 0:
        raise RequestError(f"--minutes must be positive, not {options.minutes:g}")
    check_env(options.env, options.changes.get("env_folder"))
    config = validate(preset(name, **{**options.changes, "env": options.env}))
    if config.run.devices > 1:
        raise RequestError("a search has one device for each run: leave out --devices")
    runs = options.runs or Path("runs") / "search"
    check_writable(runs, "--runs", folder=True)
    # Nothing below initialises JAX in this process: the accelerator's memory is for the runs.
    from jaxrl_vis.studies.engine.search import Request, read_range, run_search

    request = Request(
        config=config,
        ranges=tuple(map(read_range, options.vary)),
        trials=options.trials,
        runs=runs,
        seconds=None if options.minutes is None else 60.0 * options.minutes,
    )
    return 0 if run_search(request) else UNFINISHED
