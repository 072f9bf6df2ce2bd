"""Up-to-date state of a run on a CPU, for resuming after a kill: every frame is written only once.

    checkpoints/recent/<iteration>.state     learner, keys, iteration, and the checksums of its rollouts
    checkpoints/recent/<iteration>.rollout   the episodes collected in this iteration

A rollout stays in the replay until the ring buffer overwrites it, so a state needs several files of earlier iterations and one
new file: some milliseconds, whereas a full checkpoint writes the whole replay. It is used on a CPU, where reading the arrays is
free, for replays of moderate size: `is_cheap`.

Nothing is synced to the disk. A killed process leaves what it has written; a power cut may not, which the checksums detect, and
the run then resumes from a light or a full checkpoint, which are synced. Files are written atomically. The newest two states
are kept.
"""

import contextlib
import json
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.learner.memory.replay import num_bytes
from jaxrl_vis.run.storage.arrays import Arrays, check_structure, describe, host_specs, is_intact, rebuild, to_host
from jaxrl_vis.run.storage.metrics import RUN_ID
from jaxrl_vis.types import LoopState, ReplayState

SCHEMA = 1
ANY_RUN = "*"
_KEPT = 2
_MAX_BYTES = 2**30  # maximum size of a replay
_FRACTION = 0.03  # maximum fraction of the time spent on saving: about every iteration of `cpu` on two cores
_EPISODES = "replay.episodes."


def is_cheap(replay: ReplayState) -> bool:
    """Return True if a replay (arrays or shapes) is cheap to keep up to date in files, in time and disk space."""
    return jax.default_backend() == "cpu" and num_bytes(replay) <= _MAX_BYTES


class Unusable(Exception):
    """Damaged checkpoint of any tier, or state with a damaged rollout. The message is a short reason."""


class Recent:
    """Recent states of one run.

    Args:
        folder: Folder of the states; created by the first save.
        echo: Called with one line when there is no more space for them.

    Attributes:
        run_id: Id of the run: other runs' states are ignored, except by `set_aside_foreign_runs`. `ANY_RUN`:
            all states.
    """

    def __init__(self, folder: Path, echo: Callable[[str], None]):
        self._folder, self._echo = folder, echo
        self.run_id = ANY_RUN
        self._rollouts: dict[int, int] = {}  # rollouts known to exist, and their checksums
        self._cost, self._saved_at, self._is_off = 0.0, -np.inf, False

    def is_due(self, ignore_time: bool) -> bool:
        """Return True if enough time has passed since the last save for saving to take only a small fraction of it.

        Args:
            ignore_time: Whether to ignore the time since the last save.
        """
        return not self._is_off and (ignore_time or time.monotonic() - self._saved_at >= self._cost / _FRACTION)

    def iterations(self) -> list[int]:
        """Return the iterations of this run's states, ascending, including damaged ones."""
        return sorted(iteration for iteration in _numbers(self._folder, "state") if self._is_ours(iteration))

    def _is_ours(self, iteration: int) -> bool:
        """Return True if a state's header has this run's id; one that cannot be read is damaged, and may be this run's."""
        try:
            return self.run_id in (ANY_RUN, self._header(iteration).get(RUN_ID))
        except Unusable:
            return True

    def set_aside_foreign_runs(self, to: Path) -> bool:
        """Move the folder with all states to ``to`` if one of them is of another run; return True if so."""
        is_foreign = any(not self._is_ours(iteration) for iteration in _numbers(self._folder, "state"))
        if is_foreign:
            to.parent.mkdir(exist_ok=True)
            self._folder.rename(to)
        return is_foreign

    def save(
        self, iteration: int, loop: LoopState, num_envs: int, progress: dict[str, Any], start_time: float | None = None
    ) -> None:
        """Write a state and its missing rollouts; if there is no space, report it and disable further saving.

        Args:
            iteration: Iterations completed.
            loop: The state, on one device.
            num_envs: E, episodes that one iteration adds to the replay.
            progress: A JSON value.
            start_time: Start of the work for it, checks included (`time.monotonic`); None: now.
        """
        self._saved_at = time.monotonic() if start_time is None else start_time
        try:
            self._write(iteration, loop, num_envs, progress)
        except OSError as error:
            self._is_off = True
            self._drop_unfinished()
            self._echo(
                f"the replay is not kept up to date any more ({error.strerror or type(error).__name__}): "
                "if this process is killed, the run goes on without it"
            )
        self._cost = time.monotonic() - self._saved_at

    def _write(self, iteration: int, loop: LoopState, num_envs: int, progress: dict[str, Any]) -> None:
        for folder in (self._folder.parent, self._folder):  # but not the run folder, which may have been moved
            folder.mkdir(exist_ok=True)
        replay = to_host({"replay": loop.replay}, copy=False)
        episodes = {name: array for name, array in replay.items() if name.startswith(_EPISODES)}
        arrays = to_host({"train": loop.train, "key": loop.key, "iteration": loop.iteration}, copy=False)
        arrays["replay.size"] = replay["replay.size"]
        num_rollouts = next(iter(episodes.values())).shape[1] // num_envs
        stored = int(arrays["replay.size"].max()) // num_envs
        rollouts = {}
        for number in range(iteration - stored + 1, iteration + 1):
            if number not in self._rollouts:
                start = (number - 1) % num_rollouts * num_envs
                self._rollouts[number] = self._write_rollout(
                    number, {name: array[:, start : start + num_envs] for name, array in episodes.items()}
                )
            rollouts[number] = self._rollouts[number]
        header = {
            **{"schema": SCHEMA, RUN_ID: self.run_id, "iteration": iteration, "items": describe(arrays)},
            "episodes": {name: [list(array.shape), str(array.dtype)] for name, array in episodes.items()},
            **{"rollouts": {str(number): checksum for number, checksum in rollouts.items()}, "progress": progress},
        }
        text = json.dumps(header)
        with _appearing(self._path(iteration, "state")) as file:
            file.write(f"{zlib.crc32(text.encode()):08x} {text}\n".encode())
            for array in arrays.values():
                file.write(_bytes(array))
        self._remove_stale_files()

    def _write_rollout(self, number: int, arrays: Arrays) -> int:
        """Write the episodes of one rollout, arrays [S, E, ...] one after the other; return their checksum."""
        checksum = 0
        with _appearing(self._path(number, "rollout")) as file:
            for array in arrays.values():
                contents = _bytes(array)
                checksum = zlib.crc32(contents, checksum)
                file.write(contents)
        return checksum

    def _remove_stale_files(self) -> None:
        """Delete all but the newest states, and older rollouts that these do not need."""
        for number in self.iterations()[:-_KEPT]:
            self._path(number, "state").unlink(missing_ok=True)
        first = min(self._rollouts, default=0)
        with contextlib.suppress(Unusable, IndexError):
            first = min(self._header(self.iterations()[0])["rollouts"], key=int)
        for number in _numbers(self._folder, "rollout"):
            if number < int(first):
                self._path(number, "rollout").unlink(missing_ok=True)
        self._rollouts = {number: checksum for number, checksum in self._rollouts.items() if number >= int(first)}

    def manifest(self, iteration: int) -> dict[str, Any]:
        """Return the manifest of a state: ``iteration``, ``items`` (`arrays.describe`), ``progress``, and the run's id.

        Raises:
            Unusable: The state is damaged.
        """
        return self._header(iteration)

    def restore(self, iteration: int, template: LoopState) -> tuple[LoopState, dict[str, Any]]:
        """Restore a state; return it, and the progress that was saved with it.

        Args:
            iteration: One of `iterations`.
            template: Shapes and dtypes of the loop state.

        Raises:
            Unusable: The state is damaged, or a rollout of it is missing or damaged.
            RequestError: The state has another structure.
        """
        header, path = self._header(iteration), self._path(iteration, "state")
        tree = {name: getattr(template, name) for name in ("train", "replay", "key", "iteration")}
        specs = host_specs(tree)
        check_structure(path, header["items"] | header["episodes"], specs)
        contents = self._read(path)
        offset = contents.index(b"\n") + 1
        arrays = {}
        for name, described in header["items"].items():  # in the order in which they were written
            arrays[name], offset = _array(contents, offset, specs[name].shape, specs[name].dtype)
            if not is_intact(arrays[name], described):
                raise Unusable(f"wrong checksum of {name}")
        episodes = {name: np.zeros(shape, specs[name].dtype) for name, (shape, _) in header["episodes"].items()}
        self._read_rollouts(header["rollouts"], episodes)
        # Copies, because buffers owned by NumPy cannot be donated.
        loop = LoopState(**rebuild(tree, {name: jnp.array(array) for name, array in (arrays | episodes).items()}))
        return loop, header["progress"]

    def _read_rollouts(self, checksums: dict[str, int], episodes: Arrays) -> None:
        """Fill ``episodes``, arrays [S, N, ...], from the rollouts' files in place; raise `Unusable` if one is damaged."""
        num_episodes = next(iter(episodes.values())).shape[1]
        for number, checksum in checksums.items():
            contents = self._read(self._path(int(number), "rollout"))
            if zlib.crc32(contents) != checksum:
                raise Unusable(f"wrong checksum of rollout {number}")
            size = sum(array.nbytes for array in episodes.values()) // num_episodes  # of one episode per seed
            num_envs = len(contents) // size
            start, offset = (int(number) - 1) % (num_episodes // num_envs) * num_envs, 0
            for array in episodes.values():
                shape = (len(array), num_envs, *array.shape[2:])
                array[:, start : start + num_envs], offset = _array(contents, offset, shape, array.dtype)

    def resume_from(self, iteration: int | None) -> None:
        """Prepare for resuming from the state of an iteration, and delete later rollouts; if it is None, delete all files."""
        if iteration is None:
            self.clear()
            return
        self._rollouts = {int(number): checksum for number, checksum in self._header(iteration)["rollouts"].items()}
        for number in _numbers(self._folder, "rollout"):
            if number > iteration:
                self._path(number, "rollout").unlink(missing_ok=True)

    def _drop_unfinished(self) -> None:
        """Delete files that belong to no state. The states stay: a newer one may never fit."""
        newest = max(self.iterations(), default=0)
        with contextlib.suppress(OSError):
            for file in self._folder.iterdir():
                if file.suffix == ".tmp" or (file.suffix == ".rollout" and file.stem.isdigit() and int(file.stem) > newest):
                    file.unlink(missing_ok=True)

    def retire(self, newest: int) -> None:
        """Delete everything if no more states are saved and a checkpoint of iteration ``newest`` has overtaken them."""
        if self._is_off and newest >= max(self.iterations(), default=0):
            self.clear()

    def clear(self) -> None:
        """Delete all states: a full checkpoint replaces them, or the run has ended."""
        self._rollouts = {}
        with contextlib.suppress(OSError):
            for file in self._folder.iterdir():
                if file.suffix in (".state", ".rollout", ".tmp"):
                    file.unlink(missing_ok=True)
            self._folder.rmdir()

    def set_aside(self, iteration: int, to: Path) -> None:
        """Move the state file of an iteration to the path ``to``."""
        self._path(iteration, "state").replace(to)

    def _header(self, iteration: int) -> dict[str, Any]:
        try:
            with self._path(iteration, "state").open("rb") as file:
                checksum, _, text = file.readline().rstrip(b"\n").partition(b" ")
            if int(checksum, 16) != zlib.crc32(text):
                raise Unusable("wrong checksum of its first line")
            header = json.loads(text)
        except (OSError, ValueError) as error:
            raise Unusable(f"{type(error).__name__}: its first line") from None
        if header["schema"] != SCHEMA:
            raise Unusable(f"it is of schema {header['schema']}, not {SCHEMA}")
        return header

    def _read(self, path: Path) -> bytes:
        try:
            return path.read_bytes()
        except OSError as error:
            raise Unusable(f"{path.name}: {error.strerror or type(error).__name__}") from None

    def _path(self, iteration: int, extension: str) -> Path:
        return self._folder / f"{iteration}.{extension}"


def foreign_names(folder: Path) -> list[str]:
    """Return the names of foreign files in a folder of recent states; empty if there is no folder."""
    kinds = (".state", ".rollout")
    entries = folder.iterdir() if folder.is_dir() else ()
    bare = {entry.name: Path(entry.name.removesuffix(".tmp")) for entry in entries}
    return sorted(name for name, path in bare.items() if not (path.suffix in kinds and path.stem.isdigit()))


def _numbers(folder: Path, extension: str) -> list[int]:
    try:
        return [int(file.stem) for file in folder.iterdir() if file.suffix == f".{extension}" and file.stem.isdigit()]
    except OSError:
        return []


@contextlib.contextmanager
def _appearing(path: Path) -> Iterator[IO[bytes]]:
    """Open a file that is renamed into place once complete. It is not synced to the disk, see the module."""
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("wb") as file:
        yield file
    temporary.replace(path)


def _bytes(array: np.ndarray) -> memoryview:
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8).data


def _array(contents: bytes, offset: int, shape: tuple[int, ...], dtype: Any) -> tuple[np.ndarray, int]:
    """Return the array of the given shape and dtype at an offset, and the offset of its end; raise `Unusable` if cut off."""
    count = int(np.prod(shape))
    end = offset + count * np.dtype(dtype).itemsize
    if end > len(contents):
        raise Unusable("it ends too early")
    return np.frombuffer(contents, dtype, count, offset).reshape(shape), end
