"""A training run from its first line to its last: iterations, evaluations, checkpoints, images.

    dispatch iteration k+1                 the device never waits for the host ...
    read the metrics of iteration k        ... because the host reads one iteration late
    at a boundary (evaluation, checkpoint, signal): read the current iteration too, then evaluate, write metrics, save

Metrics are on the disk before the checkpoint of the same iteration is, so a checkpoint never runs ahead of metrics.jsonl; and
nothing is saved before the iteration's metrics were read and found finite.
"""

import contextlib
import dataclasses
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.errors import NonFiniteError
from jaxrl_vis.report import plots, videos
from jaxrl_vis.run import metrics
from jaxrl_vis.run.checkpoint import FULL, LIGHT, Checkpoints, Restored
from jaxrl_vis.run.console import RunConsole, show_seconds, show_shares
from jaxrl_vis.run.folder import RunFolder
from jaxrl_vis.run.memory import check_compiled, check_memory
from jaxrl_vis.run.metrics import PerSeed
from jaxrl_vis.run.nonfinite import dump, nonfinite_leaves
from jaxrl_vis.run.signals import Interruption
from jaxrl_vis.types import LoopState

if TYPE_CHECKING:
    from jaxrl_vis.run.trainer import Trainer

_FILTERED_TOO_MUCH, _FILTERED_EVALUATIONS = 0.9, 3


@dataclasses.dataclass(frozen=True)
class Report:
    """What the host knows about one iteration.

    Attributes:
        iteration: Iterations done since the run began, this one included.
        env_steps: Environment steps so far, per seed.
        updates: Gradient steps so far, per seed.
        metrics: Name -> one number per seed; ``eval/*`` only where the iteration ended with an evaluation.
    """

    iteration: int
    env_steps: int
    updates: int
    metrics: PerSeed


@dataclasses.dataclass
class Memo:
    """What the host remembers from one part of a run to the next; saved with every checkpoint.

    Attributes:
        wall_s, compile_s: Spent by earlier parts, s.
        updates: Gradient steps so far, per seed.
        since_evaluation: train/* of every iteration since the last scheduled evaluation.
        evaluation_due: The iteration ends with an evaluation, which a signal prevented.
        filtered: Evaluations in a row with too large a filtered share.
    """

    wall_s: float = 0.0
    compile_s: float = 0.0
    updates: int = 0
    since_evaluation: list[PerSeed] = dataclasses.field(default_factory=list)
    evaluation_due: bool = False
    filtered: int = 0


@dataclasses.dataclass(frozen=True)
class _Pending:
    """Results of an iteration that the device may still be working on."""

    iteration: int
    metrics: dict[str, jax.Array]
    updates: jax.Array


class RunLoop:
    """One call of `Trainer.run`.

    Args:
        trainer: What to run.
        folder: Where its files go.
    """

    def __init__(self, trainer: "Trainer", folder: RunFolder):
        self._trainer, self._folder = trainer, folder
        self._config, self._program = trainer.config, trainer.program
        self._console = RunConsole()
        self._say = self._console.say
        self._checkpoints = Checkpoints(folder.checkpoints, self._say)
        self._total: int = self._program.num_iterations
        self._memo = Memo()
        self._done = 0
        self._loop: LoopState | None = None
        self._images: dict[str, jax.Array] = {}
        self._started = self._mark = time.monotonic()
        self._begun, self._begun_at = 0, self._mark
        self._marked_iteration = 0

    def reports(self, resume: bool, overwrite: bool) -> Iterator[Report]:
        """The whole run; see `Trainer.run`."""
        goes_on = self._folder.check(self._config, resume, overwrite)
        if resume and not goes_on:
            self._say(f"nothing to resume in {self._folder.path}: starting at the beginning")
        if goes_on and max(self._checkpoints.iterations(LIGHT), default=0) >= self._total:
            self._say(f"{self._folder.path} is finished already ({self._total} iterations): ask for more --env-steps to go on")
            return
        # Before anything is written or, to start again, deleted.
        steps = self._program.steps_per_iteration
        memory = check_memory(self._config, self._trainer.shapes, self._program.replay_bytes, steps)
        self._folder.open(self._config, resume, overwrite)
        with self._console:
            try:
                self._prepare(goes_on, memory)
                # Not before: while XLA compiles, no Python runs that could look at a flag, and there is nothing to save.
                with Interruption() as interruption:
                    yield from self._train(interruption)
                    self._finish(interruption)
                self._checkpoints.close()
            except BaseException:
                # What is being written becomes whole; an error on the way must not hide the first one.
                with contextlib.suppress(Exception):
                    self._checkpoints.close()
                raise

    @property
    def _asked(self) -> str:
        config = self._config
        seeds = f"seed {config.seed}" if config.seeds == 1 else f"seeds {config.seed} to {config.seed + config.seeds - 1}"
        return f"{config.method}, preset {config.preset}, {seeds}"

    # -- Before

    def _prepare(self, goes_on: bool, memory: str) -> None:
        trainer, steps = self._trainer, self._program.steps_per_iteration
        self._say(f"{self._config.env}, {self._asked}, on {jax.devices()[0].device_kind}; {memory}")
        self._say(f"{self._total} iterations of {steps:,} environment steps per seed; files go to {self._folder.path}")
        restored = self._checkpoints.restore_for_resume(trainer.shapes) if goes_on else None
        if restored is not None:
            self._take_over(restored)
        elif goes_on:
            self._say("no usable checkpoint: starting at the beginning")
        if goes_on:
            metrics.cut_back(self._folder.metrics, self._done)
            self._checkpoints.discard_after(self._done)

        started = time.monotonic()
        self._say("compiling (once; the next start finds it in the cache) ...")
        programs = trainer.compile()
        self._memo.compile_s += time.monotonic() - started
        self._say(f"compiled in {show_seconds(time.monotonic() - started)}")
        check_compiled(programs, already_there=self._loop is not None)
        if self._loop is None:
            self._loop = trainer.init(trainer.run_keys)
        self._console.start(self._total, self._done)
        self._set_mark()
        self._begun, self._begun_at = self._done, self._mark

    def _take_over(self, restored: Restored) -> None:
        self._memo = Memo(**restored.memo)
        self._done = restored.iteration
        if restored.loop is not None:
            self._loop = restored.loop
            self._say(f"resumed at iteration {self._done} of {self._total}, exactly")
            return
        # A light checkpoint has no replay. Networks, optimisers, statistics and the iteration go on (and with it the random
        # draws); the replay starts empty, and knows that it is. Until it has filled up again, updates see fewer and newer
        # episodes than they would have: a sound run, but not the one that was interrupted.
        fresh = self._trainer.init(self._trainer.run_keys)
        self._loop = fresh.replace(train=restored.train, iteration=jnp.asarray(self._done, fresh.iteration.dtype))
        self._say(
            f"resumed at iteration {self._done} of {self._total} from a light checkpoint: networks go on, but the replay was "
            "not saved and fills up anew, so this is not an exact continuation (--full-checkpoint-interval saves the replay)"
        )

    # -- During

    def _train(self, interruption: Interruption) -> Iterator[Report]:
        config = self._config
        if self._memo.evaluation_due:
            yield self._evaluate(Report(self._done, self._env_steps(self._done), self._memo.updates, {}))
        pending: _Pending | None = None
        while self._done < self._total:
            assert self._loop is not None
            self._loop, values = self._trainer.train_iteration(self._loop)
            self._done += 1
            # A copy: the counter itself is donated to the next iteration before the host reads it.
            waiting, pending = pending, _Pending(self._done, values, jnp.copy(self._loop.train.updates))
            if waiting is not None:
                yield self._read(waiting)
            evaluation = self._is_due(config.eval_interval) or self._done == self._total
            light, full = self._is_due(config.checkpoint_interval), self._is_due(config.full_checkpoint_interval)
            if not (evaluation or light or full or interruption):
                continue
            report, pending = self._read(pending), None
            if interruption:
                self._save_and_end(evaluation, interruption)
            if evaluation:
                report = self._evaluate(report)
            if light:
                self._save_light()
            if full:
                self._save_full()
            # A signal that came during the evaluation must not wait for another iteration.
            if interruption and self._done < self._total:
                self._save_and_end(False, interruption)
            yield report

    def _is_due(self, interval: int) -> bool:
        return interval > 0 and self._done % interval == 0

    def _env_steps(self, iteration: int) -> int:
        return iteration * self._program.steps_per_iteration

    def _read(self, pending: _Pending) -> Report:
        """Waits for an iteration's metrics and takes them in.

        Raises:
            NonFiniteError: The guard has counted something.
        """
        values = {name: self._per_seed(value) for name, value in jax.device_get(pending.metrics).items()}
        guard = values.pop("guard/nonfinite", None)
        if guard is not None and any(count != 0 for count in guard):
            bad = [self._config.seed + i for i, count in enumerate(guard) if count != 0]
            self._stop_nonfinite(f"iteration {pending.iteration}, seed {', '.join(map(str, bad))}", values)
        self._memo.updates = int(np.max(np.asarray(pending.updates)))
        self._memo.since_evaluation.append({name: value for name, value in values.items() if name.startswith("train/")})
        self._console.advance(pending.iteration, self._speed(pending.iteration))
        return Report(pending.iteration, self._env_steps(pending.iteration), self._memo.updates, values)

    def _per_seed(self, value: Any) -> list[float]:
        array = np.broadcast_to(np.asarray(value, np.float32), (self._config.seeds,))
        return [float(str(number)) for number in array]  # the shortest decimal that reads back as the same float32

    def _evaluate(self, report: Report) -> Report:
        """Evaluates the learner, writes a line per seed, and adds the figures to the report."""
        assert self._loop is not None
        speed = self._speed(self._done)
        outcome, self._images = self._trainer.watch(self._loop)
        values = {name: self._per_seed(value) for name, value in jax.device_get(outcome).items()}
        if not all(np.isfinite(row).all() for row in values.values()):
            self._stop_nonfinite(f"the evaluation after iteration {self._done}", values)
        self._memo.evaluation_due = False
        means = metrics.mean_of(self._memo.since_evaluation)
        times = {
            "time/wall_s": self._memo.wall_s + time.monotonic() - self._started,
            "time/compile_s": self._memo.compile_s,
            "time/env_steps_per_s": speed,
        }
        rounded = {name: [round(value, 3)] * self._config.seeds for name, value in times.items()}
        counts = {"iteration": self._done, "updates": report.updates, "env_steps": report.env_steps}
        rows = metrics.make_rows(self._trainer.seeds, counts, values | means | rounded)
        metrics.append_rows(self._folder.metrics, rows)
        self._warn_if_filtered(means)
        # The last evaluation may come between two scheduled ones; a longer run, resumed from here, goes on with the means.
        if self._is_due(self._config.eval_interval):
            self._memo.since_evaluation = []
        self._show(values, speed)
        self._set_mark()
        return dataclasses.replace(report, metrics=report.metrics | values)

    def _show(self, values: PerSeed, speed: float) -> None:
        success, distance = values["eval/success"], values["eval/goal_distance"]
        self._console.evaluated(success, distance, self._trainer.distance_unit)
        left = (self._total - self._done) * (time.monotonic() - self._begun_at) / max(1, self._done - self._begun)
        line = (
            f"iteration {self._done}/{self._total}  {self._env_steps(self._done):,} steps  success {show_shares(success)}  "
            f"distance {np.median(distance):.3f} {self._trainer.distance_unit}  {speed:,.0f} steps/s"
        )
        self._say(line if self._done == self._total else f"{line}  about {show_seconds(left)} left")

    def _warn_if_filtered(self, means: PerSeed) -> None:
        too_much = max(means.get("train/filtered_share", [0.0])) > _FILTERED_TOO_MUCH
        self._memo.filtered = self._memo.filtered + 1 if too_much else 0
        if self._memo.filtered == _FILTERED_EVALUATIONS:
            self._say(
                f"warning: more than {_FILTERED_TOO_MUCH:.0%} of the negatives were filtered since "
                f"{_FILTERED_EVALUATIONS} evaluations: Q lies above q0 almost everywhere and cannot come down; "
                "check reward_positive, reward_negative and filter_threshold"
            )

    def _speed(self, iteration: int) -> float:
        """Environment steps of all seeds per second since the last evaluation; updates included, evaluations not."""
        steps = (iteration - self._marked_iteration) * self._program.steps_per_iteration * self._config.seeds
        return max(0, steps) / max(1e-9, time.monotonic() - self._mark)

    def _set_mark(self) -> None:
        self._mark, self._marked_iteration = time.monotonic(), self._done

    # -- Saving

    def _memo_now(self) -> dict[str, Any]:
        memo = dataclasses.asdict(self._memo)
        memo["wall_s"] = self._memo.wall_s + time.monotonic() - self._started
        return memo

    def _save_light(self) -> None:
        assert self._loop is not None
        self._refuse_nonfinite(self._loop.train)
        self._checkpoints.save_light(self._done, self._loop.train, self._memo_now())

    def _save_full(self) -> None:
        assert self._loop is not None
        self._refuse_nonfinite(self._loop)
        self._checkpoints.save_full(self._done, self._loop, self._memo_now())

    def _save_and_end(self, evaluation_due: bool, interruption: Interruption) -> None:
        """Saves everything and raises what the signal stands for."""
        self._console.stop()
        self._say(f"{interruption.name}: saving iteration {self._done} (once more quits without saving) ...")
        self._memo.evaluation_due = evaluation_due
        if self._done not in self._checkpoints.iterations(FULL) or evaluation_due:
            self._save_full()
        self._draw_curve()
        self._say(f"saved; go on with --run-dir {self._folder.path} --resume")
        interruption.end()

    def _refuse_nonfinite(self, tree: Any) -> None:
        # The guard looks at losses and states; a parameter that broke in the very last update shows in the next iteration's.
        if nonfinite_leaves(tree):
            self._stop_nonfinite(f"the state after iteration {self._done}", {})

    def _stop_nonfinite(self, where: str, values: PerSeed) -> None:
        """Dumps the state and raises NonFiniteError."""
        assert self._loop is not None
        self._console.stop()
        self._checkpoints.wait()
        kept = self._checkpoints.newest()
        leaves = nonfinite_leaves(self._loop.train)
        file = self._folder.nonfinite / f"iteration_{self._done}.npz"
        dump(file, self._loop, values, leaves)
        names = [name for name, row in values.items() if not np.isfinite(row).all()] + leaves
        broken = f" ({', '.join(names[:3])}{f' and {len(names) - 3} more' if len(names) > 3 else ''})" if names else ""
        good = "there is no checkpoint yet" if kept is None else f"the last good checkpoint is of iteration {kept}"
        raise NonFiniteError(f"non-finite numbers in {where}{broken}: state dumped to {file}; {good}")

    # -- After

    def _finish(self, interruption: Interruption) -> None:
        assert self._loop is not None
        if self._done not in self._checkpoints.iterations(LIGHT):
            self._save_light()
        if self._config.full_checkpoint_interval and self._done not in self._checkpoints.iterations(FULL):
            self._save_full()
        self._checkpoints.wait()
        self._console.stop()
        if not interruption:
            self._draw_curve()
        if not interruption and self._trainer.shows_images:
            if not self._images:  # killed after the last evaluation, before this: resumed with nothing left to evaluate
                _, self._images = self._trainer.watch(self._loop)
            videos.write_video(videos.first_seed(self._images), self._folder.video, self._trainer.frame_seconds)
        if interruption:
            interruption.end()
        wall = self._memo.wall_s + time.monotonic() - self._started
        rows = [row for row in metrics.read_rows(self._folder.metrics) if row["iteration"] == self._done]
        success = ", ".join(f"seed {row['seed']}: {row['eval/success']:.3f}" for row in rows)
        written = [file.name for file in (self._folder.curve, self._folder.video) if file.exists()]
        compiling = show_seconds(self._memo.compile_s)
        self._say(f"success at the end: {success}; {show_seconds(wall)}, of which {compiling} compiling")
        self._say(f"see {', '.join([*written, self._folder.metrics.name])} in {self._folder.path}")

    def _draw_curve(self) -> None:
        config, trainer = self._config, self._trainer
        plots.plot_run(
            metrics.read_rows(self._folder.metrics),
            self._folder.curve,
            title=config.env,
            subtitle=f"{self._asked}, {config.eval_episodes} episodes per evaluation"
            + ("; thick: median, band: middle half" if config.seeds > 1 else ""),
            unit=trainer.distance_unit,
            threshold=trainer.threshold,
        )
