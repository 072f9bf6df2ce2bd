"""Repetition of a run's iterations, and comparison with its rows and checkpoints; see `verification`."""

import dataclasses
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.run.loop import GUARD
from jaxrl_vis.run.storage import metrics
from jaxrl_vis.run.storage.arrays import is_intact, to_host
from jaxrl_vis.run.storage.checkpoint import BEST, FULL, LIGHT, RECENT
from jaxrl_vis.run.storage.metrics import RUN_ID, PerSeed
from jaxrl_vis.run.storage.progress import Progress
from jaxrl_vis.run.storage.restoring import state_without_learner
from jaxrl_vis.run.verifying.inspection import Findings, RowConditions, format_list
from jaxrl_vis.types import LoopState

NOT_REPEATED = (RUN_ID, "time/", "resume/")
"""Prefixes of the names of values that no repetition can reproduce."""

Row = dict[str, Any]

_OTHER_BEGINS = 20


@dataclasses.dataclass
class Verification(Findings):
    """Findings about a run folder, and results of repeating its iterations.

    Attributes:
        rows, numbers: Counts of the rows that were repeated and of their numbers, equal or not.
        checkpoints: Names of the checkpoints that were compared with a repetition.
        differences: Lines about rows and checkpoints that differ from the repetition; also among the problems.
        largest: The largest relative difference of a number.
        unverified: Lines about parts that were not repeated, and why.
        caveats: Reasons why bit equality is not guaranteed: another machine, other software or devices, or an unknown or
            modified revision.
    """

    rows: int = 0
    numbers: int = 0
    checkpoints: list[str] = dataclasses.field(default_factory=list)
    differences: list[str] = dataclasses.field(default_factory=list)
    largest: float = 0.0
    unverified: list[str] = dataclasses.field(default_factory=list)
    caveats: list[str] = dataclasses.field(default_factory=list)

    @property
    def is_equal(self) -> bool:
        """True if something was repeated, all of it is equal, and nothing is missing, damaged or another run's."""
        return self.rows > 0 and not self.problems


class Repeater:
    """Repetition of iterations of one run, and comparison with its rows and checkpoints.

    Args:
        programs: Programs of the run.
        expected: Conditions on its rows.
        rows: Rows of its file.
        manifests: Manifests of its checkpoints, by tier and iteration.
        report: Receives the results.
        echo: Called with a line about each step.

    Attributes:
        repeated: Iterations whose rows were compared.
        without_evaluation: Iterations without an evaluation, as inferred from the means of the next one.
    """

    def __init__(
        self,
        programs: Programs,
        expected: RowConditions,
        rows: Sequence[Row],
        manifests: Mapping[tuple[str, int], dict[str, Any]],
        report: Verification,
        echo: Callable[[str], None],
    ):
        self._programs, self._expected, self._rows = programs, expected, rows
        self._manifests, self._report, self._echo = manifests, report, echo
        self.repeated: set[int] = set()
        self.without_evaluation: set[int] = set()

    def repeat(
        self, name: str, first_iteration: int, progress: Progress, loop: LoopState, compared_iterations: Sequence[int]
    ) -> None:
        """Repeat iterations and compare the results; ends early, with a difference, at a non-finite number.

        Args:
            name: Name of the starting point, for messages.
            first_iteration: Iterations completed at the start.
            progress: Progress of the host at the start.
            loop: State at the start; donated.
            compared_iterations: Iterations whose rows are compared, ascending; the repetition ends at the last one.
        """
        self._echo(f"repeating iterations {first_iteration + 1} to {compared_iterations[-1]} from {name} ...")
        history = {first_iteration - back: values for back, values in enumerate(reversed(progress.since_evaluation))}
        if first_iteration in compared_iterations:
            self._compare(name, first_iteration, loop, history)
        for iteration in range(first_iteration + 1, compared_iterations[-1] + 1):
            loop, values = self._programs.train_iteration(loop)
            read = self._programs.pending(values).read_per_seed(len(self._expected.seeds))
            broken = [key for key, counts in read.items() if key.startswith(GUARD) and any(counts)]
            if broken:
                self._note_difference(f"iteration {iteration}: the repetition from {name} meets non-finite numbers")
                return
            history[iteration] = {key: per_seed for key, per_seed in read.items() if not key.startswith(GUARD)}
            if iteration in compared_iterations:
                self._compare(name, iteration, loop, history)
            self._compare_checkpoints(iteration, progress.replay_lost_at, loop)

    def _note_difference(self, line: str) -> None:
        self._report.differences.append(line)
        self._report.problems.append(line)
        self._echo(f"  {line}")

    def _compare(self, name: str, iteration: int, loop: LoopState, history: Mapping[int, PerSeed]) -> None:
        """Compare the rows of an iteration with the repetition."""
        rows = [row for row in self._rows if row["iteration"] == iteration]
        outcome, _ = self._programs.evaluate(loop.train)
        evaluated = self._programs.pending(outcome).read_per_seed(len(self._expected.seeds))
        best: list[tuple[int, str, Any, Any]] | None = None
        for begin in self._mean_starts(iteration, history):
            repeated = self._repeated_rows(
                iteration, evaluated, [history[number] for number in range(begin + 1, iteration + 1)]
            )
            differences = [
                (row["seed"], key, value, again)
                for row in rows
                for key, value, again in _differences(row, repeated[row["seed"]])
            ]
            if best is None:
                best, numbers = differences, sum(len(_comparable_values(row)) for row in rows)
            if not differences:
                if best:
                    self.without_evaluation.update(range(begin + 1, iteration))
                    self._report.notes.append(
                        f"iteration {iteration} has means since iteration {begin}: eval_interval had another value then"
                    )
                best = differences
                break
        assert best is not None
        if iteration not in self.repeated:
            self.repeated.add(iteration)
            self._report.rows += len(rows)
            self._report.numbers += numbers
        if best:
            self._report_differences(name, iteration, best)
        else:
            seeds = "1 seed" if len(rows) == 1 else f"{len(rows)} seeds"
            self._echo(f"  iteration {iteration}: {numbers} numbers of {seeds}, all equal")

    def _report_differences(self, name: str, iteration: int, differences: Sequence[tuple[int, str, Any, Any]]) -> None:
        self._report.largest = max(
            [self._report.largest, *(_relative_difference(value, again) for _, _, value, again in differences)]
        )
        shown = format_list(
            f"seed {seed} {key} is {value} in the file, {again} here" for seed, key, value, again in differences
        )
        hint = ""
        if all(key.startswith("eval/") for _, key, _, _ in differences):
            hint = " (or eval_episodes had another value then)"
        self._note_difference(f"iteration {iteration}, from {name}: {shown}{hint}")

    def _mean_starts(self, iteration: int, history: Mapping[int, PerSeed]) -> list[int]:
        """List candidates for the iteration after which the means of a row begin, the one implied by eval_interval first."""
        interval, earliest = self._expected.eval_interval, min(history, default=iteration + 1) - 1
        scheduled = max((iteration - 1) // interval * interval, earliest)
        evaluated = sorted({row["iteration"] for row in self._rows if earliest <= row["iteration"] < iteration}, reverse=True)
        return list(dict.fromkeys([scheduled, *evaluated[:_OTHER_BEGINS], earliest]))

    def _repeated_rows(self, iteration: int, evaluated: PerSeed, history: Sequence[PerSeed]) -> dict[int, Row]:
        """Make the rows that a run writes for an iteration, by seed, without the columns that are not repeated."""
        counts = {
            "iteration": iteration,
            "updates": iteration * self._expected.updates,
            "env_steps": iteration * self._expected.env_steps,
        }
        means = metrics.with_precision(metrics.average_metrics(history))
        return {row["seed"]: row for row in metrics.make_rows(self._expected.seeds, counts, evaluated | means)}

    def _compare_checkpoints(self, iteration: int, mark: int | None, loop: LoopState) -> None:
        """Compare the state with checkpoints of the same iteration by their checksums."""
        for tier in (LIGHT, FULL, BEST, RECENT):
            manifest = self._manifests.get((tier, iteration))
            if manifest is None or saved_progress(manifest).replay_lost_at != mark:
                continue
            differing = []
            for described, tree in _saved_arrays(tier, manifest, loop):
                arrays = to_host(tree, copy=False)
                differing += [
                    leaf
                    for leaf, array in arrays.items()
                    if leaf not in described
                    or (list(array.shape) == described[leaf][0] and not is_intact(array, described[leaf]))
                ]
                del arrays  # a view would make the next donation a copy
            if (checkpoint := f"{tier}/{iteration}") not in self._report.checkpoints:
                self._report.checkpoints.append(checkpoint)
            if differing:
                self._note_difference(
                    f"checkpoint {tier}/{iteration} differs from the repetition: {format_list(differing)} differ"
                )
            else:
                self._echo(f"  checkpoint {tier}/{iteration}: equal")


def _saved_arrays(tier: str, manifest: Mapping[str, Any], loop: LoopState) -> Iterator[tuple[Mapping[str, Any], Any]]:
    """Yield pairs of a manifest's items and the arrays that they describe."""
    items = manifest["items"]
    if tier == RECENT:
        state = {"train": loop.train, "key": loop.key, "iteration": loop.iteration, "replay": {"size": loop.replay.size}}
        yield items, state
        return
    yield items.get("train", {}), loop.train
    if tier == FULL:
        yield items.get("rest", {}), state_without_learner(loop)


def saved_progress(manifest: Mapping[str, Any]) -> Progress:
    """Return the host's progress saved with a checkpoint."""
    return Progress.from_dict(manifest["progress"])


def has_progress(manifest: Mapping[str, Any], seeds: int) -> bool:
    """Return True if a manifest has the host's progress, with the right types.

    Args:
        manifest: Manifest of a checkpoint.
        seeds: Number of seeds of the run.
    """
    try:
        progress = saved_progress(manifest)
        names = {name for values in progress.since_evaluation for name in values}
        figures = [number for values in progress.since_evaluation for name in names for number in values[name]]
        counts = [len(row) for values in progress.since_evaluation for row in values.values()]
    except (AttributeError, KeyError, TypeError, ValueError):
        return False
    return all(isinstance(number, float) for number in figures) and set(counts) <= {seeds}


def _comparable_values(row: Mapping[str, Any]) -> Row:
    return {name: value for name, value in row.items() if not name.startswith(NOT_REPEATED)}


def _differences(row: Mapping[str, Any], repeated: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield the name, the value of ``row`` and that of ``repeated``, for values that differ as JSON text."""
    compared = _comparable_values(row)
    for name in dict.fromkeys([*compared, *repeated]):
        value, again = compared.get(name, "nothing"), repeated.get(name, "nothing")
        if json.dumps(value) != json.dumps(again):
            yield name, value, again


def _relative_difference(value: Any, repeated: Any) -> float:
    """Return the difference of two numbers relative to the larger one; infinite if either value is not numeric."""
    if not (isinstance(value, int | float) and isinstance(repeated, int | float)):
        return math.inf
    return abs(value - repeated) / max(abs(value), abs(repeated)) if value != repeated else 0.0
