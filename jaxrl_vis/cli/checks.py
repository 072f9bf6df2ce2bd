"""Checks shared by several commands before they start to work."""

import sys
from pathlib import Path
from typing import Literal

from jaxrl_vis.cli.parsing import PROGRAM
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices
from jaxrl_vis.host.files import check_path
from jaxrl_vis.run import trust as trusting
from jaxrl_vis.run.signals import shielded_children
from jaxrl_vis.run.storage.folder import read_config
from jaxrl_vis.run.trained import shipped


def check_env(name: str, folder: str | None = None) -> None:
    """Check that an environment exists; custom ones are imported.

    Args:
        name: Name of the environment.
        folder: Folder in which the module of ``module:Name`` was found earlier; None if unknown.

    Raises:
        RequestError: It does not exist, or its module cannot be imported.
    """
    from jaxrl_vis_envs import registry

    try:
        if registry.is_built_in(name):
            return
        with shielded_children():
            check_devices()  # before an import of the module can use devices
        registry.load(name, folder)
    except ValueError as error:
        raise RequestError(str(error)) from error


def may_run_code(run_dir: Path, trust: bool) -> bool:
    """Check that a run's custom code may be executed: permitted now or earlier, trained here, or confirmed interactively.

    Args:
        run_dir: The run folder.
        trust: True for ``--trust``.

    Returns:
        ``trust``, or True if it was confirmed on the terminal.

    Raises:
        RequestError: There is no permission.
    """
    try:
        config = read_config(run_dir)
    except RequestError:  # reported when the run is used, before any of its code runs
        return trust
    if not trust and trusting.is_own(config) and not trusting.is_trusted(run_dir, config) and _is_at_terminal():
        print(f"{trusting.describe_code(run_dir, config)}. Run it? [y/N] ", end="", file=sys.stderr, flush=True)
        trust = sys.stdin.readline().strip().lower() in ("y", "yes")
    trusting.check(run_dir, config, trust, "pass --trust")
    return trust


def _is_at_terminal() -> bool:
    return all(stream is not None and stream.isatty() for stream in (sys.stdin, sys.stderr))


def check_run(run: Path) -> Path:
    """Return the folder of a run, or of a policy that comes with the package.

    Args:
        run: The folder, or the policy's name.

    Raises:
        RequestError: It is neither.
    """
    check_path(run / "config.json")
    shipped.check(run)
    folder = shipped.find(run)
    if not (folder / "config.json").exists():
        above = next((parent for parent in folder.parents if (parent / "config.json").exists()), None)
        if folder.exists() and above is not None:
            raise RequestError(f"{folder} lies in a run folder: name that, {above}")
        raise RequestError(f"{folder} is not a run folder (it holds no config.json); {PROGRAM} train makes one")
    return folder


def read_checkpoint(word: str | None) -> int | Literal["best"] | None:
    """Read ``--checkpoint``: an iteration, ``best``, or None if it is not given.

    Raises:
        RequestError: It is none of these.
    """
    if word is None or word == "best":
        return word
    if not (word.isdecimal() and len(word) < 19):
        raise RequestError(f"--checkpoint {word[:40]}: name the iteration of a checkpoint, or best")
    return int(word)


def check_counts(**counts: int | None) -> None:
    """Raise a `RequestError` that names the first option below 1, if any."""
    for name, count in counts.items():
        if count is not None and count < 1:
            raise RequestError(f"--{name.replace('_', '-')} must be at least 1, not {count}")
