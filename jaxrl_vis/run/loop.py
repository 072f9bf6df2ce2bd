"""Training run: iterations, evaluations, checkpoints, images.

    dispatch iteration k+1                 the device never waits for the host ...
    read the metrics of iteration k        ... because the host reads one iteration late
    at a boundary (evaluation, checkpoint, signal): also read the current iteration, then evaluate, write metrics, save

All checks that can refuse a run (folder, lock, memory, checkpoints, compilation, memory again) come before the first byte is
written or deleted. Rows of metrics.jsonl are on the disk before the checkpoint of the same iteration, unless that records its
evaluation as due; and nothing is saved before the iteration's metrics have been read and found finite.

With several processes (`jaxrl_vis.host.distributed`), all train, evaluate and save; only the first writes everything else. They
check for signals only at boundaries, where they synchronise anyway.
"""

import contextlib
import dataclasses
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxrl_vis.errors import NonFiniteError, RequestError, StorageError
from jaxrl_vis.host import distributed
from jaxrl_vis.host.streams import reserve_standard_files, safe_streams
from jaxrl_vis.run import resume_checks, trust
from jaxrl_vis.run.compiled.memory import check_compiled, check_memory
from jaxrl_vis.run.compiled.pending import PendingMetrics
from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.run.goodput import Goodput
from jaxrl_vis.run.loggers.console import RunConsole, format_fractions, format_seconds
from jaxrl_vis.run.loggers.group import Loggers
from jaxrl_vis.run.milestones import Milestones
from jaxrl_vis.run.pace import Pace
from jaxrl_vis.run.reports import Callback, Report
from jaxrl_vis.run.saving import Saver, import_saving_libraries
from jaxrl_vis.run.signals import Interruption
from jaxrl_vis.run.storage import metrics
from jaxrl_vis.run.storage.checkpoint import FULL, LIGHT, RECENT, Checkpoints
from jaxrl_vis.run.storage.folder import RunFolder, read_record, read_run_id
from jaxrl_vis.run.storage.lock import FolderGoneError, HeldLock, run_lock
from jaxrl_vis.run.storage.metrics import PerSeed
from jaxrl_vis.run.storage.progress import Progress
from jaxrl_vis.run.storage.restoring import Restored
from jaxrl_vis.run.trained.results import Results, describe
from jaxrl_vis.types import LoopState

_FILTERED_TOO_MUCH, _FILTERED_EVALUATIONS = 0.9, 3
GUARD = "guard/"
"""Name prefix of metrics that stop a run if they are not 0; all others are written to metrics.jsonl."""


class RunLoop:
    """State of one call of `Trainer.run`.

    Args:
        programs: Programs of the run.
        folder: Folder of its files.
        log: Names of the loggers, see `loggers`.
        on_begun: Called once the folder belongs to this run.
        callbacks: Called after each evaluation, once everything is saved.
    """

    def __init__(
        self,
        programs: Programs,
        folder: RunFolder,
        log: tuple[str, ...] = (),
        on_begun: Callable[[], None] = lambda: None,
        callbacks: Sequence[Callback] = (),
    ):
        self._on_begun, self._callbacks = on_begun, tuple(callbacks)
        self._programs, self._folder = programs, folder
        self._config, self._program = programs.config, programs.program
        self._writes = distributed.is_first()
        self._console = RunConsole(quiet=not self._writes)
        self._echo = self._console.echo
        self._checkpoints = Checkpoints(folder.checkpoints, self._echo)
        self._lock: HeldLock | None = None  # by the first process
        self._saver = Saver(programs, folder, self._checkpoints, self._echo, self._check_ownership)
        self._milestones = Milestones(self._config, self._checkpoints, self._saver, self._echo)
        self._log, self._loggers = log, Loggers(log if self._writes else (), folder.path, self._echo)
        self._results = Results(programs, folder, self._loggers, self._echo)
        self._total: int = self._program.num_iterations
        self._progress = Progress()
        self._goodput = Goodput(folder.processes)
        self._done = 0
        self._recent_at: int | None = None  # iteration of the recent state from which this process resumed
        self._replay_lost = False  # True if this process resumed from a light checkpoint
        self._loop: LoopState | None = None
        self._unread: list[tuple[int, PendingMetrics]] = []  # iterations whose metrics the device may still be working on
        self._recorded: dict[str, jax.Array] = {}
        self._started, self._compile_s = time.monotonic(), 0.0
        self._pace = Pace(self._program.steps_per_iteration * self._config.run.seeds)
        self._is_left_alone = False
        self._evaluated_seeds: set[int] = set()  # seeds that have a row of the iteration from which the run resumes
        self._evaluates_ahead = False  # True if evaluations are dispatched before the iteration's metrics are read
        self._evaluated_at = 0  # last evaluation according to the restored checkpoint
        self._owed_evaluation = False  # True if the restored checkpoint lacks its evaluation
        self.has_begun = False  # True once the folder belongs to this run

    def reports(self, resume: bool, overwrite: bool) -> Iterator[Report]:
        """Run to the end, yielding reports; see `Trainer.run`."""
        reserve_standard_files()
        is_resumed = self._folder.check(self._config, resume, overwrite)
        if resume and not is_resumed:
            self._echo(f"nothing to resume in {self._folder.path}: starting at the beginning")
        steps = self._program.steps_per_iteration
        shapes, layout = self._programs.shapes, self._programs.layout
        stacked = self._program.replay.frame_stack
        memory = check_memory(self._config, shapes, self._program.replay_bytes, steps, layout, stacked)
        distributed.sync_processes("checked")  # before the first process writes anything that the others would detect
        if is_resumed:
            self._checkpoints.run_id = read_run_id(self._folder.path)
        with run_lock(self._folder.path, self._echo) if self._writes else contextlib.nullcontext() as self._lock, self._console:
            if is_resumed and resume_checks.is_finished(
                self._folder, self._checkpoints, self._programs, self._total, self._echo
            ):
                if self._writes and (note := resume_checks.truncate_metrics(self._folder, self._checkpoints, sys.maxsize)):
                    self._echo(note)
                self._echo(resume_checks.finished_message(self._folder, self._checkpoints, self._config, self._total))
                return
            interruption = Interruption()
            try:
                with safe_streams():  # for warnings of libraries during compilation
                    compiled = self._prepare(is_resumed, memory)
                # Not before: while XLA compiles, no Python code can check the flag, and there is nothing to save.
                with interruption:
                    self._begin(compiled, is_resumed, overwrite)
                    yield from self._train(interruption)
                    self._finish(interruption)
                self._checkpoints.close()
            except FolderGoneError:
                self._console.stop()
                raise
            except StorageError as error:
                if gone := self._ownership_error():
                    raise gone from error
                self._rescue()
                raise self._saver.storage_error(error) from error
            except NonFiniteError:
                raise
            except (KeyboardInterrupt, SystemExit):
                if not interruption:  # raised by the caller's own handler, which was kept
                    self._rescue()
                raise
            except Exception as error:
                if gone := self._ownership_error():
                    raise gone from error
                self._rescue()
                raise
            finally:
                # Finish pending writes unless interrupted twice; never mask the original error.
                if not interruption.is_urgent and not self._is_left_alone:
                    with contextlib.suppress(StorageError):
                        self._checkpoints.close()
                    self._loggers.close(in_a_hurry=bool(interruption))
                    if self.has_begun and self._lock is not None and not self._lock.is_in_place():
                        self._folder.remove_remains(self._checkpoints.run_id)
                self._goodput.close()

    def _check_ownership(self) -> None:
        """Raise a `FolderGoneError` if the run folder was moved, deleted or taken over; called before every write."""
        if self._lock is not None and self.has_begun:
            self._folder.check_ownership(self._checkpoints.run_id, self._lock)

    def _ownership_error(self) -> FolderGoneError | None:
        """Return the error if the run folder no longer belongs to this run, and remove the progress bar; None if it does."""
        try:
            self._check_ownership()
        except FolderGoneError as gone:
            self._console.stop()
            return gone
        return None

    def _rescue(self) -> None:
        self._console.stop()
        if not self.has_begun:  # nothing was learned since the last checkpoint, and the folder may belong to another run
            return
        if distributed.is_multi_process():
            self._is_left_alone = True  # the other processes may have ended, and saving would wait for them
            return
        with contextlib.suppress(Exception):
            while self._unread:
                self._read()
        if not self._unread:
            self._saver.rescue(self._loop, self._done, self._progress_now())

    # -- Before

    def _prepare(self, is_resumed: bool, memory: str) -> dict[str, Any]:
        """Restore, if the run resumes, and compile; return the compiled programs by name. Nothing is written."""
        programs, steps = self._programs, self._program.steps_per_iteration
        self._echo(f"{self._config.environment.env}, {describe(self._config)}, on {programs.layout.name}; {memory}")
        self._echo(f"{self._total} iterations of {steps:,} environment steps per seed; files go to {self._folder.path}")
        restored = self._checkpoints.restore_for_resume(programs.shapes) if is_resumed else None
        if restored is not None:
            resume_checks.check_missing_rows(self._folder, restored)
            self._take_over(restored)
        elif is_resumed:
            self._echo("no usable checkpoint: starting at the beginning")

        started = time.monotonic()
        self._echo(f"compiling ({programs.cache_message()}) ...")
        compiled = programs.compile(concurrent_work=import_saving_libraries)
        self._compile_s = time.monotonic() - started
        self._progress.compile_s += self._compile_s
        return compiled

    def _begin(self, compiled: dict[str, Any], is_resumed: bool, overwrite: bool) -> None:
        """Check the memory again, the last check that can refuse the run; then prepare folder and state."""
        self._echo(f"compiled in {format_seconds(self._compile_s)}")
        is_there, layout = self._loop is not None, self._programs.layout
        has_room = not distributed.any_process(not check_compiled(compiled, is_there, layout))  # and all have come here
        self._evaluates_ahead = self._programs.evaluates_ahead and has_room
        if self._writes:
            self._open(is_resumed, overwrite)
            if trust.is_own(self._config):  # and here it runs
                trust.trust(self._folder.path, self._config, was_trained_here=True)
        distributed.sync_processes("opened")
        self._checkpoints.run_id = read_run_id(self._folder.path)
        self.has_begun = True
        self._on_begun()
        self._milestones.begin()
        with self._saver.writing():
            foreign = self._checkpoints.set_aside_foreign_runs()
            damaged = self._checkpoints.set_aside_after(self._done) if is_resumed else []
            if self._writes:
                self._checkpoints.recent.resume_from(self._recent_at)
                self._goodput.begin(self._done, self._replay_lost)
                self._begin_log(is_resumed, damaged, foreign)
        distributed.sync_processes("begun")
        if self._loop is None:
            self._loop = self._programs.init(self._programs.run_keys)
        self._console.start(self._total, self._done)
        self._pace.begin(self._done)

    def _open(self, is_resumed: bool, overwrite: bool) -> None:
        """Prepare the folder, unless it was moved or deleted during compilation."""
        assert self._lock is not None
        self._folder.check_place(self._lock)
        try:
            if overwrite and self._folder.config.exists():
                with self._saver.writing():
                    for line in resume_checks.set_foreign_files_aside(self._folder, self._checkpoints):
                        self._echo(line)
            self._folder.open(self._config, is_resumed, overwrite, self._log)
        except RequestError:
            self._folder.check_place(self._lock)
            raise

    def _begin_log(self, is_resumed: bool, damaged: list[Path], foreign: list[Path]) -> None:
        """Truncate the metrics to the iteration from which the run continues, and open the loggers.

        Args:
            is_resumed: True if the run resumes.
            damaged: Damaged checkpoints that were set aside.
            foreign: Checkpoints of other runs that were set aside.
        """
        if is_resumed:
            if note := resume_checks.truncate_metrics(
                self._folder, self._checkpoints, self._done, bool(damaged), self._evaluated_at
            ):
                self._echo(note)
            self._evaluated_seeds = {row["seed"] for row in self._folder.rows() if row["iteration"] == self._done}
        for path in damaged:
            self._echo(f"kept for inspection: {path}")
        for path in foreign:
            self._echo(resume_checks.foreign_message(path))
        self._loggers.open(read_record(self._folder.path), self._programs.seeds, self._folder.rows())

    def _take_over(self, restored: Restored) -> None:
        self._progress = Progress.from_dict(restored.progress)
        self._done, self._evaluated_at = restored.iteration, resume_checks.last_evaluation(restored)
        if resume_checks.has_ended_early(self._folder, self._config, self._programs.seeds, self._done):
            self._total = min(self._total, self._done)
        # A run that had all its steps but not the evaluation, or is resumed with fewer total steps, ends with an evaluation.
        self._progress.evaluation_due |= self._done >= self._total and not resume_checks.is_evaluated(
            self._folder, self._programs.seeds, restored
        )
        self._owed_evaluation = self._progress.evaluation_due
        if restored.loop is not None:
            self._loop = restored.loop
            self._recent_at = restored.iteration if restored.tier == RECENT else None
            self._echo(f"resumed at iteration {self._done} of {self._total}, exactly")
            return
        self._loop = resume_checks.state_without_replay(self._programs, restored)
        if self._done < self._total:
            self._progress.replay_lost_at, self._replay_lost = self._done, True
        self._echo(
            f"resumed at iteration {self._done} of {self._total} from a light checkpoint: replay lost; networks go on, but the "
            "replay fills up anew, so this is not an exact continuation (--full-checkpoint-interval saves the replay)"
        )

    # -- During

    def _train(self, interruption: Interruption) -> Iterator[Report]:
        config = self._config
        if self._progress.evaluation_due:
            report = self._evaluate(self._report(self._done, {}), self._begin_evaluation())
            self._end_early(report)
            yield report
        while self._done < self._total:
            assert self._loop is not None
            self._loop, values = self._programs.train_iteration(self._loop)
            self._done += 1
            self._goodput.count()
            self._unread.append((self._done, self._programs.pending(values)))
            if len(self._unread) > 1:
                yield self._read()
            evaluation = self._is_due(config.run.eval_interval) or self._done == self._total
            light, full = self._is_due(config.run.checkpoint_interval), self._is_due(config.run.full_checkpoint_interval)
            recent = self._saver.is_recent_due(light)
            if not (evaluation or light or full or recent or (interruption and not distributed.is_multi_process())):
                continue
            # Before the metrics are read, so that the device does not wait for the host.
            outcome = self._begin_evaluation() if evaluation and self._evaluates_ahead else None
            report = self._read()
            if interruption.reached_any():
                self._save_and_end(evaluation, interruption)
            if recent:  # and again after an evaluation, during which the process may be killed
                self._progress.evaluation_due = evaluation
                self._saver.save_recent(self._loop, self._done, self._progress_now())
            if evaluation:
                report = self._evaluate(report, self._begin_evaluation() if outcome is None else outcome)
            if recent and evaluation:
                self._saver.save_recent(self._loop, self._done, self._progress_now())
            if light:
                self._saver.save_light(self._loop, self._done, self._progress_now())
            if full:
                self._saver.save_full(self._loop, self._done, self._progress_now())
            # A signal received during the evaluation must not wait for another iteration.
            if self._done < self._total and interruption.reached_any():
                self._save_and_end(False, interruption)
            if evaluation:
                self._end_early(report)
            yield report

    def _end_early(self, report: Report) -> None:
        """Make this iteration the last one if an evaluation or a callback requests it."""
        if (reason := self._milestones.end_reason(report, self._callbacks)) and self._done < self._total:
            self._echo(f"stopped at iteration {self._done} of {self._total}: {reason}")
            self._total = self._done

    def _is_due(self, interval: int) -> bool:
        return interval > 0 and self._done % interval == 0

    def _report(self, iteration: int, values: PerSeed) -> Report:
        env_steps, updates = self._program.steps_per_iteration, self._program.updates_per_iteration
        return Report(iteration, iteration * env_steps, iteration * updates, values)

    def _read(self) -> Report:
        """Wait for the metrics of the oldest unread iteration, record them, and return their report.

        Raises:
            NonFiniteError: A guard metric is not 0.
        """
        iteration, pending = self._unread[0]
        values = pending.read_per_seed(self._config.run.seeds)
        guards = [values.pop(name) for name in list(values) if name.startswith(GUARD)]
        bad = sorted({self._config.run.seed + seed for counts in guards for seed, count in enumerate(counts) if count != 0})
        if bad:
            self._stop_nonfinite(f"iteration {iteration}, seed {', '.join(map(str, bad))}", values)
        self._progress.since_evaluation.append(values)
        del self._unread[0]
        self._console.advance(iteration, self._pace.speed(iteration))
        return self._report(iteration, values)

    def _begin_evaluation(self) -> PendingMetrics:
        """Dispatch an evaluation of the learner; `_evaluate` waits for the outcome."""
        assert self._loop is not None
        self._progress.evaluation_due = True  # until its rows are on the disk, whatever happens in between
        outcome, self._recorded = self._programs.evaluate(self._loop.train)
        return self._programs.pending(outcome)

    def _evaluate(self, report: Report, outcome: PendingMetrics) -> Report:
        """Read the results of an evaluation, write a line per seed, and add the metrics to the report."""
        progress, speed = self._progress, self._pace.speed(self._done)
        values = outcome.read_per_seed(self._config.run.seeds)
        if not all(np.isfinite(row).all() for row in values.values()):
            self._stop_nonfinite(f"the evaluation after iteration {self._done}", values)
        means = metrics.with_precision(metrics.average_metrics(progress.since_evaluation))
        times = {
            "time/wall_s": progress.wall_s + time.monotonic() - self._started,
            "time/compile_s": progress.compile_s,
            "time/env_steps_per_s": speed,
            "time/goodput": self._goodput.account(self._done).goodput or math.nan,
        }
        rounded = {name: [round(value, 3)] * self._config.run.seeds for name, value in times.items()}
        counts = {"iteration": self._done, "updates": report.updates, "env_steps": report.env_steps}
        if progress.replay_lost_at is not None:
            counts["resume/replay_lost_at"] = progress.replay_lost_at
        if self._writes:
            self._check_ownership()
            rows = metrics.make_rows(self._programs.seeds, counts, values | means | rounded)
            rows = [{**row, metrics.RUN_ID: self._checkpoints.run_id} for row in rows]
            if self._done == self._pace.begun:  # an evaluation that was due: a kill or a disk may have left a part of its rows
                rows = [row for row in rows if row["seed"] not in self._evaluated_seeds]
            with self._saver.writing():
                metrics.append_rows(self._folder.metrics, rows)
            self._loggers.log_rows(rows)
        progress.evaluation_due = False
        self._warn_if_filtered(means)
        # The last evaluation may lie between two scheduled ones; a longer run, resumed from here, continues the means.
        if self._is_due(self._config.run.eval_interval):
            progress.since_evaluation = []
        self._show(values, speed)
        assert self._loop is not None
        self._milestones.save_if_best(self._loop, self._done, values, self._progress_now())
        self._pace.mark(self._done)
        return dataclasses.replace(report, metrics=report.metrics | values)

    def _show(self, values: PerSeed, speed: float) -> None:
        success, distance, unit = values["eval/success"], values["eval/goal_distance"], self._programs.env.distance_unit
        self._console.show_evaluation(success, distance, unit)
        env_steps = self._done * self._program.steps_per_iteration
        words = [f"iteration {self._done}/{self._total}", f"{env_steps:,} steps", f"success {format_fractions(success)}"]
        words.append(f"distance {np.median(distance):.3f} {unit}")
        if self._done > self._pace.begun:  # the speed is unknown if only a missed evaluation was made up for
            words.append(f"{speed:,.0f} steps/s")
            if self._done < self._total:
                words.append(f"about {format_seconds(self._pace.seconds_left(self._done, self._total))} left")
        self._echo("  ".join(words))

    def _warn_if_filtered(self, values: PerSeed) -> None:
        too_much = max(values.get("train/filtered_share", [0.0])) > _FILTERED_TOO_MUCH
        self._progress.filtered = self._progress.filtered + 1 if too_much else 0
        if self._progress.filtered == _FILTERED_EVALUATIONS:
            self._echo(
                f"warning: more than {_FILTERED_TOO_MUCH:.0%} of the negatives were filtered in the last "
                f"{_FILTERED_EVALUATIONS} evaluations: Q lies above q0 almost everywhere and cannot come down; "
                "check reward_positive, reward_negative and filter_threshold"
            )

    # -- Saving

    def _progress_now(self) -> Progress:
        return dataclasses.replace(self._progress, wall_s=self._progress.wall_s + time.monotonic() - self._started)

    def _save_and_end(self, evaluation_due: bool, interruption: Interruption) -> None:
        """Save everything and raise the signal's exception."""
        assert self._loop is not None
        self._console.stop()
        self._progress.evaluation_due = evaluation_due
        self._saver.save_on_signal(self._loop, self._done, self._progress_now(), interruption)
        with contextlib.suppress(OSError, FolderGoneError):
            if self._writes:
                self._check_ownership()
                self._results.draw_curve(self._done)
        interruption.end()

    def _stop_nonfinite(self, place: str, values: PerSeed) -> None:
        """Dump the state and raise NonFiniteError."""
        assert self._loop is not None
        self._console.stop()
        self._saver.stop_nonfinite(self._loop, self._done, place, values)

    # -- After

    def _finish(self, interruption: Interruption) -> None:
        assert self._loop is not None
        if self._owed_evaluation or not self._saver.has(LIGHT, self._done):
            self._saver.save_light(self._loop, self._done, self._progress_now())
        if self._config.run.full_checkpoint_interval and (self._owed_evaluation or not self._saver.has(FULL, self._done)):
            self._saver.save_full(self._loop, self._done, self._progress_now())
        self._saver.finish()
        self._console.stop()
        if interruption.reached_any():
            self._echo(
                f"{interruption.name}: all is trained and saved; to draw the curve and the video, {self._saver.resume_hint}"
            )
            interruption.end()
        if self._programs.shows_images and not self._recorded:
            # Killed after the last evaluation, before this: resumed with nothing left to evaluate.
            _, self._recorded = self._programs.evaluate(self._loop.train)
        if self._writes:
            self._echo(self._goodput.account(self._done).describe(self._program.updates_per_iteration))
            self._check_ownership()
            with self._saver.writing():
                self._results.show(self._done, self._progress_now, self._recorded)
