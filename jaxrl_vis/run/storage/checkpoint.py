"""Tiers of checkpoints: light ones often, full ones rarely, and the best one.

    checkpoints/light/<iteration>/   train         networks, targets, optimisers, statistics: enough for eval and play
    checkpoints/best/<iteration>/    train         as light, of the best evaluation: never resumed from, and only one is kept
    checkpoints/full/<iteration>/    train, rest   with the replay, keys and iteration: for an exact resume
    checkpoints/recent/                            full state in a cheaper format, for resuming after a kill; see `recent`

Each checkpoint has a manifest: names, shapes, dtypes and checksums of all arrays, and the host's progress. orbax makes a folder
appear under its final name only when it is complete; the checksums detect later damage, such as a flipped byte, which would
otherwise be restored silently. After the background write, SHA256SUMS (`sums`) is added for `verification`, also of data that
is never restored. The newest two light and the newest two full checkpoints are kept; without a ``full_checkpoint_interval``, a
full one (written on interruption) is deleted once a newer light one is on the disk, see `Checkpoints.retire_full`.

A run resumes from the newest valid full, recent or light checkpoint; ties are broken in this order. Checkpoints newer than the
one resumed from are never deleted: damaged ones are moved to checkpoints/damaged/, and those of another run, identified by
the run's id in the manifest, to checkpoints/foreign/. While a checkpoint is rewritten, the old copy is kept in
checkpoints/replaced/.
"""

import contextlib
import functools
import itertools
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxrl_vis.errors import RequestError, StorageError
from jaxrl_vis.host import distributed, streams
from jaxrl_vis.host.files import read_json
from jaxrl_vis.run.storage import restoring, silencing, sums
from jaxrl_vis.run.storage.arrays import describe, saved_leaves
from jaxrl_vis.run.storage.manifest import FILE, SCHEMA
from jaxrl_vis.run.storage.metrics import RUN_ID
from jaxrl_vis.run.storage.recent import ANY_RUN, Recent, Unusable
from jaxrl_vis.run.storage.restoring import Restored, state_without_learner
from jaxrl_vis.types import LoopState, TrainState

if TYPE_CHECKING:  # orbax takes a fifth of this package's import time, so it is imported where it is used
    import orbax.checkpoint as ocp

LIGHT, FULL, RECENT, BEST = "light", "full", "recent", "best"
_PRECEDENCE = (FULL, RECENT, LIGHT)  # for resuming, among equally new ones
_KEPT = 2
_TIMEOUT_S = 10**9
DAMAGED, FOREIGN, REPLACED = "damaged", "foreign", "replaced"


def _unused_path(path: Path) -> Path:
    """Return an unused path: ``path`` itself, or the first free one of path-2, path-3, ..."""
    numbered = (path.with_name(f"{path.name}-{number}") for number in itertools.count(2))
    return next(choice for choice in itertools.chain([path], numbered) if not choice.exists())


class Checkpoints:
    """Checkpoints of one run. While open, orbax's own log is silenced: errors are raised, and reported in one line.

    Args:
        folder: Folder of the tiers; created by the first save.
        echo: Called with one line about each unusable checkpoint.
        read_only: Whether to only read: nothing is saved, created or cleaned up.

    Attributes:
        run_id: Id of the run: other runs' checkpoints are ignored, except by `set_aside_foreign_runs`. `ANY_RUN`: all
            checkpoints.
        recent: Recent states of the run.
    """

    def __init__(
        self,
        folder: Path,
        echo: Callable[[str], None] = streams.echo,
        read_only: bool = False,
        run_id: str = ANY_RUN,
    ):
        self._folder = folder.absolute()  # orbax refuses relative names
        self._echo = echo
        self._read_only = read_only
        self.recent = Recent(self._folder / RECENT, echo)
        self.run_id = run_id
        self._managers: dict[str, ocp.CheckpointManager] = {}
        self._reported: set[tuple[str, int]] = set()  # damaged ones
        self._unsummed: set[tuple[str, int]] = set()  # saved, perhaps still in the background, and without `sums`
        self._unsilence: Callable[[], None] | None = None

    @property
    def run_id(self) -> str:
        """Id of the run, see the class."""
        return self.recent.run_id

    @run_id.setter
    def run_id(self, run_id: str) -> None:
        self.recent.run_id = run_id

    def _manager(self, tier: str) -> "ocp.CheckpointManager":
        import orbax.checkpoint as ocp
        from orbax.checkpoint.checkpoint_managers import LatestN
        from orbax.checkpoint.options import AsyncOptions

        if tier not in self._managers:
            if self._unsilence is None:
                self._unsilence = silencing.silence_orbax()
            # orbax measures timeouts with the system clock: a change of the clock could abort a good save. A single process
            # waits for its own disk indefinitely; with several, one that hangs must be detected.
            patient = AsyncOptions(timeout_secs=_TIMEOUT_S, create_directories_asynchronously=False)
            options = ocp.CheckpointManagerOptions(
                async_options=None if distributed.is_multi_process() else patient,
                # The best one may be older than the one that it replaces, see `save_best`.
                preservation_policy=None if self._read_only or tier == BEST else LatestN(_KEPT),
                cleanup_tmp_directories=not self._read_only,
                read_only=self._read_only,
                create=not self._read_only,
            )
            self._managers[tier] = ocp.CheckpointManager(self._folder / tier, options=options)
        return self._managers[tier]

    def iterations(self, tier: str) -> list[int]:
        """Return the iterations of this run's checkpoints in a tier, ascending, including damaged ones."""
        if tier == RECENT:
            return self.recent.iterations()
        return [iteration for iteration, is_ours in self._list(tier) if is_ours]

    def _list(self, tier: str) -> list[tuple[int, bool]]:
        """Return the iterations of a tier's checkpoints, ascending, with True for those of this run."""
        folder = self._folder / tier
        if not folder.is_dir():
            return []
        names = [entry.name for entry in folder.iterdir() if entry.name.isdecimal() and entry.is_dir()]
        return sorted((int(name), self._is_ours(folder / name)) for name in names)

    def _is_ours(self, checkpoint: Path) -> bool:
        """Return True if a checkpoint's manifest has this run's id, or cannot be read: a damaged one may be this run's."""
        try:
            manifest = read_json(checkpoint / FILE)
        except RequestError:
            return True
        return self.run_id in (ANY_RUN, manifest.get(RUN_ID))

    def newest(self) -> int | None:
        """Return the iteration of the newest full, recent or light checkpoint, even if damaged; None if there is none."""
        return max((iteration for tier in _PRECEDENCE for iteration in self.iterations(tier)), default=None)

    def save_light(self, iteration: int, train: TrainState, progress: dict[str, Any]) -> None:
        """Copy the learner to the host and write it in the background; ``train`` may be donated once this returns.

        Args:
            iteration: Iterations completed.
            train: The learner, [S, ...].
            progress: A JSON value.

        Raises:
            StorageError: It cannot be written, or an earlier light checkpoint could not.
        """
        self._save(LIGHT, iteration, {"train": saved_leaves(train, copy=True)}, progress)

    def save_best(self, iteration: int, train: TrainState, progress: dict[str, Any]) -> None:
        """Write the learner, wait for the disk, then delete earlier best checkpoints. Otherwise like `save_light`."""
        self._save(BEST, iteration, {"train": saved_leaves(train, copy=False)}, progress)
        self.wait()
        for earlier in self.iterations(BEST):
            if earlier != iteration:
                self._forget(BEST)
                if distributed.is_first():
                    shutil.rmtree(self._folder / BEST / str(earlier), ignore_errors=True)

    def save_full(self, iteration: int, loop: LoopState, progress: dict[str, Any]) -> None:
        """Write the complete state and wait for the disk: an asynchronous copy of the replay would need memory for two.

        Otherwise like `save_light`.
        """
        items = {
            "train": saved_leaves(loop.train, copy=False),
            "rest": saved_leaves(state_without_learner(loop), copy=False),
        }
        self._save(FULL, iteration, items, progress)
        self.wait()

    def _save(self, tier: str, iteration: int, items: dict[str, Any], progress: dict[str, Any]) -> None:
        import orbax.checkpoint as ocp

        described = {name: describe(arrays) for name, arrays in items.items()}
        manifest = {"schema": SCHEMA, RUN_ID: self.run_id, "iteration": iteration, "items": described, "progress": progress}
        arguments: dict[str, Any] = {name: ocp.args.StandardSave(arrays) for name, arrays in items.items()}
        arguments["manifest"] = ocp.args.JsonSave(manifest)
        if distributed.is_multi_process():
            self.wait()  # with two tiers written concurrently, processes would confuse one with the other
        with self._storage_errors(tier):
            manager = self._manager(tier)
            self._wait(tier)
            if distributed.any_process(iteration in self.iterations(tier)):  # orbax would silently keep the old one
                self._forget(tier)
                self._put_aside(tier, iteration)
                manager = self._manager(tier)
            if not manager.save(iteration, args=ocp.args.Composite(**arguments), force=True):
                raise RuntimeError(f"checkpoint {tier}/{iteration} was not written")
            self._unsummed.add((tier, iteration))

    def _wait(self, tier: str) -> None:
        """Wait until a tier is on the disk, including the checksums of its files."""
        self._managers[tier].wait_until_finished()
        for saved in [saved for saved in self._unsummed if saved[0] == tier]:
            folder = self._folder / tier / str(saved[1])
            if distributed.is_first() and folder.is_dir():
                sums.write_sums(folder)
            self._unsummed.discard(saved)
            if distributed.is_first():
                shutil.rmtree(self._replaced_path(*saved), ignore_errors=True)
                with contextlib.suppress(OSError):  # others are in there, or it does not exist
                    (self._folder / REPLACED).rmdir()

    def _replaced_path(self, tier: str, iteration: int) -> Path:
        """Return the place of a checkpoint while a new one of the same iteration is written."""
        return self._folder / REPLACED / f"{tier}-{iteration}"

    def _put_aside(self, tier: str, iteration: int) -> None:
        """Move a checkpoint aside, where `_recover` finds it if the process is killed before the replacement is complete."""
        distributed.sync_processes("replacing")
        if distributed.is_first():
            aside = self._replaced_path(tier, iteration)
            aside.parent.mkdir(exist_ok=True)
            shutil.rmtree(aside, ignore_errors=True)
            (self._folder / tier / str(iteration)).rename(aside)
        distributed.sync_processes("replaced")

    def _recover(self) -> None:
        """Move checkpoints back whose replacement was not completed, and delete those that were replaced."""
        for aside in (self._folder / REPLACED).glob("*-*") if distributed.is_first() else ():
            tier, _, iteration = aside.name.rpartition("-")
            place = self._folder / tier / iteration
            if tier not in (LIGHT, FULL, BEST):
                continue
            if place.exists():
                shutil.rmtree(aside, ignore_errors=True)
            else:
                aside.rename(place)
        distributed.sync_processes("recovered")

    @contextlib.contextmanager
    def _storage_errors(self, tier: str) -> Iterator[None]:
        """Convert orbax's exceptions on writing into a `StorageError`."""
        try:
            yield
        except Exception as error:
            # After a failed background write, a manager reports the error again and again: use a new one. Its threads keep
            # failing for a while, so the process stays silent about them from here on.
            self._managers.pop(tier, None)
            self._unsilence = lambda: None
            text = " ".join(str(error).split())
            shown = "no space left on the device" if "No space left" in text else f"{type(error).__name__}: {text[:160]}"
            raise StorageError(f"cannot write a {tier} checkpoint into {self._folder} ({shown})") from error

    def wait(self) -> None:
        """Wait until everything is on the disk.

        Raises:
            StorageError: Something could not be written.
        """
        for tier in list(self._managers):
            with self._storage_errors(tier):
                self._wait(tier)

    def close(self) -> None:
        """Wait for pending writes, then release orbax's threads."""
        for tier, manager in list(self._managers.items()):
            with self._storage_errors(tier):
                self._wait(tier)
                manager.close()
        self._managers.clear()
        if self._unsilence is not None:
            self._unsilence()
            self._unsilence = None

    def retire_full(self, has_ended: bool = False) -> None:
        """Delete full checkpoints older than a light one that is safely on the disk: they are no longer needed for resuming.

        Recent states that are no longer kept up to date are also deleted.

        Args:
            has_ended: Whether to delete equally new ones, too, because the run is complete.
        """
        newest = max(self.iterations(LIGHT), default=-1)
        if distributed.is_first():
            self.recent.retire(newest)
        for iteration in self.iterations(FULL):
            if iteration < newest + has_ended:
                self._forget(FULL)
                if distributed.is_first():
                    shutil.rmtree(self._folder / FULL / str(iteration), ignore_errors=True)

    def set_aside_after(self, iteration: int) -> list[Path]:
        """Move checkpoints after ``iteration``, which are unusable, to checkpoints/damaged/; return their new paths."""
        tiers = {tier: self.iterations(tier) for tier in (LIGHT, FULL, RECENT)}
        later = {tier: [number for number in iterations if number > iteration] for tier, iterations in tiers.items()}
        return self._move(later, DAMAGED)

    def set_aside_foreign_runs(self) -> list[Path]:
        """Move checkpoints of other runs to checkpoints/foreign/, where they are not counted; return their new paths."""
        foreign = {tier: [number for number, is_ours in self._list(tier) if not is_ours] for tier in (LIGHT, FULL, BEST)}
        moved = self._move(foreign, FOREIGN)
        recent = _unused_path(self._folder / FOREIGN / RECENT)
        if distributed.is_first() and self.recent.set_aside_foreign_runs(recent):
            moved.append(recent)
        return moved

    def _move(self, iterations: dict[str, list[int]], folder: str) -> list[Path]:
        moved = []
        for tier, iteration in [(tier, iteration) for tier, numbers in iterations.items() for iteration in numbers]:
            self._forget(tier)
            moved.append(_unused_path(self._folder / folder / f"{tier}-{iteration}"))
            if distributed.is_first():
                moved[-1].parent.mkdir(exist_ok=True)
                if tier == RECENT:
                    self.recent.set_aside(iteration, moved[-1])
                    continue
                (self._folder / tier / str(iteration)).rename(moved[-1])
        return moved

    def _forget(self, tier: str) -> None:
        """Close the tier's manager, which caches the folder's contents; the next use creates a new one."""
        if tier in self._managers:
            self._managers.pop(tier).close()

    def restore_for_resume(self, template: LoopState) -> Restored | None:
        """Restore the newest valid checkpoint of any tier, full before recent before light; None if there is none.

        Args:
            template: Shapes and dtypes of the loop state, as from `jax.eval_shape`.

        Raises:
            RequestError: A checkpoint has another structure.
        """
        self._recover()
        return self._newest_good(template, with_replay=True)

    def restore_train(self, template: LoopState, iteration: int | None = None) -> Restored | None:
        """Restore the learner of the newest valid light or full checkpoint, or of that of ``iteration``; None if there is none.

        Otherwise like `restore_for_resume`.
        """
        return self._newest_good(template, with_replay=False, requested=iteration)

    def manifest(self, tier: str, iteration: int) -> dict[str, Any]:
        """Return a checkpoint's manifest: ``schema``, ``run_id``, ``iteration``, ``items`` (`arrays.describe`), ``progress``.

        Raises:
            RequestError: The checkpoint is damaged, or of another schema.
        """
        with self._damage_as_request_error(tier, iteration):
            return self._read_manifest(tier, iteration)

    def restore(self, tier: str, manifest: dict[str, Any], template: LoopState) -> Restored:
        """Restore a light, best or full checkpoint completely, and compare it with the checksums in its manifest.

        Raises:
            RequestError: The checkpoint is damaged, or has another structure.
        """
        iteration = manifest["iteration"]
        with self._damage_as_request_error(tier, iteration):
            return self._restore_from(tier, iteration, template, tier == FULL, manifest)

    @contextlib.contextmanager
    def _damage_as_request_error(self, tier: str, iteration: int) -> Iterator[None]:
        try:
            yield
        except Unusable as damage:
            raise RequestError(f"checkpoint {tier}/{iteration} is damaged ({damage})") from None

    def _newest_good(self, template: LoopState, with_replay: bool, requested: int | None = None) -> Restored | None:
        # A light checkpoint is smaller, and a recent one may be deleted by the run while it is read.
        tiers = _PRECEDENCE if with_replay else (LIGHT, FULL)
        candidates = [
            (iteration, tier) for tier in tiers for iteration in self.iterations(tier) if requested in (None, iteration)
        ]
        for iteration, tier in sorted(candidates, key=lambda item: (-item[0], tiers.index(item[1]))):
            try:
                if tier == RECENT:
                    loop, progress = self.recent.restore(iteration, template)
                    return Restored(RECENT, iteration, loop.train, loop, progress)
                manifest = self._read_manifest(tier, iteration)
                return self._restore_from(tier, iteration, template, with_replay and tier == FULL, manifest)
            except Unusable as damage:
                if (tier, iteration) not in self._reported:
                    self._echo(f"checkpoint {tier}/{iteration} is damaged ({damage}); trying the one before")
                self._reported.add((tier, iteration))
        return None

    def _read_manifest(self, tier: str, iteration: int) -> dict[str, Any]:
        where = self._folder / tier / str(iteration)
        return restoring.read_manifest(functools.partial(self._read, tier, iteration), where)

    def _restore_from(
        self, tier: str, iteration: int, template: LoopState, with_replay: bool, manifest: dict[str, Any]
    ) -> Restored:
        read, where = functools.partial(self._read, tier, iteration), self._folder / tier / str(iteration)
        train, loop = restoring.restore_items(read, where, manifest, template, with_replay)
        return Restored(tier, iteration, train, loop, manifest["progress"])

    def _read(self, tier: str, iteration: int, arguments: dict[str, Any]) -> Any:
        import orbax.checkpoint as ocp

        try:
            return self._manager(tier).restore(iteration, args=ocp.args.Composite(**arguments))
        # orbax and tensorstore report damage by arbitrary exceptions, plain Exception included.
        except Exception as error:
            self._unsilence = lambda: None  # as after a failed write: threads of this read may report errors later
            text = " ".join(str(error).split())[:80]
            raise Unusable(f"{type(error).__name__}: {text}") from None
