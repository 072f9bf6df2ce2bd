"""Where a run or a figure comes from: the revision of the code, the versions of the libraries, and the device.

Importing this loads no JAX; asking for the device does.
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
"""What `versions` says of a package that is missing."""

CHECKOUT = Path(__file__).resolve().parents[1]
"""The folder that holds both packages: the checkout, or site-packages for an installed copy."""

# What a result can depend on. Kept records and run folders may change without making a checkout dirty.
_CODE = ("jaxrl_vis", "envs", "benchmarks", "pyproject.toml", ":!benchmarks/results")


def git(*arguments: str, folder: Path = CHECKOUT) -> str | None:
    """Standard output of a git command in ``folder``; None where git is missing or the command fails."""
    try:
        done = subprocess.run(("git", "-C", str(folder), *arguments), capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.rstrip("\n") if done.returncode == 0 else None


def is_checkout(folder: Path = CHECKOUT) -> bool:
    """Whether ``folder`` is the top of a git checkout: an installed copy may lie inside somebody else's."""
    top = git("rev-parse", "--show-toplevel", folder=folder)
    return top is not None and Path(top).resolve() == folder.resolve()


def revision(digits: int = 40, folder: Path = CHECKOUT) -> str | None:
    """The revision of the checkout in ``folder``, with ``-dirty`` where its code differs from that; None outside a checkout.

    The environment variable JAXRL_VIS_REVISION goes first: it names the revision of a copy that has no history.

    Args:
        digits: Hexadecimal digits of the revision.
        folder: The top of the checkout.
    """
    named = os.environ.get("JAXRL_VIS_REVISION")
    if named:
        return re.sub(r"^([0-9a-f]{7,40})", lambda found: found[1][:digits], named)
    head = git("rev-parse", "HEAD", folder=folder) if is_checkout(folder) else None
    if not head:
        return None
    return head[:digits] + ("-dirty" if git("status", "--porcelain", "--", *_CODE, folder=folder) else "")


def child_environment() -> dict[str, str]:
    """Environment variables for a process that runs this very copy of the project, wherever Python would find another one."""
    import jaxrl_vis_envs

    sources = {str(CHECKOUT), str(Path(jaxrl_vis_envs.__file__).resolve().parents[1])}
    there = [part for part in os.environ.get("PYTHONPATH", "").split(os.pathsep) if part and part not in sources]
    return {**os.environ, "PYTHONPATH": os.pathsep.join([*sorted(sources), *there])}


def install_command(extra: str) -> str:
    """The command that installs one of this project's extras here: in a clone or an installed copy, with or without pip."""
    in_clone = (CHECKOUT / "pyproject.toml").exists()
    local_uv = CHECKOUT / ".uv" / "bin" / "uv"
    if importlib.util.find_spec("pip"):
        installer = "pip"
    else:  # as in an environment that uv made
        installer = ".uv/bin/uv pip" if local_uv.exists() and shutil.which("uv") is None else "uv pip"
    return f"{installer} install '.[{extra}]' in {CHECKOUT}" if in_clone else f"{installer} install 'jaxrl-vis[{extra}]'"


def versions() -> dict[str, str]:
    """Versions of Python and of `PACKAGES`; `NOT_INSTALLED` for those that are missing."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = NOT_INSTALLED
    return found


def device_record() -> dict[str, Any]:
    """The devices that JAX runs on: ``platform``, ``kind`` of the first, ``count``, and ``cpu_count`` of the host."""
    import jax

    device = jax.devices()[0]
    return {"platform": device.platform, "kind": device.device_kind, "count": jax.device_count(), "cpu_count": os.cpu_count()}


@functools.cache
def device_name() -> str:
    """The machine that computes: the accelerator's name and count, or the processor's name and the cores that may be used."""
    import jax

    if jax.default_backend() != "cpu":
        return f"{jax.devices()[0].device_kind} x{jax.device_count()}"
    name = platform.processor() or platform.machine()
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            name = next((line.split(":", 1)[1].strip() for line in file if line.startswith("model name")), name)
    return f"{name}, {num_cores()} cores"
