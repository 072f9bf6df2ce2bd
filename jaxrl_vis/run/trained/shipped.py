"""Policies that come with the package: ``jaxrl_vis/pretrained/NAME``, written by `benchmarks.ship`.

    config.json  of the run        policy.safetensors  see `policy_file`        README.md  see `jaxrl_vis.run.pushed.card`

Such a folder is used like a run folder, by its name. Imports no JAX, so that the command line can look up names quickly.
"""

from pathlib import Path

from jaxrl_vis.errors import RequestError, nearest

FOLDER = Path(__file__).resolve().parents[2] / "pretrained"


def names() -> list[str]:
    """Return the names of the policies that come with the package."""
    return sorted(config.parent.name for config in FOLDER.glob("*/config.json"))


def find(run: Path | str) -> Path:
    """Return the folder of a run, or that of a policy that comes with the package.

    Args:
        run: The run folder, which need not exist; or the name of a policy, unless a folder of that name exists.
    """
    is_name = isinstance(run, str | Path) and str(run) in names()
    return FOLDER / run if is_name and not (Path(run) / "config.json").exists() else Path(run)


def check(run: Path | str) -> None:
    """Raise a `RequestError` if a single word is neither a folder nor the name of a policy that comes with the package."""
    path = Path(run)
    if len(path.parts) == 1 and not path.exists() and not find(run).exists():
        suggestion = nearest(str(run), names(), f"policies that come with the package: {', '.join(names()) or 'none'}")
        raise RequestError(f"there is neither a run folder nor a policy called {str(run)[:60]!r}{suggestion}")


def output_folder(folder: Path) -> Path:
    """Return the output folder of a run: the run folder or, for a policy of the package, its name in the current folder."""
    return Path(folder.name) if folder.parent == FOLDER else folder
