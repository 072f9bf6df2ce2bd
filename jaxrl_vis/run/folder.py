"""The folder of a run: where its files lie, which configuration they belong to, and who may write there.

The files:

    config.json     schema, id, versions, device, git revision, configuration  metrics.jsonl   see `metrics`
    checkpoints/    see `checkpoint`      nonfinite/   what a run that went wrong held      curve.png   video.gif
    run.lock        while a process writes here, see `lock`      tensorboard/, wandb/, wandb.json   see `loggers`
    processes.jsonl     see `goodput`

A run has an id, which is drawn when it starts and stays when it is resumed. Every row of metrics and every checkpoint carries
it, and nothing that carries another one is resumed, counted or deleted. Runs of earlier versions have none, and keep none.
"""

import contextlib
import dataclasses
import json
import secrets
import shlex
import shutil
from collections.abc import Callable, Collection
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from jaxrl_vis import provenance
from jaxrl_vis.config import Config, config_from_dict
from jaxrl_vis.errors import RequestError
from jaxrl_vis.files import check_path, is_temporary, read_json, write_atomically
from jaxrl_vis.run.lock import FILE_NAME as LOCK_NAME
from jaxrl_vis.run.lock import FolderGoneError, Held, run_lock
from jaxrl_vis.run.metrics import RUN_ID, read_rows

SCHEMA = 1

CHECKPOINT_FOLDERS = ("light", "full", "recent", "damaged")
"""What `checkpoint` leaves in its folder."""

_UNFINISHED = "orbax-checkpoint-tmp"  # in the name of a checkpoint that is being written

LOGGER_FOLDERS, WANDB_STATE = ("tensorboard", "wandb"), "wandb.json"
"""What `loggers` leave in a run folder."""

MAY_CHANGE = (
    *("preset", "env_folder", "env_steps"),
    *("devices", "data_devices"),
    *("eval_interval", "eval_episodes", "checkpoint_interval", "full_checkpoint_interval"),
)
"""Fields that a resumed run may set anew: where its task lies now, how long to train, on how many devices, how often to look
and save. All others shape what is learned."""

_OF_WEIGHTINGS = (
    *(field.name for field in dataclasses.fields(Config) if field.name.startswith("weighting_")),
    *("aux_form", "actor_log"),
)
"""But for these, where losses are neither weighted nor logarithms: nothing reads them."""


def default_folder(config: Config) -> Path:
    """``runs/<env>-<method>-<preset>-seed<first>`` or ``...-seeds<first>to<last>``, below the working directory.

    The colon of ``module:Name`` becomes a hyphen: Windows allows none in the name of a file.
    """
    last = config.seed + config.seeds - 1
    seeds = f"seed{config.seed}" if config.seeds == 1 else f"seeds{config.seed}to{last}"
    return Path("runs") / f"{config.env.replace(':', '-')}-{config.method}-{config.preset}-{seeds}"


def check_there(path: Path, resume: bool) -> None:
    """Raises a `RequestError` where a run is to go on in a folder that is not there."""
    _check_run_path(path)
    if resume and not path.exists():
        raise RequestError(f"nothing to resume: there is no folder {path}; leave out --resume to start a run there")


def _check_run_path(path: Path) -> None:
    """Checks that a run can lie in ``path``: what writes checkpoints takes only names that are UTF-8."""
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
    """Names of the files of a run; see the module's image.

    Attributes:
        path: The folder itself.
    """

    path: Path

    @property
    def config(self) -> Path:
        """What was asked for, by which versions and on what device."""
        return self.path / "config.json"

    @property
    def metrics(self) -> Path:
        """One line per seed and evaluation."""
        return self.path / "metrics.jsonl"

    @property
    def processes(self) -> Path:
        """One line per process: how many iterations it has begun."""
        return self.path / "processes.jsonl"

    @property
    def checkpoints(self) -> Path:
        """The tiers of checkpoints."""
        return self.path / "checkpoints"

    @property
    def nonfinite(self) -> Path:
        """States with a NaN or an infinity in them."""
        return self.path / "nonfinite"

    @property
    def curve(self) -> Path:
        """Success and distance against environment steps."""
        return self.path / "curve.png"

    @property
    def video(self) -> Path:
        """A few episodes of the trained policy."""
        return self.path / "video.gif"

    def lock(self, say: Callable[[str], None] = print) -> AbstractContextManager[Held]:
        """See `run_lock`."""
        return run_lock(self.path, say)

    def rows(self) -> list[dict[str, Any]]:
        """The rows of metrics.jsonl that this run has written, in the order of their iterations, without damaged ones.

        Where config.json cannot be read, these are all rows.

        Raises:
            RequestError: metrics.jsonl cannot be read.
        """
        rows = read_rows(self.metrics)
        try:
            run_id = read_run_id(self.path)
        except RequestError:
            return rows
        return [row for row in rows if row.get(RUN_ID) == run_id]

    def check_place(self, held: Held) -> None:
        """Checks that the folder still lies where it was when it was locked, before a run begins there.

        Args:
            held: What holds the folder.

        Raises:
            FolderGoneError: It was moved, deleted or taken over.
        """
        held.check()
        if not held.is_in_place():
            raise FolderGoneError(_where_gone(self.path, held.place(), "before the run began"))

    def check_ours(self, run_id: str | None, held: Held) -> None:
        """Checks that this is still the folder of a run, before something is written into it.

        Args:
            run_id: The run's.
            held: What holds the folder.

        Raises:
            FolderGoneError: It was moved, deleted or taken over.
        """
        held.check()
        try:
            is_ours = held.is_in_place() and read_run_id(self.path) == run_id
        except RequestError:  # a file that cannot be read, for a moment or for good, is no reason to stop
            is_ours = self.config.exists()
        if not is_ours:
            when = "while the run wrote there, and what was trained since its last checkpoint is lost"
            raise FolderGoneError(_where_gone(self.path, held.place(), when))

    def remove_remains(self) -> None:
        """Deletes what threads that were writing a checkpoint have made again of a folder that was moved or deleted under them.

        A folder with anything else in it is somebody's, and stays.
        """
        with contextlib.suppress(OSError):
            # A folder that went between two steps of a writing thread may even get its final name, but never a manifest.
            unfinished = [
                _UNFINISHED in path.name or (path.name.isdigit() and not (path / "manifest").exists())
                for path in self.checkpoints.glob("*/*")
            ]
            if all(unfinished) and [entry.name for entry in self.path.iterdir()] == [self.checkpoints.name]:
                shutil.rmtree(self.path)

    def check(self, config: Config, resume: bool = False, overwrite: bool = False) -> bool:
        """Whether this folder may be used for ``config``. Changes nothing.

        Returns:
            True where an earlier run goes on, False where a run starts at the beginning.

        Raises:
            RequestError: The folder holds something that the caller did not say what to do with, or a run that contradicts.
        """
        if resume and overwrite:
            raise RequestError("--resume and --overwrite contradict each other: give one of them")
        check_there(self.path, resume)
        if self.path.exists() and not self.path.is_dir():
            raise RequestError(f"{self.path} is a file: choose another --run-dir")
        try:
            names = [entry.name for entry in self.path.iterdir()] if self.path.exists() else []
        except OSError as error:
            raise RequestError(f"{self.path} cannot be looked into ({error.strerror}): choose another --run-dir") from error
        if all(name.startswith(LOCK_NAME) or is_temporary(name) for name in names):
            return False
        if not (resume or overwrite):
            raise RequestError(f"run folder {self.path} exists: --resume goes on with it, --overwrite starts again")
        if not self.config.exists():
            raise RequestError(f"{self.path} holds files but no config.json, so it is not a run: choose another --run-dir")
        if overwrite:
            return False
        _check_same(self.path, read_config(self.path), config)
        return True

    def open(self, config: Config, resume: bool = False, overwrite: bool = False, log: tuple[str, ...] = ()) -> bool:
        """`check`, then makes the folder ready: with ``overwrite``, an earlier run's files are deleted, and nothing else.

        Call it last, when nothing can refuse the run any more.

        Returns:
            True where an earlier run goes on.

        Raises:
            RequestError: See `check`; or the folder cannot be written to, or something in it cannot be deleted.
        """
        goes_on = self.check(config, resume, overwrite)
        run_id = read_run_id(self.path) if goes_on else secrets.token_hex(16)
        if overwrite:
            self._delete_run()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            for file in self.path.iterdir():
                if is_temporary(file.name):  # of a process that was killed
                    file.unlink()
            write_atomically(self.config, json.dumps(_record(config, log, run_id), indent=2) + "\n")
        except OSError as error:
            raise RequestError(f"cannot write to {self.path} ({error.strerror}): choose another --run-dir") from error
        return goes_on

    def _delete_run(self) -> None:
        """Deletes what a run leaves, checkpoints first: what remains where something cannot be deleted is still a run.

        Raises:
            RequestError: Something cannot be deleted.
        """
        own = [self.checkpoints / name for name in CHECKPOINT_FOLDERS]
        if not self.checkpoints.is_dir():  # a file, or a link to nothing; a link to a folder stays: that disk was chosen
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
                what = error.filename or path
                raise RequestError(
                    f"the run in {self.path} cannot be deleted: {what} stays ({error.strerror or error}). No new run was "
                    "started: delete it by hand, or choose another --run-dir"
                ) from error
        if not self.checkpoints.is_symlink():
            with contextlib.suppress(OSError):  # somebody else's files are in there, or it is not there
                self.checkpoints.rmdir()


def _where_gone(path: Path, place: Path | None, when: str) -> str:
    """Words for a run folder that is not where it was."""
    if place is None:
        return f"{path} is gone: it was deleted, or moved away, {when}"
    is_there = place == path.resolve()
    resume = f"go on with --run-dir {shlex.quote(str(path if is_there else place))} --resume"
    if is_there:
        return f"{path / 'config.json'} is gone, or is that of another run: put it back, then {resume}"
    return f"{path} was moved to {place} {when}: {resume}"


def _record(config: Config, log: tuple[str, ...], run_id: str | None) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        **({} if run_id is None else {RUN_ID: run_id}),
        "preset": config.preset,
        "git_revision": provenance.revision(),
        "versions": provenance.versions(),
        "device": {**provenance.device_record(), "name": provenance.device_name()},
        "log": list(log),
        "config": dataclasses.asdict(config),
    }


def read_record(path: Path) -> dict[str, Any]:
    """The contents of a run's config.json.

    Raises:
        RequestError: There is no run in ``path``, or its config.json cannot be read.
    """
    file = RunFolder(path).config
    _check_run_path(path)
    if not file.exists():
        raise RequestError(f"no run in {path}: there is no config.json")
    record = read_json(file, mend="put back what it held, or train --overwrite")
    if record.get("schema") != SCHEMA:
        raise RequestError(
            f"{file} is not of schema {SCHEMA}: it was written by another version; use that, or train --overwrite"
        )
    return record


def read_run_id(path: Path) -> str | None:
    """The id of the run in ``path``; None of one of an earlier version, which has none.

    Raises:
        RequestError: There is no run in ``path``, or its config.json cannot be read.
    """
    run_id = read_record(path).get(RUN_ID)
    if not isinstance(run_id, str | None):
        raise RequestError(f"{RUN_ID} in {RunFolder(path).config} must be a word, not {run_id!r}: put back what it held")
    return run_id


def read_log(path: Path) -> tuple[str, ...]:
    """The loggers that the run in ``path`` had; none where there is no run."""
    check_path(path)
    log = read_record(path).get("log", []) if RunFolder(path).config.exists() else []
    if not isinstance(log, list) or not all(isinstance(name, str) for name in log):
        raise RequestError(f"log in {RunFolder(path).config} must be a list of words, not {log!r}: put back what it held")
    return tuple(log)


def read_config(path: Path) -> Config:
    """The configuration of the run in ``path``.

    Raises:
        RequestError: There is no run, or another version wrote it.
    """
    try:
        return config_from_dict(read_record(path).get("config", {}))
    except RequestError as error:
        raise RequestError(f"the run in {path} cannot be used: {error}") from error


def contradictions(saved: Config, config: Config, but_for: Collection[str] = MAY_CHANGE) -> list[str]:
    """The fields in which ``config`` would not learn what ``saved`` learned, in words.

    Args:
        saved: The configuration of a run.
        config: What is asked for.
        but_for: Fields that do not count.
    """
    before, asked = dataclasses.asdict(saved), dataclasses.asdict(config)
    unread = _OF_WEIGHTINGS if saved.weighting == config.weighting == "none" else ()
    return [
        f"{name} (saved {before[name]}, asked {asked[name]})"
        for name in sorted(before)
        if name not in but_for and name not in unread and before[name] != asked[name]
    ]


def _check_same(path: Path, saved: Config, config: Config) -> None:
    """Raises RequestError, naming the fields, where ``config`` would not learn what ``saved`` learned."""
    found = contradictions(saved, config)
    if found:
        raise RequestError(
            f"cannot resume {path}, its configuration is another one: {'; '.join(found)}; "
            "ask for the saved values, or take another --run-dir"
        )
