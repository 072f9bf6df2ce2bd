"""What several commands check before they start to work."""

from pathlib import Path

from jaxrl_vis.cli.parsing import PROGRAM
from jaxrl_vis.errors import RequestError, nearest


def check_env(name: str) -> None:
    """Raises a `RequestError` with the nearest names unless ``name`` is an environment."""
    from jaxrl_vis_envs import list_envs

    names = tuple(list_envs())
    if name not in names:
        raise RequestError(f"unknown environment {name!r}{nearest(name, names)}")


def check_run(folder: Path) -> None:
    """Raises a `RequestError` unless ``folder`` holds a run."""
    if not (folder / "config.json").exists():
        raise RequestError(f"{folder} is not a run folder (it holds no config.json); {PROGRAM} train makes one")


def check_counts(**counts: int | None) -> None:
    """Raises a `RequestError` that names the first option of those given that is below 1."""
    for name, count in counts.items():
        if count is not None and count < 1:
            raise RequestError(f"--{name.replace('_', '-')} must be at least 1, not {count}")
