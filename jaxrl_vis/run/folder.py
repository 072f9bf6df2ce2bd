"""The folder of a run: where its files lie, which configuration they belong to, and who may write there.

The files:

    config.json     schema, versions, device, git revision, configuration      metrics.jsonl   see `metrics`
    checkpoints/    see `checkpoint`      nonfinite/   what a run that went wrong held      curve.png   video.gif
    run.lock        while a process writes here, see `lock`      tensorboard/, wandb/, wandb.json   see `loggers`
    processes.jsonl     see `goodput`
"""

import dataclasses
import json
import shutil
from collections.abc import Collection
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from jaxrl_vis import provenance
from jaxrl_vis.config import Config, config_from_dict
from jaxrl_vis.errors import RequestError
from jaxrl_vis.files import write_atomically
from jaxrl_vis.run.lock import FILE_NAME as LOCK_NAME
from jaxrl_vis.run.lock import run_lock

SCHEMA = 1

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
    *("aux_gradients", "aux_form", "actor_log"),
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
    if resume and not path.exists():
        raise RequestError(f"nothing to resume: there is no folder {path}; leave out --resume to start a run there")


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

    def lock(self) -> AbstractContextManager[None]:
        """See `run_lock`."""
        return run_lock(self.path)

    def check(self, config: Config, resume: bool = False, overwrite: bool = False) -> bool:
        """Whether this folder may be used for ``config``. Changes nothing.

        Returns:
            True where an earlier run goes on, False where a run starts at the beginning.

        Raises:
            RequestError: The folder holds something that the caller did not say what to do with, or a run that contradicts.
        """
        if resume and overwrite:
            raise RequestError("--resume and --overwrite contradict each other: give one of them")
        if self.path.exists() and not self.path.is_dir():
            raise RequestError(f"{self.path} is a file: choose another --run-dir")
        check_there(self.path, resume)
        if not self.path.exists() or all(entry.name == LOCK_NAME for entry in self.path.iterdir()):
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
            RequestError: See `check`; or the folder cannot be written to.
        """
        goes_on = self.check(config, resume, overwrite)
        try:
            if overwrite:
                for folder in (self.checkpoints, self.nonfinite, *(self.path / name for name in LOGGER_FOLDERS)):
                    shutil.rmtree(folder, ignore_errors=True)
                for file in (self.metrics, self.processes, self.curve, self.video, self.path / WANDB_STATE):
                    file.unlink(missing_ok=True)
            self.path.mkdir(parents=True, exist_ok=True)
            write_atomically(self.config, json.dumps(_record(config, log), indent=2) + "\n")
        except OSError as error:
            raise RequestError(f"cannot write to {self.path} ({error.strerror}): choose another --run-dir") from error
        return goes_on


def _record(config: Config, log: tuple[str, ...]) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "preset": config.preset,
        "git_revision": provenance.revision(),
        "versions": provenance.versions(),
        "device": provenance.device_record(),
        "log": list(log),
        "config": dataclasses.asdict(config),
    }


def read_record(path: Path) -> dict[str, Any]:
    """The contents of a run's config.json.

    Raises:
        RequestError: There is no run in ``path``, or its config.json cannot be read.
    """
    file = RunFolder(path).config
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise RequestError(f"no run in {path}: there is no config.json") from error
    except (OSError, ValueError) as error:
        raise RequestError(f"{file} cannot be read ({type(error).__name__}): train --overwrite starts again") from error
    if not isinstance(record, dict) or record.get("schema") != SCHEMA:
        raise RequestError(
            f"{file} is not of schema {SCHEMA}: it was written by another version; use that, or train --overwrite"
        )
    return record


def read_log(path: Path) -> tuple[str, ...]:
    """The loggers that the run in ``path`` had; none where there is no run."""
    return tuple(read_record(path).get("log", ())) if RunFolder(path).config.exists() else ()


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
