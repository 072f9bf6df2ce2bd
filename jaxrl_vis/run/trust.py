"""Trust in the code that a run folder names.

A run on a task of somebody's own, ``module:Name``, names that module and the folder to import it from: whoever uses the run
runs that code. Nothing else in a run folder is code. So a run is used only by a user who has trained it here, or who has said
that its code can be trusted; both are remembered in the user's own cache, for the folder, the run's id, the task and the file:

    ~/.cache/jaxrl-vis/trusted/<digest>      what was trusted, for people; the name says it for `is_trusted`
"""

import contextlib
import hashlib
import importlib.machinery
import json
from pathlib import Path

from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.files import make_private, read_private, replacing, stranger_to, user_cache
from jaxrl_vis.run.folder import read_run_id
from jaxrl_vis_envs import task_modules

_MOST = 2000  # runs that are remembered; the oldest are forgotten
_trusted_here: set[str] = set()  # by this process, where the cache cannot be written


def is_own(config: Config) -> bool:
    """Returns whether the task of a configuration is somebody's own code."""
    return task_modules.is_own(config.env)


def is_trusted(run_dir: Path, config: Config) -> bool:
    """Returns whether the code of a run's task was trusted before, and is the same as far as it can be told; or there is none.

    Raises:
        RequestError: There is no run in ``run_dir``, or its task is not written ``module:Name``.
    """
    return _file(config) is None or any(name in _trusted_here or _is_kept(name) for name in _names(run_dir, config))


def trust(run_dir: Path, config: Config, was_trained_here: bool = False) -> None:
    """Remembers that a run's task may be imported.

    Args:
        run_dir: The run folder.
        config: Its configuration.
        was_trained_here: The file may change: a user who trains works on it, too. Not where it lies in the run folder.
    """
    changing, as_it_is = _names(run_dir, config)
    name = changing if was_trained_here and not _is_inside(run_dir, _file(config)) else as_it_is
    _trusted_here.add(name)
    about = {"run": str(run_dir.resolve()), "task": config.env, "file": str(_file(config))}
    with contextlib.suppress(OSError):
        make_private(_folder())
        with replacing(_folder() / name, durable=False, mode=0o600) as file:
            file.write(json.dumps(about).encode() + b"\n")
        for path in sorted(_folder().iterdir(), key=lambda path: path.stat().st_mtime)[:-_MOST]:
            path.unlink(missing_ok=True)


def check(run_dir: Path, config: Config, may: bool, mend: str = "pass trust=True") -> None:
    """Checks that the code of a run's task may be imported; where ``may`` says so, that is remembered.

    Args:
        run_dir: The run folder.
        config: Its configuration.
        may: Its user says that it may.
        mend: How to say so.

    Raises:
        RequestError: Nobody has said that it may.
    """
    if not is_own(config) or is_trusted(run_dir, config):
        return
    if not may:
        raise RequestError(f"{question(run_dir, config)}: look at it, and if you trust it, {mend}")
    trust(run_dir, config)


def question(run_dir: Path, config: Config) -> str:
    """Words for what is to be trusted."""
    return f"the run in {run_dir} runs code that is not of this project: its task {config.env} is imported from {_file(config)}"


def _folder() -> Path:
    return user_cache() / "trusted"


def _is_kept(name: str) -> bool:
    try:
        return stranger_to(_folder().stat()) is None and read_private(_folder() / name) is not None
    except OSError:
        return False


def _file(config: Config) -> Path | None:
    """Path of a task's module, found without importing anything; None where there is none."""
    try:
        module, _ = task_modules.split(config.env)
        return task_modules.find(module, config.env_folder)
    except (ValueError, OSError) as error:  # not so written, or a folder that no system knows
        raise RequestError(f"the task {config.env!r} cannot be found: {error}") from error


def _names(run_dir: Path, config: Config) -> tuple[str, str]:
    """Digests of a run and its task: whatever the module's file holds, and as that is now."""
    file = _file(config)
    about = [str(run_dir.resolve()), read_run_id(run_dir), config.env, str(file)]
    files = _modules_in(run_dir) if _is_inside(run_dir, file) else [file] if file is not None else []
    contents = [[str(path), hashlib.sha256(path.read_bytes()).hexdigest()] for path in files if path.is_file()]
    return _digest(about), _digest([*about, contents])


def _digest(about: list) -> str:
    return hashlib.sha256(json.dumps(about).encode()).hexdigest()


def _is_inside(run_dir: Path, file: Path | None) -> bool:
    return file is not None and file.is_relative_to(run_dir.resolve())


def _modules_in(run_dir: Path) -> list[Path]:
    """All files below a run folder that Python could import."""
    suffixes = tuple(importlib.machinery.all_suffixes())
    return sorted(path for path in run_dir.resolve().rglob("*") if path.name.endswith(suffixes) and path.is_file())
