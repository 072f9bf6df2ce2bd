"""Contents, occasions and order of what a run saves.

A checkpoint holds finite numbers only, and metrics.jsonl is on the disk before a checkpoint of the same iteration is (but for
a recent state, whose evaluation may be due still). On a signal the light checkpoint is written first, which takes seconds, and
the full one, with the replay, after it: whoever runs out of patience, or of disk, in between keeps the networks.
"""

import contextlib
import dataclasses
import errno
import functools
import importlib
import shlex
import time
from collections.abc import Callable, Iterator

import jax
import numpy as np

from jaxrl_vis import processes
from jaxrl_vis.errors import NonFiniteError, StorageError
from jaxrl_vis.run.checkpoint import FULL, LIGHT, RECENT, Checkpoints
from jaxrl_vis.run.compiled.nonfinite import dump, made_by_simulation
from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.run.folder import RunFolder
from jaxrl_vis.run.metrics import PerSeed
from jaxrl_vis.run.progress import Progress
from jaxrl_vis.run.recent import is_cheap
from jaxrl_vis.run.signals import Interruption
from jaxrl_vis.types import LoopState


def import_what_saves() -> None:
    """Matplotlib and orbax, which take a second or two to import: while XLA compiles, that costs nothing."""
    for name in ("jaxrl_vis.report.plots", "orbax.checkpoint"):
        importlib.import_module(name)


class Saver:
    """Saves the state of one run.

    Args:
        programs: Of the run.
        folder: Where its files go.
        checkpoints: Of that folder.
        say: Called with one line about what happens.
        check: Raises a `StorageError` where the folder is not this run's any more; called before anything is written.
    """

    def __init__(
        self,
        programs: Programs,
        folder: RunFolder,
        checkpoints: Checkpoints,
        say: Callable[[str], None],
        check: Callable[[], None],
    ):
        self._programs, self._folder, self._checkpoints, self._say = programs, folder, checkpoints, say
        self._check = check
        self._keeps_full = programs.config.full_checkpoint_interval > 0

    def has(self, tier: str, iteration: int) -> bool:
        """Whether there is a checkpoint of that tier and iteration; several processes agree on it."""
        return processes.any_of(iteration in self._checkpoints.iterations(tier))

    def light(self, loop: LoopState, iteration: int, progress: Progress) -> None:
        """Saves the learner in the background.

        Raises:
            NonFiniteError: The state is not finite; it was dumped instead.
            StorageError: It cannot be written, or the one before could not.
        """
        self._check()
        self._refuse_nonfinite(loop, iteration)
        self._checkpoints.save_light(iteration, loop.train, dataclasses.asdict(progress))
        if not self._keeps_full:
            self._checkpoints.retire_full()

    def full(self, loop: LoopState, iteration: int, progress: Progress) -> None:
        """Saves everything, and returns when it is on the disk. Raises as `light`."""
        self._check()
        self._refuse_nonfinite(loop, iteration)
        self._checkpoints.save_full(iteration, loop, dataclasses.asdict(progress))

    @functools.cached_property
    def _keeps_recent(self) -> bool:
        return self._programs.layout.mesh is None and is_cheap(self._programs.shapes.replay)

    def is_recent_due(self, light: bool) -> bool:
        """Returns whether `recent` is to be called after this iteration: it is cheap, and was not called for long enough.

        Args:
            light: Whether a light checkpoint is written, which must not be the newest, for it would be gone on from.
        """
        return self._keeps_recent and self._checkpoints.recent.is_due(light)

    def recent(self, loop: LoopState, iteration: int, progress: Progress) -> None:
        """Keeps the state up to date for a process that is killed; see `jaxrl_vis.run.recent`.

        Raises:
            NonFiniteError, StorageError: As `light`.
        """
        started = time.monotonic()
        self._check()
        self._refuse_nonfinite(loop, iteration)
        num_envs = self._programs.program.replay.num_envs
        self._checkpoints.recent.save(iteration, loop, num_envs, dataclasses.asdict(progress), started)

    def finish(self) -> None:
        """Returns when everything is on the disk, and deletes what only a run that has not ended goes on from.

        Raises:
            StorageError: Something could not be written.
        """
        self._checkpoints.wait()
        self._check()
        if not self._keeps_full:
            self._checkpoints.retire_full(has_ended=True)
        if processes.is_first():
            self._checkpoints.recent.clear()

    def on_signal(self, loop: LoopState, iteration: int, progress: Progress, interruption: Interruption) -> None:
        """Saves the learner, then everything. A full disk in between leaves the light checkpoint, and says so.

        Raises:
            NonFiniteError, StorageError: As `light`.
        """
        hint = f"{interruption.hurry} at once, without the replay"
        self._say(f"{interruption.name}: saving iteration {iteration} ({hint}) ...")
        if self.is_recent_due(light=True):  # for whoever does not wait
            self.recent(loop, iteration, progress)
        if not self.has(LIGHT, iteration) or progress.evaluation_due:
            self.light(loop, iteration, progress)
        self._checkpoints.wait()
        if not self.has(FULL, iteration) or progress.evaluation_due:
            try:
                self.full(loop, iteration, progress)
            except StorageError as error:
                what = "there is no full checkpoint" if self.has(RECENT, iteration) else "the replay is not"
                self._say(f"the networks are saved, {what}: {error}; {self.resume}")
                return
        if processes.is_first():
            self._checkpoints.recent.clear()
        self._say(f"saved; {self.resume}")

    def rescue(self, loop: LoopState | None, iteration: int, progress: Progress) -> None:
        """Tries to save the learner after something unexpected went wrong; what stands in the way is not reported."""
        if loop is None or iteration == 0 or any(leaf.is_deleted() for leaf in jax.tree.leaves(loop)):
            return
        with contextlib.suppress(Exception):
            self._checkpoints.wait()
        if iteration <= (self._checkpoints.newest() or 0):
            return
        with contextlib.suppress(Exception):
            if self.is_recent_due(light=True):
                self.recent(loop, iteration, progress)
        with contextlib.suppress(Exception):
            self.light(loop, iteration, progress)
            self._checkpoints.wait()

    @property
    def resume(self) -> str:
        """Command line that goes on with the run, quoted for a shell."""
        return f"go on with --run-dir {shlex.quote(str(self._folder.path))} --resume"

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """Turns what the system says of the run's files into a `StorageError`; what is called in here does nothing else."""
        try:
            yield
        except OSError as error:
            reason = error.strerror or type(error).__name__
            raise StorageError(f"cannot write to {self._folder.path} ({reason})") from error

    def storage_error(self, error: StorageError) -> StorageError:
        """What a run that could not write ends with: what failed, what there is, and how to go on."""
        kept = self._checkpoints.newest()
        good = "there is no checkpoint yet" if kept is None else f"the last checkpoint is of iteration {kept}"
        cause = error.__cause__
        is_full = "no space left" in str(error).lower() or getattr(cause, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
        mend = "make room" if is_full else "mend that"
        return StorageError(f"{error}; {good}: {mend}, then {self.resume}")

    def _refuse_nonfinite(self, loop: LoopState, iteration: int) -> None:
        # The guard looks at losses and states; a parameter that broke in the very last update shows in the next iteration's.
        if broken := self._programs.broken_leaves(loop):
            self.stop_nonfinite(loop, iteration, f"the state after iteration {iteration}", {}, broken)

    def stop_nonfinite(
        self, loop: LoopState, iteration: int, where: str, values: PerSeed, broken: list[str] | None = None
    ) -> None:
        """Dumps the state and raises NonFiniteError."""
        with contextlib.suppress(StorageError):
            self._checkpoints.wait()
        kept = self._checkpoints.newest()
        leaves = self._programs.broken_leaves(loop) if broken is None else broken
        leaves = [name.removeprefix("train.") for name in leaves if name.startswith("train.")]
        file = self._folder.nonfinite / f"iteration_{iteration}.npz"
        simulated, dumped = None, "the state lies in several processes and is not kept"
        if not processes.are_several():
            try:
                dump(file, loop, values, leaves)
                dumped = f"state dumped to {file}"
            except OSError as error:
                dumped = f"the state cannot be written to {file} ({error.strerror or type(error).__name__})"
            simulated = made_by_simulation(loop, self._programs.config.num_envs)
            if simulated is None and not leaves and values and all(name.startswith("eval/") for name in values):
                simulated = "the networks are finite"
        names = [name for name, row in values.items() if not np.isfinite(row).all()] + leaves
        shown = f" ({', '.join(names[:3])}{f' and {len(names) - 3} more' if len(names) > 3 else ''})" if names else ""
        good = "there is no checkpoint yet" if kept is None else f"the last good checkpoint is of iteration {kept}"
        origin = f"they come from the simulation, not from the learner ({simulated}); " if simulated else ""
        raise NonFiniteError(f"non-finite numbers in {where}{shown}: {origin}{dumped}; {good}")
