"""Contents, schedule and order of what a run saves.

A checkpoint has finite numbers only, and metrics.jsonl is on the disk before a checkpoint of the same iteration (except for a
recent state, whose evaluation may still be due). On a signal, the light checkpoint is written first, which takes seconds, then
the full one with the replay: if the process is killed or the disk fills up in between, the networks are saved.
"""

import contextlib
import dataclasses
import errno
import functools
import importlib
import shlex
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import numpy as np

from jaxrl_vis.errors import NonFiniteError, StorageError
from jaxrl_vis.host import distributed
from jaxrl_vis.run.compiled.nonfinite import dump, nonfinite_simulation
from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.run.signals import Interruption
from jaxrl_vis.run.storage.checkpoint import FULL, LIGHT, RECENT, Checkpoints
from jaxrl_vis.run.storage.folder import RunFolder
from jaxrl_vis.run.storage.metrics import PerSeed
from jaxrl_vis.run.storage.progress import Progress
from jaxrl_vis.run.storage.recent import is_cheap
from jaxrl_vis.types import LoopState


def import_saving_libraries() -> None:
    """Import Matplotlib and orbax, which takes a second or two; called while XLA compiles."""
    for name in ("jaxrl_vis.report.plots", "orbax.checkpoint"):
        importlib.import_module(name)


class Saver:
    """Writer of a run's checkpoints, recent states and dumps of non-finite states.

    Args:
        programs: Programs of the run.
        folder: Folder of its files.
        checkpoints: Checkpoints of that folder.
        echo: Called with one line about each event.
        check: Raises a `StorageError` if the folder no longer belongs to this run; called before anything is written.
    """

    def __init__(
        self,
        programs: Programs,
        folder: RunFolder,
        checkpoints: Checkpoints,
        echo: Callable[[str], None],
        check: Callable[[], None],
    ):
        self._programs, self._folder, self._checkpoints, self._echo = programs, folder, checkpoints, echo
        self._check = check
        self._keeps_full = programs.config.run.full_checkpoint_interval > 0

    def has(self, tier: str, iteration: int) -> bool:
        """Return True if a tier has a checkpoint of an iteration; all processes return the same answer."""
        return distributed.any_process(iteration in self._checkpoints.iterations(tier))

    def save_light(self, loop: LoopState, iteration: int, progress: Progress) -> None:
        """Save the learner in the background; without a ``full_checkpoint_interval``, delete older full checkpoints.

        Args:
            loop: The state.
            iteration: Iterations completed.
            progress: Progress of the host.

        Raises:
            NonFiniteError: The state is not finite; it was dumped instead.
            StorageError: It cannot be written, or the previous one could not.
        """
        self._check()
        self._refuse_nonfinite(loop, iteration)
        self._checkpoints.save_light(iteration, loop.train, dataclasses.asdict(progress))
        if not self._keeps_full:
            self._checkpoints.retire_full()

    def save_best(self, loop: LoopState, iteration: int, progress: Progress, about: Mapping[str, Any]) -> None:
        """Save the learner as the best one, and wait for the disk. Arguments and errors as for `save_light`.

        Args:
            about: Additional entries of the progress in its manifest.
        """
        self._check()
        self._refuse_nonfinite(loop, iteration)
        self._checkpoints.save_best(iteration, loop.train, {**dataclasses.asdict(progress), **about})

    def save_full(self, loop: LoopState, iteration: int, progress: Progress) -> None:
        """Save the complete state and wait for the disk. Arguments and errors as for `save_light`."""
        self._check()
        self._refuse_nonfinite(loop, iteration)
        self._checkpoints.save_full(iteration, loop, dataclasses.asdict(progress))

    @functools.cached_property
    def _keeps_recent(self) -> bool:
        return self._programs.layout.mesh is None and is_cheap(self._programs.shapes.replay)

    def is_recent_due(self, light: bool) -> bool:
        """Return True if `save_recent` should be called after this iteration: it is cheap, and enough time has passed.

        Args:
            light: True if a light checkpoint is about to be written, which must not become the newest one, because the run
                would resume from it.
        """
        return self._keeps_recent and self._checkpoints.recent.is_due(light)

    def save_recent(self, loop: LoopState, iteration: int, progress: Progress) -> None:
        """Save the state for resuming after a kill; see `jaxrl_vis.run.storage.recent`.

        Raises:
            NonFiniteError, StorageError: As in `save_light`.
        """
        started = time.monotonic()
        self._check()
        self._refuse_nonfinite(loop, iteration)
        num_envs = self._programs.program.replay.num_envs
        self._checkpoints.recent.save(iteration, loop, num_envs, dataclasses.asdict(progress), started)

    def finish(self) -> None:
        """Wait until everything is on the disk, and delete states that only an unfinished run needs.

        Raises:
            StorageError: Something could not be written.
        """
        self._checkpoints.wait()
        self._check()
        if not self._keeps_full:
            self._checkpoints.retire_full(has_ended=True)
        if distributed.is_first():
            self._checkpoints.recent.clear()

    def save_on_signal(self, loop: LoopState, iteration: int, progress: Progress, interruption: Interruption) -> None:
        """Save the learner, then the complete state. If the disk fills up in between, the light checkpoint stays, with a
        message.

        Raises:
            NonFiniteError, StorageError: As in `save_light`.
        """
        hint = f"{interruption.quit_hint} at once, without the replay"
        self._echo(f"{interruption.name}: saving iteration {iteration} ({hint}) ...")
        if self.is_recent_due(light=True):  # in case the user does not wait
            self.save_recent(loop, iteration, progress)
        self._checkpoints.wait()  # one of this iteration may still be on its way: it is not written twice
        if not self.has(LIGHT, iteration) or progress.evaluation_due:
            self.save_light(loop, iteration, progress)
        self._checkpoints.wait()
        if not self.has(FULL, iteration) or progress.evaluation_due:
            try:
                self.save_full(loop, iteration, progress)
            except StorageError as error:
                missing = "there is no full checkpoint" if self.has(RECENT, iteration) else "the replay is not"
                self._echo(f"the networks are saved, {missing}: {error}; {self.resume_hint}")
                return
        if distributed.is_first():
            self._checkpoints.recent.clear()
        self._echo(f"saved; {self.resume_hint}")

    def rescue(self, loop: LoopState | None, iteration: int, progress: Progress) -> None:
        """Try to save the learner after an unexpected error; failures are not reported."""
        if loop is None or iteration == 0 or any(leaf.is_deleted() for leaf in jax.tree.leaves(loop)):
            return
        with contextlib.suppress(Exception):
            self._checkpoints.wait()
        if iteration <= (self._checkpoints.newest() or 0):
            return
        with contextlib.suppress(Exception):
            if self.is_recent_due(light=True):
                self.save_recent(loop, iteration, progress)
        with contextlib.suppress(Exception):
            self.save_light(loop, iteration, progress)
            self._checkpoints.wait()

    @property
    def resume_hint(self) -> str:
        """Hint for messages: the command-line options that resume the run, quoted for a shell."""
        return f"go on with --run-dir {shlex.quote(str(self._folder.path))} --resume"

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """Convert OSErrors within this context into a `StorageError`; for file operations of the run only."""
        try:
            yield
        except OSError as error:
            reason = error.strerror or type(error).__name__
            raise StorageError(f"cannot write to {self._folder.path} ({reason})") from error

    def storage_error(self, error: StorageError) -> StorageError:
        """Extend a write error by the last checkpoint and the command that resumes the run."""
        newest = self._checkpoints.newest()
        good = "there is no checkpoint yet" if newest is None else f"the last checkpoint is of iteration {newest}"
        cause = error.__cause__
        is_full = "no space left" in str(error).lower() or getattr(cause, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
        hint = "make room" if is_full else "fix that"
        return StorageError(f"{error}; {good}: {hint}, then {self.resume_hint}")

    def _refuse_nonfinite(self, loop: LoopState, iteration: int) -> None:
        # The guard checks losses and states; a parameter that breaks in the very last update appears in those of the next
        # iteration.
        if broken := self._programs.nonfinite_leaves(loop):
            self.stop_nonfinite(loop, iteration, f"the state after iteration {iteration}", {}, broken)

    def stop_nonfinite(
        self, loop: LoopState, iteration: int, place: str, values: PerSeed, broken: list[str] | None = None
    ) -> None:
        """Dump the state, unless it is distributed over several processes, and raise NonFiniteError.

        Args:
            loop: The state.
            iteration: Iterations completed.
            place: Location of the non-finite numbers, for the message.
            values: Metrics of the failed iteration or evaluation.
            broken: Names of the non-finite leaves of ``loop``; None to search for them.
        """
        with contextlib.suppress(StorageError):
            self._checkpoints.wait()
        newest = self._checkpoints.newest()
        leaves = self._programs.nonfinite_leaves(loop) if broken is None else broken
        leaves = [name.removeprefix("train.") for name in leaves if name.startswith("train.")]
        file = self._folder.nonfinite / f"iteration_{iteration}.npz"
        simulated, dumped = None, "the state is distributed over several processes and is not dumped"
        if not distributed.is_multi_process():
            try:
                dump(file, loop, values, leaves)
                dumped = f"state dumped to {file}"
            except OSError as error:
                dumped = f"the state cannot be written to {file} ({error.strerror or type(error).__name__})"
            simulated = nonfinite_simulation(loop, self._programs.config.run.num_envs)
            if simulated is None and not leaves and values and all(name.startswith("eval/") for name in values):
                simulated = "the networks are finite"
        names = [name for name, row in values.items() if not np.isfinite(row).all()] + leaves
        shown = f" ({', '.join(names[:3])}{f' and {len(names) - 3} more' if len(names) > 3 else ''})" if names else ""
        good = "there is no checkpoint yet" if newest is None else f"the last good checkpoint is of iteration {newest}"
        origin = f"they come from the simulation, not from the learner ({simulated}); " if simulated else ""
        raise NonFiniteError(f"non-finite numbers in {place}{shown}: {origin}{dumped}; {good}")
