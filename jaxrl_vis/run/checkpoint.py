"""Checkpoints in two tiers, over orbax: a light one often, a full one rarely.

    checkpoints/light/<iteration>/   train         networks, targets, optimisers, statistics: enough for eval and play
    checkpoints/full/<iteration>/    train, rest   and the replay, keys and iteration: a resumed run repeats itself exactly
    checkpoints/recent/                            the same for a process that is killed, where it costs little, see `recent`

Each also holds a manifest: names, shapes and types of all arrays, their checksums, and what the host has to remember. orbax
makes a folder appear under its final name only when it is complete; the checksums find what went wrong later: without them, a
flipped byte in a data file would be restored without a word. Where the background has finished, SHA256SUMS (`sums`) follows,
for `verification`: of what nobody restores, too. The newest two of each tier are kept.

A run goes on from the newest good one of all these, and of those that are equally new from the full, the recent or the light
one, in this order. Nothing newer than that is ever deleted: a checkpoint that turns out to be damaged is moved to
checkpoints/damaged/, and one of another run, which its manifest tells by the run's id, to checkpoints/foreign/.
"""

import contextlib
import dataclasses
import itertools
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxrl_vis import processes, streams
from jaxrl_vis.errors import RequestError, StorageError
from jaxrl_vis.files import read_json
from jaxrl_vis.run import hush, sums
from jaxrl_vis.run.arrays import as_saved, check_structure, describe, host_specs, is_intact, rebuild, to_host, to_save
from jaxrl_vis.run.manifest import FILE, READABLE, SCHEMA, is_manifest, progress_in
from jaxrl_vis.run.metrics import RUN_ID
from jaxrl_vis.run.recent import ANY_RUN, Recent, Unusable
from jaxrl_vis.types import LoopState, TrainState

if TYPE_CHECKING:  # orbax takes a fifth of the time that this package does to import: whatever uses it imports it
    import orbax.checkpoint as ocp

LIGHT, FULL, RECENT = "light", "full", "recent"
_PRECEDENCE = (FULL, RECENT, LIGHT)  # for a run that goes on, of those that are equally new
_KEPT = 2
_TIMEOUT_S = 10**9
DAMAGED, FOREIGN = "damaged", "foreign"


class _Damaged(Exception):
    """This checkpoint cannot be trusted. The message says why, in a few words."""


@dataclasses.dataclass(frozen=True)
class Restored:
    """Contents of a checkpoint.

    Attributes:
        tier: `LIGHT`, `FULL` or `RECENT`.
        iteration: Iterations that the run had done.
        train: The learner, [S, ...].
        loop: Everything; None from the light tier.
        progress: What the caller gave to be remembered.
    """

    tier: str
    iteration: int
    train: TrainState
    loop: LoopState | None
    progress: dict[str, Any]


def _free(path: Path) -> Path:
    """Returns a path that nothing has yet: ``path`` itself, or the first of path-2, path-3, ... that is free."""
    numbered = (path.with_name(f"{path.name}-{number}") for number in itertools.count(2))
    return next(choice for choice in itertools.chain([path], numbered) if not choice.exists())


def rest_of(loop: LoopState) -> dict[str, Any]:
    """A loop state without its learner: what a full checkpoint holds more than a light one."""
    return {"replay": loop.replay, "key": loop.key, "iteration": loop.iteration}


class Checkpoints:
    """The checkpoints of one run. While it is open, orbax's own log is silent: what goes wrong is raised, and told in one line.

    Args:
        folder: Where both tiers lie; made when something is saved.
        say: Called with one line about each checkpoint that cannot be used.
        read_only: Promise to save nothing: nothing is created or cleaned up.

    Attributes:
        run_id: Of the run, None for one of an earlier version: checkpoints of others are not there as far as this class goes,
            but for `set_foreign_aside`. `ANY_RUN`: whatever there is.
    """

    def __init__(
        self,
        folder: Path,
        say: Callable[[str], None] = streams.say,
        read_only: bool = False,
        run_id: str | None = ANY_RUN,
    ):
        self._folder = folder.absolute()  # orbax refuses relative names
        self._say = say
        self._read_only = read_only
        self.recent = Recent(self._folder / RECENT, say)
        self.run_id = run_id
        self._managers: dict[str, ocp.CheckpointManager] = {}
        self._reported: set[tuple[str, int]] = set()  # damaged ones
        self._unsummed: set[tuple[str, int]] = set()  # saved, perhaps in the background still, and without `sums`
        self._unsilence: Callable[[], None] | None = None

    @property
    def run_id(self) -> str | None:
        """See the class."""
        return self.recent.run_id

    @run_id.setter
    def run_id(self, run_id: str | None) -> None:
        self.recent.run_id = run_id

    def _manager(self, tier: str) -> "ocp.CheckpointManager":
        import orbax.checkpoint as ocp
        from orbax.checkpoint.checkpoint_managers import LatestN
        from orbax.checkpoint.options import AsyncOptions

        if tier not in self._managers:
            if self._unsilence is None:
                self._unsilence = hush.silence_orbax()
            # orbax measures its timeouts with the computer's clock: where that is set meanwhile, a good save would be given up.
            # A process alone waits for its own disk, however long; of several, one that hangs must be noticed.
            patient = AsyncOptions(timeout_secs=_TIMEOUT_S, create_directories_asynchronously=False)
            options = ocp.CheckpointManagerOptions(
                async_options=None if processes.are_several() else patient,
                preservation_policy=None if self._read_only else LatestN(_KEPT),
                cleanup_tmp_directories=not self._read_only,
                read_only=self._read_only,
                create=not self._read_only,
            )
            self._managers[tier] = ocp.CheckpointManager(self._folder / tier, options=options)
        return self._managers[tier]

    def iterations(self, tier: str) -> list[int]:
        """Iterations of which ``tier`` has a checkpoint of this run, ascending; damaged ones included."""
        if tier == RECENT:
            return self.recent.iterations()
        return [iteration for iteration, is_ours in self._there(tier) if is_ours]

    def _there(self, tier: str) -> list[tuple[int, bool]]:
        """Iteration of each checkpoint of a tier, ascending, and whether it is of this run."""
        folder = self._folder / tier
        if not folder.is_dir():
            return []
        names = [entry.name for entry in folder.iterdir() if entry.name.isdecimal() and entry.is_dir()]
        return sorted((int(name), self._is_ours(folder / name)) for name in names)

    def _is_ours(self, checkpoint: Path) -> bool:
        """Returns whether the manifest of a checkpoint says so; one that cannot be read is damaged, and may well be ours."""
        try:
            manifest = read_json(checkpoint / FILE)
        except RequestError:
            return True
        return self.run_id in (ANY_RUN, manifest.get(RUN_ID))

    def newest(self) -> int | None:
        """The newest iteration that a run could go on from; None where there is none."""
        return max((iteration for tier in _PRECEDENCE for iteration in self.iterations(tier)), default=None)

    def save_light(self, iteration: int, train: TrainState, progress: dict[str, Any]) -> None:
        """Copies the learner to the host and writes it in the background; ``train`` may be donated as soon as this returns.

        Args:
            iteration: Iterations done.
            train: The learner, [S, ...].
            progress: Anything that JSON can hold.
        """
        self._save(LIGHT, iteration, {"train": to_save(train, copy=True)}, progress)

    def save_full(self, iteration: int, loop: LoopState, progress: dict[str, Any]) -> None:
        """Writes everything, and returns when it is on the disk: a second copy of the replay would need memory for two."""
        items = {"train": to_save(loop.train, copy=False), "rest": to_save(rest_of(loop), copy=False)}
        self._save(FULL, iteration, items, progress)
        self.wait()

    def _save(self, tier: str, iteration: int, items: dict[str, Any], progress: dict[str, Any]) -> None:
        import orbax.checkpoint as ocp

        described = {name: describe(arrays) for name, arrays in items.items()}
        whose = {} if self.run_id in (None, ANY_RUN) else {RUN_ID: self.run_id}
        manifest = {"schema": SCHEMA, **whose, "iteration": iteration, "items": described, "progress": progress}
        arguments: dict[str, Any] = {name: ocp.args.StandardSave(arrays) for name, arrays in items.items()}
        arguments["manifest"] = ocp.args.JsonSave(manifest)
        if processes.are_several():
            self.wait()  # of two tiers that are written at the same time, processes would take one for the other
        with self._writing(tier):
            manager = self._manager(tier)
            self._wait(tier)
            if processes.any_of(iteration in self.iterations(tier)):  # orbax would quietly keep the old one
                manager.delete(iteration)
            if not manager.save(iteration, args=ocp.args.Composite(**arguments), force=True):
                raise RuntimeError(f"checkpoint {tier}/{iteration} was not written")
            self._unsummed.add((tier, iteration))

    def _wait(self, tier: str) -> None:
        """Returns when the tier is on the disk, with the checksums of its files."""
        self._managers[tier].wait_until_finished()
        for saved in [saved for saved in self._unsummed if saved[0] == tier]:
            folder = self._folder / tier / str(saved[1])
            if processes.is_first() and folder.is_dir():
                sums.write_sums(folder)
            self._unsummed.discard(saved)

    @contextlib.contextmanager
    def _writing(self, tier: str) -> Iterator[None]:
        """Turns whatever orbax raises when it cannot write into a `StorageError`."""
        try:
            yield
        except Exception as error:
            # A manager whose writing failed in the background reports it again and again: start with a new one. Its threads go
            # on failing for a while, so from here on the process stays silent about them.
            self._managers.pop(tier, None)
            self._unsilence = hush.stay_silent
            text = " ".join(str(error).split())
            shown = "no space left on the device" if "No space left" in text else f"{type(error).__name__}: {text[:160]}"
            raise StorageError(f"cannot write a {tier} checkpoint into {self._folder} ({shown})") from error

    def wait(self) -> None:
        """Returns when everything is on the disk.

        Raises:
            StorageError: Something could not be written.
        """
        for tier in list(self._managers):
            with self._writing(tier):
                self._wait(tier)

    def close(self) -> None:
        """`wait`, then lets go of orbax's threads."""
        for tier, manager in list(self._managers.items()):
            with self._writing(tier):
                self._wait(tier)
                manager.close()
        self._managers.clear()
        if self._unsilence is not None:
            self._unsilence()
            self._unsilence = None

    def retire_full(self, has_ended: bool = False) -> None:
        """Deletes full checkpoints that are older than a light one which is safely on the disk: nothing goes on from them.

        Recent states that are not kept up to date any more go likewise.

        Args:
            has_ended: Delete those that are as new, too: the run has come to its end.
        """
        newest = max(self.iterations(LIGHT), default=-1)
        if processes.is_first():
            self.recent.retire(newest)
        for iteration in self.iterations(FULL):
            if iteration < newest + has_ended:
                self._forget(FULL)
                if processes.is_first():
                    shutil.rmtree(self._folder / FULL / str(iteration), ignore_errors=True)

    def set_aside_after(self, iteration: int) -> list[Path]:
        """Moves checkpoints after ``iteration``, from which no run can go on, to checkpoints/damaged/.

        Returns:
            Where they are now.
        """
        tiers = {tier: self.iterations(tier) for tier in (LIGHT, FULL, RECENT)}
        later = {tier: [found for found in iterations if found > iteration] for tier, iterations in tiers.items()}
        return self._move(later, DAMAGED)

    def set_foreign_aside(self) -> list[Path]:
        """Moves checkpoints of other runs to checkpoints/foreign/: they would be counted, and ours deleted for them.

        Returns:
            Where they are now.
        """
        foreign = {tier: [found for found, is_ours in self._there(tier) if not is_ours] for tier in (LIGHT, FULL)}
        moved = self._move(foreign, FOREIGN)
        recent = _free(self._folder / FOREIGN / RECENT)
        if processes.is_first() and self.recent.set_foreign_aside(recent):
            moved.append(recent)
        return moved

    def _move(self, iterations: dict[str, list[int]], folder: str) -> list[Path]:
        moved = []
        for tier, iteration in [(tier, iteration) for tier, found in iterations.items() for iteration in found]:
            self._forget(tier)
            moved.append(_free(self._folder / folder / f"{tier}-{iteration}"))
            if processes.is_first():
                moved[-1].parent.mkdir(exist_ok=True)
                if tier == RECENT:
                    self.recent.set_aside(iteration, moved[-1])
                    continue
                (self._folder / tier / str(iteration)).rename(moved[-1])
        return moved

    def _forget(self, tier: str) -> None:
        """Closes the tier's manager, which remembers what it has seen; the next use makes a new one."""
        if tier in self._managers:
            self._managers.pop(tier).close()

    def restore_for_resume(self, template: LoopState) -> Restored | None:
        """The newest good checkpoint of any tier, full before recent before light; None where there is none.

        Args:
            template: Shapes and types of the loop state, as `jax.eval_shape` makes them.

        Raises:
            RequestError: A checkpoint has another structure.
        """
        return self._newest_good(template, with_rest=True)

    def restore_train(self, template: LoopState, iteration: int | None = None) -> Restored | None:
        """The learner alone, of the newest good checkpoint of either tier, or of ``iteration``. See `restore_for_resume`."""
        return self._newest_good(template, with_rest=False, only=iteration)

    def manifest(self, tier: str, iteration: int) -> dict[str, Any]:
        """Manifest of a checkpoint: ``schema``, ``iteration``, ``items`` (`arrays.describe`), and ``progress``.

        Raises:
            RequestError: It is damaged, or of another schema.
        """
        with self._told(tier, iteration):
            return self._manifest(tier, iteration)

    def restore(self, tier: str, manifest: dict[str, Any], template: LoopState) -> Restored:
        """One checkpoint with all that it holds, compared with the checksums in its manifest.

        Raises:
            RequestError: It is damaged, or has another structure.
        """
        iteration = manifest["iteration"]
        with self._told(tier, iteration):
            return self._restored(tier, iteration, template, tier == FULL, manifest)

    @contextlib.contextmanager
    def _told(self, tier: str, iteration: int) -> Iterator[None]:
        try:
            yield
        except _Damaged as damage:
            raise RequestError(f"checkpoint {tier}/{iteration} is damaged ({damage})") from None

    def _newest_good(self, template: LoopState, with_rest: bool, only: int | None = None) -> Restored | None:
        # The light one is smaller; and a recent one may vanish while somebody reads it to play with what it has learned.
        tiers = _PRECEDENCE if with_rest else (LIGHT, FULL)
        found = [(iteration, tier) for tier in tiers for iteration in self.iterations(tier) if only in (None, iteration)]
        for iteration, tier in sorted(found, key=lambda item: (-item[0], tiers.index(item[1]))):
            try:
                if tier == RECENT:
                    return self._restore_recent(iteration, template)
                return self._restore(tier, iteration, template, with_rest and tier == FULL)
            except _Damaged as damage:
                if (tier, iteration) not in self._reported:
                    self._say(f"checkpoint {tier}/{iteration} is damaged ({damage}); trying the one before")
                self._reported.add((tier, iteration))
        return None

    def _restore_recent(self, iteration: int, template: LoopState) -> Restored:
        try:
            loop, progress = self.recent.restore(iteration, template)
        except Unusable as error:
            raise _Damaged(str(error)) from None
        return Restored(RECENT, iteration, loop.train, loop, progress)

    def _manifest(self, tier: str, iteration: int) -> dict[str, Any]:
        import orbax.checkpoint as ocp

        manifest = self._read(tier, iteration, {"manifest": ocp.args.JsonRestore()})["manifest"]
        if not is_manifest(manifest):
            raise _Damaged("its manifest is incomplete")
        if manifest["schema"] not in READABLE:
            where = self._folder / tier / str(iteration)
            raise RequestError(f"{where} is of schema {manifest['schema']}, not {SCHEMA}: use the version that wrote it")
        return manifest

    def _restore(self, tier: str, iteration: int, template: LoopState, with_rest: bool) -> Restored:
        return self._restored(tier, iteration, template, with_rest, self._manifest(tier, iteration))

    def _restored(self, tier: str, iteration: int, template: LoopState, with_rest: bool, manifest: dict[str, Any]) -> Restored:
        import orbax.checkpoint as ocp

        templates = {"train": template.train} | ({"rest": rest_of(template)} if with_rest else {})
        specs = {name: host_specs(tree) for name, tree in templates.items()}
        where = self._folder / tier / str(iteration)
        for name, spec in specs.items():
            check_structure(where, manifest["items"].get(name, {}), spec)
            specs[name] = {leaf: as_saved(manifest["items"][name][leaf][0], expected) for leaf, expected in spec.items()}
        read = self._read(tier, iteration, {name: ocp.args.StandardRestore(spec) for name, spec in specs.items()})
        trees = {}
        for name, tree in templates.items():
            for leaf_name, array in to_host(read[name], copy=False).items():
                if not is_intact(array, manifest["items"][name][leaf_name]):
                    raise _Damaged(f"wrong checksum of {leaf_name}")
            trees[name] = rebuild(tree, read[name])
        loop = LoopState(train=trees["train"], **trees["rest"]) if with_rest else None
        return Restored(tier, iteration, trees["train"], loop, progress_in(manifest))

    def _read(self, tier: str, iteration: int, arguments: dict[str, Any]) -> Any:
        import orbax.checkpoint as ocp

        try:
            manager = self._manager(tier)  # first, for `hushed` puts back the hooks that it finds
            with hush.hushed():
                return manager.restore(iteration, args=ocp.args.Composite(**arguments))
        # orbax and tensorstore report damage as whatever exception they run into, plain Exception included.
        except Exception as error:
            self._unsilence = hush.stay_silent  # as after a failed write: threads of this reading may complain later
            text = " ".join(str(error).split())[:80]
            raise _Damaged(f"{type(error).__name__}: {text}") from None
