"""Provenance of a run or a figure: revision of the code, versions of the libraries, and device.

Importing this module does not import JAX; querying the device does.
"""

import functools
import importlib.metadata
import importlib.util
import os
import platform
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

from jaxrl_vis_envs.cores import num_cores

PACKAGES = ("jaxrl-vis", "jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx", "flax", "optax", "orbax-checkpoint")
"""The libraries that a result depends on."""

NOT_INSTALLED = "not installed"
"""Version that `versions` reports for a missing package."""

CHECKOUT = Path(__file__).resolve().parents[2]
"""Folder that holds both packages: the checkout, or site-packages for an installed copy."""

# Files that can affect results. Changed records, run folders and shipped policies do not make a checkout dirty.
_CODE = ("jaxrl_vis", "envs", "benchmarks", "pyproject.toml", ":!benchmarks/results", ":!jaxrl_vis/pretrained")


def git(*arguments: str, folder: Path = CHECKOUT) -> str | None:
    """Run a git command in ``folder`` and return its standard output; None if git is missing or the command fails."""
    try:
        done = subprocess.run(("git", "-C", str(folder), *arguments), capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.rstrip("\n") if done.returncode == 0 else None


def is_checkout(folder: Path = CHECKOUT) -> bool:
    """Return True if ``folder`` is the top of a git checkout: an installed copy may lie inside another project's."""
    top = git("rev-parse", "--show-toplevel", folder=folder)
    return top is not None and Path(top).resolve() == folder.resolve()


def revision(digits: int = 40, folder: Path = CHECKOUT) -> str | None:
    """Return the revision of the checkout, with ``-dirty`` if its code was modified; None outside a checkout.

    The environment variable JAXRL_VIS_REVISION takes precedence: it names the revision of a copy without history.

    Args:
        digits: Number of hexadecimal digits.
        folder: The top of the checkout.
    """
    named = os.environ.get("JAXRL_VIS_REVISION")
    if named:
        return re.sub(r"^([0-9a-f]{7,40})", lambda matched: matched[1][:digits], named)
    head = git("rev-parse", "HEAD", folder=folder) if is_checkout(folder) else None
    if not head:
        return None
    return head[:digits] + ("-dirty" if git("status", "--porcelain", "--", *_CODE, folder=folder) else "")


def child_environment() -> dict[str, str]:
    """Return environment variables for a child process that imports this copy of the project."""
    import jaxrl_vis_envs

    sources = {str(CHECKOUT), str(Path(jaxrl_vis_envs.__file__).resolve().parents[1])}
    others = [part for part in os.environ.get("PYTHONPATH", "").split(os.pathsep) if part and part not in sources]
    return {**os.environ, "PYTHONPATH": os.pathsep.join([*sorted(sources), *others])}


def install_command(extra: str) -> str:
    """Return the shell command that installs an extra of this project, for a clone or an installed copy, by pip or uv."""
    in_clone = (CHECKOUT / "pyproject.toml").exists()
    local_uv = CHECKOUT / ".uv" / "bin" / "uv"
    if importlib.util.find_spec("pip"):
        installer = "pip"
    else:  # as in an environment that uv made
        installer = f"{local_uv} pip" if local_uv.exists() and shutil.which("uv") is None else "uv pip"
    return f"{installer} install '{CHECKOUT if in_clone else 'jaxrl-vis'}[{extra}]'"


def versions() -> dict[str, str]:
    """Return the versions of Python and of `PACKAGES`; `NOT_INSTALLED` for missing ones."""
    installed = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            installed[package] = _installed_version(package)
        except importlib.metadata.PackageNotFoundError:
            installed[package] = NOT_INSTALLED
    return installed


_installed_version = functools.cache(importlib.metadata.version)  # a missing package is looked for again


def device_record() -> dict[str, Any]:
    """Describe JAX's devices: ``platform``, ``kind`` of the first, ``count``, and ``cpu_count`` of the host."""
    import jax

    device = jax.devices()[0]
    return {"platform": device.platform, "kind": device.device_kind, "count": jax.device_count(), "cpu_count": os.cpu_count()}


@functools.cache
def device_name() -> str:
    """Return the hardware's name: the accelerator's name and count, or the processor's name and the number of usable cores."""
    import jax

    if jax.default_backend() != "cpu":
        return f"{jax.devices()[0].device_kind} x{jax.device_count()}"
    name = platform.processor() or platform.machine()
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            name = next((line.split(":", 1)[1].strip() for line in file if line.startswith("model name")), name)
    return f"{name}, {num_cores()} cores"
