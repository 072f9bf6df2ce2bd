"""What several commands check before they start to work."""

import importlib.util
from pathlib import Path

from jaxrl_vis.cli.parsing import PROGRAM
from jaxrl_vis.devices import check_devices
from jaxrl_vis.errors import RequestError
from jaxrl_vis.provenance import install_command
from jaxrl_vis.run.signals import shielded_children

# What an extra brings: module -> package.
_GRASPING = {"cv2": "opencv-python-headless", "scipy": "scipy", "yaml": "pyyaml"}
_EXTRAS = {"phenotyping": {**_GRASPING, "tifffile": "tifffile", "pandas": "pandas"}, "grasping": _GRASPING}


def check_extra(command: str, extra: str) -> None:
    """Checks that what a command needs beyond the base installation is there.

    Args:
        command: Its first word.
        extra: What brings it.

    Raises:
        RequestError: It is not.
    """
    missing = [package for module, package in _EXTRAS[extra].items() if importlib.util.find_spec(module) is None]
    if missing:
        raise RequestError(f"{command} needs {', '.join(missing)}: {install_command(extra)}")


def check_env(name: str, folder: str | None = None) -> None:
    """Checks that there is an environment; one that is not built in is imported.

    Args:
        name: Of the environment.
        folder: Where the module of ``module:Name`` was found before.

    Raises:
        RequestError: There is none, or what holds it cannot be imported.
    """
    from jaxrl_vis_envs import registry

    try:
        if registry.is_built_in(name):
            return
        with shielded_children():
            check_devices()  # what somebody's module computes as it is imported must not be the first to ask
        registry.load(name, folder)
    except ValueError as error:
        raise RequestError(str(error)) from error


def check_run(folder: Path) -> None:
    """Raises a `RequestError` unless ``folder`` holds a run."""
    if not (folder / "config.json").exists():
        above = next((parent for parent in folder.parents if (parent / "config.json").exists()), None)
        if folder.exists() and above is not None:
            raise RequestError(f"{folder} lies in a run folder: name that, {above}")
        raise RequestError(f"{folder} is not a run folder (it holds no config.json); {PROGRAM} train makes one")


def check_counts(**counts: int | None) -> None:
    """Raises a `RequestError` that names the first option of those given that is below 1."""
    for name, count in counts.items():
        if count is not None and count < 1:
            raise RequestError(f"--{name.replace('_', '-')} must be at least 1, not {count}")
