"""Run folder: its files, their configuration, and checks of the permission to write there.

The files:

    config.json     schema, id, versions, device, git revision, configuration  metrics.jsonl   see `metrics`
    checkpoints/    see `checkpoint`      nonfinite/   states with non-finite numbers      curve.png   video.gif
    run.lock        while a process writes here, see `lock`      tensorboard/, wandb/, wandb.json   see `loggers`
    processes.jsonl     see `goodput`

A run has a random id, which it keeps when resumed. Every row of metrics and every checkpoint includes it, and nothing with
another id is resumed, counted or deleted.
"""

import contextlib
import dataclasses
import json
import secrets
import shlex
import shutil
from pathlib import Path
from typing import Any

from jaxrl_vis.config import RESUMABLE, Config, Mark, config_from_dict, marked, weighting_options
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import provenance
from jaxrl_vis.host.files import check_path, is_temporary, read_json, write_atomically
from jaxrl_vis.run.storage.lock import FILE_NAME as LOCK_NAME
from jaxrl_vis.run.storage.lock import FolderGoneError, HeldLock
from jaxrl_vis.run.storage.metrics import RUN_ID, read_rows

SCHEMA = 2

CHECKPOINT_FOLDERS = ("light", "full", "best", "recent", "damaged", "replaced")
"""Subfolders of checkpoints/ that are deleted with their run; foreign/, with those of other runs, is kept."""

_UNFINISHED = "orbax-checkpoint-tmp"  # in the name of a checkpoint that is being written

LOGGER_FOLDERS, WANDB_STATE = ("tensorboard", "wandb"), "wandb.json"
"""Files and folders that `loggers` write into a run folder."""

EXPORT_FOLDER = "export"
"""Folder of exported policies (`jaxrl_vis.run.exported`)."""


def learner_name(config: Config) -> str:
    """Return the reward method, after the algorithm if that is not DDPG, or `contrastive`, which has no rewards."""
    algorithm, method = config.run.algorithm, config.reward.method
    return {"ddpg": method, "contrastive": algorithm}.get(algorithm, f"{algorithm} {method}")


def default_folder(config: Config) -> Path:
    """Return ``runs/<env>-<learner>-<preset>-seed<first>`` or ``...-seeds<first>to<last>``, below the working directory.

    The colon of ``module:Name`` becomes a hyphen, because Windows does not allow it in file names.
    """
    last = config.run.seed + config.run.seeds - 1
    seeds = f"seed{config.run.seed}" if config.run.seeds == 1 else f"seeds{config.run.seed}to{last}"
    name = f"{config.environment.env}-{learner_name(config)}-{config.run.preset}-{seeds}"
    return Path("runs") / name.replace(":", "-").replace(" ", "-")


def check_resumable(path: Path, resume: bool) -> None:
    """Raise a `RequestError` if ``path`` cannot be a run folder, or if a run is to be resumed in a missing folder."""
    _check_run_path(path)
    if resume and not path.exists():
        raise RequestError(f"nothing to resume: there is no folder {path}; leave out --resume to start a run there")


def _check_run_path(path: Path) -> None:
    """Raise a `RequestError` if ``path`` cannot be a run folder: orbax accepts only names in UTF-8."""
    check_path(path / "config.json")
    try:
        str(path.resolve()).encode()
    except UnicodeEncodeError as error:
        raise RequestError(
            f"{str(path)!r} cannot be a run folder, as its whole name is not UTF-8: rename it, or choose another --run-dir "
            "(where that name looks right elsewhere, the locale is not UTF-8: LC_ALL=C.UTF-8)"
        ) from error


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Paths of a run's files; see the module.

    Attributes:
        path: The folder itself.
    """

    path: Path

    @property
    def config(self) -> Path:
        """Path of the run's configuration, with versions and device."""
        return self.path / "config.json"

    @property
    def metrics(self) -> Path:
        """Path of the metrics, one line per seed and evaluation."""
        return self.path / "metrics.jsonl"

    @property
    def processes(self) -> Path:
        """Path of the number of iterations that each process has begun, one line per process."""
        return self.path / "processes.jsonl"

    @property
    def checkpoints(self) -> Path:
        """Path of the folder with the tiers of checkpoints."""
        return self.path / "checkpoints"

    @property
    def nonfinite(self) -> Path:
        """Path of the folder with dumped states that have non-finite numbers."""
        return self.path / "nonfinite"

    @property
    def curve(self) -> Path:
        """Path of the plot of success and distance against environment steps."""
        return self.path / "curve.png"

    @property
    def video(self) -> Path:
        """Path of the video of the trained policy's episodes."""
        return self.path / "video.gif"

    def rows(self) -> list[dict[str, Any]]:
        """Read this run's rows of metrics.jsonl, in order of iteration, without damaged ones.

        If config.json cannot be read, these are the rows of all runs.

        Raises:
            RequestError: metrics.jsonl cannot be read.
        """
        rows = read_rows(self.metrics)
        try:
            run_id = read_run_id(self.path)
        except RequestError:
            return rows
        return [row for row in rows if row.get(RUN_ID) == run_id]

    def check_place(self, lock: HeldLock) -> None:
        """Check that the folder is still in place since it was locked, before the run starts.

        Args:
            lock: The lock of the folder, held by this process.

        Raises:
            FolderGoneError: It was moved, deleted or taken over.
        """
        lock.check()
        if not lock.is_in_place():
            raise FolderGoneError(_where_gone(self.path, lock.current_path(), "before the run began"))

    def check_ownership(self, run_id: str, lock: HeldLock) -> None:
        """Check that the folder still belongs to a run, before writing into it.

        Args:
            run_id: Id of the run.
            lock: The lock of the folder, held by this process.

        Raises:
            FolderGoneError: It was moved, deleted or taken over.
        """
        lock.check()
        try:
            is_ours = lock.is_in_place() and read_run_id(self.path) == run_id
        except RequestError:  # an unreadable file, temporarily or permanently, is no reason to stop
            is_ours = self.config.exists()
        if not is_ours:
            when = "while the run wrote there, and what was trained since its last checkpoint is lost"
            raise FolderGoneError(_where_gone(self.path, lock.current_path(), when))

    def remove_remains(self, run_id: str) -> None:
        """Delete files that checkpoint threads have recreated in a folder after it was moved or deleted.

        A folder with other contents is left alone.

        Args:
            run_id: Id of the run: a checkpoint of it may even have become complete.
        """
        with contextlib.suppress(OSError):
            remains = [_UNFINISHED in path.name or _is_remainder(path, run_id) for path in self.checkpoints.glob("*/*")]
            if all(remains) and [entry.name for entry in self.path.iterdir()] == [self.checkpoints.name]:
                shutil.rmtree(self.path)

    def check(self, config: Config, resume: bool = False, overwrite: bool = False) -> bool:
        """Check whether this folder may be used for ``config``. Changes nothing.

        Args:
            config: The requested configuration.
            resume, overwrite: Whether an earlier run may be resumed, or deleted.

        Returns:
            True if an earlier run is to be resumed, False if a new run starts.

        Raises:
            RequestError: The folder has contents that are neither to be resumed nor overwritten, or a run with a conflicting
                configuration.
        """
        if resume and overwrite:
            raise RequestError("--resume and --overwrite contradict each other: give one of them")
        check_resumable(self.path, resume)
        if self.path.exists() and not self.path.is_dir():
            raise RequestError(f"{self.path} is a file: choose another --run-dir")
        try:
            names = [entry.name for entry in self.path.iterdir()] if self.path.exists() else []
        except OSError as error:
            raise RequestError(f"{self.path} cannot be looked into ({error.strerror}): choose another --run-dir") from error
        if all(name.startswith(LOCK_NAME) or is_temporary(name) for name in names):
            return False
        if not (resume or overwrite):
            raise RequestError(f"run folder {self.path} exists: --resume continues it, --overwrite starts again")
        if not self.config.exists():
            raise RequestError(f"{self.path} holds files but no config.json, so it is not a run: choose another --run-dir")
        if overwrite:
            return False
        _check_same(self.path, read_config(self.path), config)
        return True

    def open(self, config: Config, resume: bool = False, overwrite: bool = False, log: tuple[str, ...] = ()) -> bool:
        """Run `check`, then prepare the folder: with ``overwrite``, an earlier run's files are deleted, and nothing else.

        Call it last, after all other checks of the request.

        Args:
            config: Configuration to record in config.json.
            resume, overwrite: Whether to resume an earlier run, or to delete it.
            log: Names of the loggers to record.

        Returns:
            True if an earlier run is to be resumed.

        Raises:
            RequestError: As in `check`; or the folder is not writable, or something in it cannot be deleted.
        """
        is_resumed = self.check(config, resume, overwrite)
        run_id = read_run_id(self.path) if is_resumed else secrets.token_hex(16)
        if overwrite:
            self._delete_run()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            for file in self.path.iterdir():
                if is_temporary(file.name):  # of a killed process
                    file.unlink()
            write_atomically(self.config, json.dumps(_record(config, log, run_id), indent=2) + "\n")
        except OSError as error:
            raise RequestError(f"cannot write to {self.path} ({error.strerror}): choose another --run-dir") from error
        return is_resumed

    def _delete_run(self) -> None:
        """Delete a run's files, checkpoints first: after a failure, the rest is still a run.

        Raises:
            RequestError: Something cannot be deleted.
        """
        own = [self.checkpoints / name for name in CHECKPOINT_FOLDERS]
        if not self.checkpoints.is_dir():  # a file, or a dangling link; a link to a folder is the user's choice of a disk
            own.append(self.checkpoints)
        folders = [self.nonfinite, *(self.path / name for name in LOGGER_FOLDERS)]
        for path in (*own, *folders, self.metrics, self.processes, self.curve, self.video, self.path / WANDB_STATE):
            try:
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
                else:
                    path.unlink(missing_ok=True)
            except NotADirectoryError:  # checkpoints is a file
                continue
            except OSError as error:
                file = error.filename or path
                raise RequestError(
                    f"the run in {self.path} cannot be deleted: {file} stays ({error.strerror or error}). No new run was "
                    "started: delete it by hand, or choose another --run-dir"
                ) from error
        if not self.checkpoints.is_symlink():
            with contextlib.suppress(OSError):  # other files are in there, or it does not exist
                self.checkpoints.rmdir()


def _is_remainder(checkpoint: Path, run_id: str) -> bool:
    """Return True if a checkpoint left in a deleted run folder is unfinished, or belongs to the run ``run_id``."""
    manifest = checkpoint / "manifest"
    try:
        is_ours = not manifest.exists() or json.loads((manifest / "metadata").read_bytes()).get(RUN_ID) == run_id
        return is_ours and checkpoint.name.isdigit()
    except (OSError, ValueError, AttributeError):
        return False


def _where_gone(path: Path, current: Path | None, when: str) -> str:
    """Return a message about a run folder that is not in place.

    Args:
        path: The folder's path when it was locked.
        current: Its current path; None if it was deleted, or the path is unknown.
        when: Time of the loss, for the message.
    """
    if current is None:
        return f"{path} is gone: it was deleted, or moved away, {when}"
    is_there = current == path.resolve()
    resume = f"go on with --run-dir {shlex.quote(str(path if is_there else current))} --resume"
    if is_there:
        return f"{path / 'config.json'} is gone, or is that of another run: put it back, then {resume}"
    return f"{path} was moved to {current} {when}: {resume}"


def _record(config: Config, log: tuple[str, ...], run_id: str) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        RUN_ID: run_id,
        "preset": config.run.preset,
        "git_revision": provenance.revision(),
        "versions": provenance.versions(),
        "device": {**provenance.device_record(), "name": provenance.device_name()},
        "log": list(log),
        "config": dataclasses.asdict(config),
    }


def read_record(path: Path) -> dict[str, Any]:
    """Read a run's config.json.

    Raises:
        RequestError: There is no run in ``path``, or its config.json cannot be read.
    """
    file = RunFolder(path).config
    _check_run_path(path)
    if not file.exists():
        raise RequestError(f"no run in {path}: there is no config.json")
    record = read_json(file, hint="put back what it held, or train --overwrite")
    if record.get("schema") != SCHEMA:
        raise RequestError(
            f"{file} is not of schema {SCHEMA}: it was written by another version; use that, or train --overwrite"
        )
    return record


def read_run_id(path: Path) -> str:
    """Read the id of the run in ``path``.

    Raises:
        RequestError: There is no run in ``path``, or its config.json cannot be read.
    """
    run_id = read_record(path).get(RUN_ID)
    if not isinstance(run_id, str):
        raise RequestError(f"{RUN_ID} in {RunFolder(path).config} must be a word, not {run_id!r}: put back what it held")
    return run_id


def read_log(path: Path) -> tuple[str, ...]:
    """Read the names of the loggers of the run in ``path``; empty if there is no run.

    Raises:
        RequestError: config.json cannot be read, or its list of loggers is invalid.
    """
    check_path(path)
    log = read_record(path).get("log", []) if RunFolder(path).config.exists() else []
    if not isinstance(log, list) or not all(isinstance(name, str) for name in log):
        raise RequestError(f"log in {RunFolder(path).config} must be a list of words, not {log!r}: put back what it held")
    return tuple(log)


def read_config(path: Path) -> Config:
    """Read the configuration of the run in ``path``.

    Raises:
        RequestError: There is no run, or another version wrote it.
    """
    try:
        return config_from_dict(read_record(path).get("config", {}))
    except RequestError as error:
        raise RequestError(f"the run in {path} cannot be used: {error}") from error


def contradictions(saved: Config, config: Config, ignored: Mark = RESUMABLE) -> list[str]:
    """Describe the options in which ``config`` would learn differently from ``saved``.

    Args:
        saved: The configuration of a run.
        config: The requested configuration.
        ignored: Mark of the options that are not compared.
    """
    before, requested, but_for = saved.flat(), config.flat(), marked(ignored)
    # Options of weightings are not read if losses are neither weighted nor logarithmic.
    unread = weighting_options() if saved.auxiliary.weighting == config.auxiliary.weighting == "none" else ()
    return [
        f"{name} (saved {before[name]}, asked {requested[name]})"
        for name in sorted(before)
        if name not in but_for and name not in unread and before[name] != requested[name]
    ]


def _check_same(path: Path, saved: Config, config: Config) -> None:
    """Raise RequestError, naming the fields, if ``config`` would learn differently from ``saved``."""
    differences = contradictions(saved, config)
    if differences:
        raise RequestError(
            f"cannot resume {path}, its configuration differs: {'; '.join(differences)}; "
            "use the saved values, or choose another --run-dir"
        )
