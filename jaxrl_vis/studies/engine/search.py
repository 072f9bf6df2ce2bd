"""Hyper-parameter search: Optuna proposes values, `grid` trains them like the runs of a sweep, and Optuna gets the scores.

    runs/search.journal    Optuna's journal: every trial, its values and its score
    runs/trial-7-64k/      run folder of a trial

It may be interrupted or killed at any time. Training of trials without a score continues when it is started again. Nothing here
imports JAX: the accelerator's memory is left to the runs.
"""

import dataclasses
import functools
import importlib
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxrl_vis.config import OPTIONS, Config, fields, validate
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.host import streams
from jaxrl_vis.host.devices import Device, list_devices
from jaxrl_vis.host.provenance import install_command
from jaxrl_vis.run.command import training_command
from jaxrl_vis.run.storage import scores
from jaxrl_vis.studies.engine.cells import Cell, finished_rows
from jaxrl_vis.studies.engine.grid import Command, run_cells, train_command

JOURNAL, _STUDY, _REQUEST = "search.journal", "search", "request"
_SHOWN = 5


@dataclasses.dataclass(frozen=True)
class Range:
    """Search space of an option.

    Attributes:
        name: Name of the option.
        low, high: Bounds of a range, used if ``words`` is empty.
        log: Whether to sample on a logarithmic scale.
        words: Discrete values, as typed on the command line.
    """

    name: str
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    words: tuple[str, ...] = ()

    def distribution(self, optuna: Any) -> Any:
        """Return the search space as a distribution of Optuna."""
        if self.words:
            return optuna.distributions.CategoricalDistribution(self.words)
        if fields.unwrap(OPTIONS[self.name].hint)[0] is int:
            return optuna.distributions.IntDistribution(int(self.low), int(self.high), log=self.log)
        return optuna.distributions.FloatDistribution(self.low, self.high, log=self.log)

    def value(self, proposed: Any) -> Any:
        """Convert a value proposed by Optuna to a value of the option."""
        return _read(self.name, proposed) if self.words else proposed


def read_range(text: str) -> Range:
    """Read ``name=low..high``, ``name=low..high,log`` or ``name=value,value,...``.

    Raises:
        RequestError: The text has another form, the option is unknown, or it does not accept the values.
    """
    name, equals, values = text.partition("=")
    name = name.replace("-", "_")
    if not equals or not values:
        raise RequestError(f"--vary {text}: write NAME=LOW..HIGH, NAME=LOW..HIGH,log or NAME=VALUE,VALUE")
    if name not in OPTIONS:
        raise RequestError(f"--vary {text}: unknown option {name!r}{nearest(name, OPTIONS, 'see jaxrl-vis train --help')}")
    if ".." not in values:
        words = tuple(dict.fromkeys(values.split(",")))
        for word in words:
            _read(name, word)
        if len(words) < 2:
            raise RequestError(f"--vary {text}: name two values or more, or set it with --{name.replace('_', '-')}")
        return Range(name, words=words)
    if fields.unwrap(OPTIONS[name].hint)[0] not in (int, float) or fields.unwrap(OPTIONS[name].hint)[2]:
        raise RequestError(f"--vary {text}: {name} is not a number: list its values, NAME=VALUE,VALUE")
    ends, _, scale = values.partition(",")
    low, high = (_read(name, word) for word in ends.split("..", 1))
    if scale not in ("", "log") or not low < high or (scale and low <= 0):
        raise RequestError(f"--vary {text}: LOW must lie below HIGH, and above 0 for ,log")
    return Range(name, low, high, bool(scale))


def _read(name: str, word: str) -> Any:
    """Read one value of an option, and check its bounds."""
    value = fields.read(name, OPTIONS[name].hint, [word])
    fields.check_bounds(OPTIONS[name], value)
    return value


@dataclasses.dataclass(frozen=True)
class Request:
    """Request for a search.

    Attributes:
        config: Configuration of all runs; the score of a run is that of its last evaluation (`scores.score`).
        ranges: Search spaces of the options that vary.
        trials: Number of trials, including those of earlier calls.
        runs: Folder of the run folders and the journal.
        seed: Seed of the proposals.
        seconds: Time in seconds after which training stops; None if unlimited.
    """

    config: Config
    ranges: tuple[Range, ...]
    trials: int
    runs: Path
    seed: int = 0
    seconds: float | None = None


def run_search(
    request: Request,
    echo: Callable[[str], None] = streams.echo,
    find_devices: Callable[[], Sequence[Device]] = list_devices,
    command: Command = train_command,
) -> bool:
    """Train the requested number of trials, one per device at a time, and print the best.

    Args:
        request: The request.
        echo, find_devices, command: See `run_cells`.

    Returns:
        True if all trials have ended.

    Raises:
        RequestError: No option varies or one does twice, Optuna is missing, or the folder holds another search; see
            also `run_cells`.
        KeyboardInterrupt, Terminated: A signal arrived; raised after all runs have saved.
    """
    if not request.ranges:
        raise RequestError("nothing varies: name options and their values, such as --vary actor_learning_rate=1e-4..1e-2,log")
    if len({part.name for part in request.ranges}) < len(request.ranges):
        raise RequestError("--vary names an option twice: name it once")
    optuna = _optuna()
    study = _open(optuna, request)
    search = _Search(optuna, study, request, echo, command)
    try:
        is_done = search.run(find_devices)
    finally:
        search.show()
    return is_done


def _optuna() -> Any:
    try:
        optuna = importlib.import_module("optuna")
        importlib.import_module("optuna.storages.journal")
    except ImportError as error:
        raise RequestError(f"a search needs optuna: {install_command('search')}") from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return optuna


def _open(optuna: Any, request: Request) -> Any:
    """Open the journal's study.

    Raises:
        RequestError: The journal cannot be read or written, or belongs to another search.
    """
    file = request.runs / JOURNAL
    asked = _request_record(request)
    try:
        request.runs.mkdir(parents=True, exist_ok=True)
        storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(file)))
        # A different seed at each start: the same one would repeat earlier proposals.
        study = optuna.create_study(
            storage=storage,
            study_name=_STUDY,
            direction="minimize" if scores.is_lower_better(request.config) else "maximize",
            load_if_exists=True,
        )
        study.sampler = optuna.samplers.TPESampler(seed=request.seed + len(study.trials), constant_liar=True)
        earlier = study.user_attrs.get(_REQUEST)
        if earlier is None:
            study.set_user_attr(_REQUEST, asked)
    except OSError as error:
        raise RequestError(f"cannot write to {request.runs} ({error.strerror or error}): choose another --runs") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RequestError(f"{file} is not a journal of a search: move it away, or choose another --runs") from error
    if earlier is not None and earlier != asked:
        names = [name for name in asked if not isinstance(earlier, dict) or earlier.get(name) != asked[name]]
        shown = ", ".join(names[:3]) or "its options"
        raise RequestError(f"{request.runs} holds another search, with other {shown}: use these, or choose another --runs")
    return study


def _request_record(request: Request) -> dict[str, Any]:
    """Describe the settings common to all trials of a search, as a JSON value."""
    varied = {part.name for part in request.ranges}
    values = {name: value for name, value in request.config.flat().items() if name not in varied}
    vary = {part.name: dataclasses.asdict(part) for part in request.ranges}
    return json.loads(json.dumps({**values, "vary": vary}))


class _Search:
    def __init__(self, optuna: Any, study: Any, request: Request, echo: Callable[[str], None], command: Command):
        self._optuna, self._study, self._request, self._echo = optuna, study, request, echo
        self._command = command
        self._state = optuna.trial.TrialState

    def run(self, find_devices: Callable[[], Sequence[Device]]) -> bool:
        """Train batches of trials; return True if all have ended."""
        request, deadline = self._request, None
        if request.seconds is not None:
            deadline = time.monotonic() + request.seconds
        find_once = functools.cache(lambda: list(find_devices()))
        while True:
            batch = {trial.number: trial.params for trial in self._study.trials if not trial.state.is_finished()}
            missing = request.trials - len(self._study.trials)
            if not batch and missing <= 0:
                return True
            for _ in range(min(missing, len(find_once()) - len(batch))):
                trial = self._study.ask({part.name: part.distribution(self._optuna) for part in request.ranges})
                batch[trial.number] = trial.params
            cells = self._cells(batch)
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0:
                return False
            failures = run_cells(list(cells.values()), request.runs, find_once, left, self._command, self._echo)
            if not self._report_scores(cells, failures):
                return False

    def _cells(self, batch: Mapping[int, Mapping[str, Any]]) -> dict[int, Cell]:
        """Return the cells of trials by number; mark trials with missing or contradictory values as failed."""
        cells = {}
        for number, params in batch.items():
            if not {part.name for part in self._request.ranges} <= set(params):
                self._study.tell(number, state=self._state.FAIL)
                continue
            values = {part.name: part.value(params[part.name]) for part in self._request.ranges}
            try:
                cells[number] = Cell(f"trial-{number}", validate(self._request.config.replace(**values)))
            except RequestError as error:
                self._echo(f"trial-{number}: {error}")
                self._study.tell(number, state=self._state.FAIL)
        return cells

    def _report_scores(self, cells: Mapping[int, Cell], failures: Sequence[str]) -> bool:
        """Report the scores of trials to Optuna; return False if one has not ended, because time is up."""
        for number, cell in cells.items():
            rows = finished_rows(cell, self._request.runs)
            score = _score(cell, rows)
            if score is not None:
                self._study.tell(number, score)
            elif any(line.startswith((f"{cell.name}:", str(self._request.runs / cell.name))) for line in failures):
                self._study.tell(number, state=self._state.FAIL)
            else:
                self._echo("start again to go on")
                return False
        return True

    def show(self) -> None:
        """Print the best trials, and the command that trains the best one."""
        lower = scores.is_lower_better(self._request.config)
        done = [trial for trial in self._study.trials if trial.state == self._state.COMPLETE]
        done.sort(key=lambda trial: (trial.value if lower else -trial.value, trial.number))
        failed = sum(trial.state == self._state.FAIL for trial in self._study.trials)
        self._echo(f"{len(done)} of {self._request.trials} trials done{f', {failed} failed' if failed else ''}")
        for trial in done[:_SHOWN]:
            shown = "  ".join(f"{name} {_shown(value)}" for name, value in trial.params.items())
            self._echo(f"{f'trial-{trial.number}':10} {scores.metric_name(self._request.config)} {trial.value:.3f}  {shown}")
        if done:
            (cell,) = self._cells({done[0].number: done[0].params}).values()
            self._echo(f"the best one: {training_command(cell.config)}")


def _score(cell: Cell, rows: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the score of the last evaluation in ``rows``; None without one, or if it is not finite."""
    last = max((row["iteration"] for row in rows), default=0)
    values = [row.get(f"eval/{scores.metric_name(cell.config)}") for row in rows if row["iteration"] == last]
    if not values or any(value is None or not math.isfinite(value) for value in values):
        return None
    return scores.score(cell.config, {f"eval/{scores.metric_name(cell.config)}": values})  # type: ignore[dict-item]


def _shown(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
