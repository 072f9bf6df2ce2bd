"""Trust in the code named by a run folder.

A run with custom code, ``module:Name`` (a task, an algorithm, a method, an auxiliary task or a weighting), names the module and
the folder to import it from: using the run executes that code. Nothing else in a run folder is code. So a run is used only by a
user who trained it here, or who declared its code trusted; both are stored in the user's own cache, for the folder, the run's
id, the parts and their files:

    ~/.cache/jaxrl-vis/trusted/<digest>      description of what was trusted; `is_trusted` uses the name only
"""

import contextlib
import hashlib
import importlib.machinery
import json
from pathlib import Path

from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import foreign_writer, make_private, read_private, replacing, user_cache
from jaxrl_vis.host.plugins import custom_names
from jaxrl_vis.run.storage.folder import read_run_id
from jaxrl_vis_envs import task_modules

_MAX_RUNS = 2000  # maximum number of stored runs; the oldest are deleted
_trusted_here: set[str] = set()  # by this process, if the cache is not writable


def is_own(config: Config) -> bool:
    """Return True if a part of a configuration is custom code."""
    return bool(custom_names(config))


def is_trusted(run_dir: Path, config: Config) -> bool:
    """Return True if a run has no custom code, or if its code was trusted before and appears unchanged.

    Raises:
        RequestError: There is no run in ``run_dir``, or a part of it is not written ``module:Name``.
    """
    has_code = any(_files(config).values())
    return not has_code or any(name in _trusted_here or _is_stored(name) for name in _names(run_dir, config))


def trust(run_dir: Path, config: Config, was_trained_here: bool = False) -> None:
    """Store the permission to import the custom parts of a run.

    Args:
        run_dir: The run folder.
        config: Its configuration.
        was_trained_here: Whether to permit later changes of the files by the user, too, except of files in the run folder.
    """
    changing, as_it_is = _names(run_dir, config)
    is_inside = any(_is_inside(run_dir, file) for file in _files(config).values())
    name = changing if was_trained_here and not is_inside else as_it_is
    _trusted_here.add(name)
    about = {"run": str(run_dir.resolve()), "files": {name: str(file) for name, file in _files(config).items()}}
    with contextlib.suppress(OSError):
        make_private(_folder())
        with replacing(_folder() / name, durable=False, mode=0o600) as file:
            file.write(json.dumps(about).encode() + b"\n")
        for path in sorted(_folder().iterdir(), key=lambda path: path.stat().st_mtime)[:-_MAX_RUNS]:
            path.unlink(missing_ok=True)


def check(run_dir: Path, config: Config, is_permitted: bool, hint: str = "pass trust=True") -> None:
    """Check that the code of a run may be imported; store the permission if the user gives it.

    Args:
        run_dir: The run folder.
        config: Its configuration.
        is_permitted: Whether the user gives the permission.
        hint: Hint on how to give the permission, for the message.

    Raises:
        RequestError: Permission is missing.
    """
    if not is_own(config) or is_trusted(run_dir, config):
        return
    if not is_permitted:
        raise RequestError(f"{describe_code(run_dir, config)}: look at it, and if you trust it, {hint}")
    trust(run_dir, config)


def describe_code(run_dir: Path, config: Config) -> str:
    """Return the clause of messages that lists the custom code of a run, and the files that it is imported from."""
    files = _files(config)
    reasons = [f"its {kind} {name} is imported from {files[name]}" for kind, name in custom_names(config).items()]
    return f"the run in {run_dir} runs code that is not of this project: {', '.join(reasons)}"


def _folder() -> Path:
    return user_cache() / "trusted"


def _is_stored(name: str) -> bool:
    try:
        return foreign_writer(_folder().stat()) is None and read_private(_folder() / name) is not None
    except OSError:
        return False


def _files(config: Config) -> dict[str, Path | None]:
    """Locate the modules of a run's custom parts, by name, without importing anything; None for one that is not found.

    Raises:
        RequestError: A name is not of the form ``module:Name``, or the folder of modules is invalid.
    """
    files = {}
    for kind, name in custom_names(config).items():
        try:
            files[name] = task_modules.find(task_modules.split(name)[0], config.environment.env_folder)
        except (ValueError, OSError) as error:  # not of this form, or an invalid folder
            raise RequestError(f"the {kind} {name!r} cannot be found: {error}") from error
    return files


def _names(run_dir: Path, config: Config) -> tuple[str, str]:
    """Compute digests of a run and its custom parts: without, and with the current contents of their files."""
    files = _files(config)
    about = [str(run_dir.resolve()), read_run_id(run_dir), *(word for pair in files.items() for word in map(str, pair))]
    paths = {file for file in files.values() if file is not None and not _is_inside(run_dir, file)}
    if any(_is_inside(run_dir, file) for file in files.values()):
        paths |= set(_importable_files(run_dir))
    contents = [[str(path), hashlib.sha256(path.read_bytes()).hexdigest()] for path in sorted(paths) if path.is_file()]
    return _digest(about), _digest([*about, contents])


def _digest(about: list) -> str:
    return hashlib.sha256(json.dumps(about).encode()).hexdigest()


def _is_inside(run_dir: Path, file: Path | None) -> bool:
    return file is not None and file.is_relative_to(run_dir.resolve())


def _importable_files(run_dir: Path) -> list[Path]:
    """List all files below a run folder that Python could import."""
    suffixes = tuple(importlib.machinery.all_suffixes())
    return sorted(path for path in run_dir.resolve().rglob("*") if path.name.endswith(suffixes) and path.is_file())
