"""Installs the package of this checkout into the Python of a running notebook, with JAX for the GPU where there is one.

The first cell of each notebook runs it where the package is missing, on Colab or in any other Jupyter. It needs nothing but the
standard library and `packaging`, which every Jupyter kernel brings.
"""

import importlib
import importlib.metadata
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path

from packaging.requirements import Requirement

# The oldest NVIDIA driver that each of JAX's builds runs on (its installation page), the newest build first.
_OLDEST_DRIVER = {"cuda13": 580, "cuda12": 525}
_PLUGINS = {extra: f"jax-{extra}-plugin" for extra in _OLDEST_DRIVER}


def driver() -> int | None:
    """Major version of the NVIDIA driver, or None where there is no GPU."""
    try:
        answer = subprocess.run(
            ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"], capture_output=True, text=True, timeout=60
        )
        return int(answer.stdout.split(".")[0]) if answer.returncode == 0 else None
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return None


def versions(names: tuple[str, ...]) -> dict[str, str]:
    """Versions of those of the distributions ``names`` that are installed."""
    installed = {}
    for name in names:
        try:
            installed[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return installed


def cuda_extra(driver_version: int | None, installed: Mapping[str, str], supported_jax: Requirement) -> str | None:
    """The extra of this project that gives JAX the GPU; None where JAX needs none, or has it.

    Args:
        driver_version: Major version of the NVIDIA driver, or None without a GPU.
        installed: Versions of ``jax`` and of its CUDA plugins, where they are installed.
        supported_jax: What the project requires of JAX.
    """
    if driver_version is None:
        return None
    plugins = {extra: installed.get(name) for extra, name in _PLUGINS.items()}
    jax = installed.get("jax")
    if jax is not None and jax in plugins.values() and supported_jax.specifier.contains(jax, prereleases=True):
        return None  # what is there works: Colab's own JAX, say
    fitting = [extra for extra, oldest in _OLDEST_DRIVER.items() if driver_version >= oldest]
    # JAX takes one build at a time, so one of an unsupported version is replaced by its like.
    same_build = [extra for extra in fitting if plugins[extra] is not None]
    return next(iter([*same_build, *fitting]), None)


def required_jax(source: Path) -> Requirement:
    """What the checkout ``source`` requires of JAX."""
    requirements = map(Requirement, tomllib.loads((source / "pyproject.toml").read_text())["project"]["dependencies"])
    return next(requirement for requirement in requirements if requirement.name == "jax")


def loaded() -> dict[str, str]:
    """Versions, on disk, of the distributions that this process has imported something of."""
    providers = importlib.metadata.packages_distributions()
    names = {name for module in list(sys.modules) for name in providers.get(module, ())}
    return versions(tuple(sorted(names)))


def install(source: Path) -> str | None:
    """Installs the checkout ``source`` with pip.

    Returns:
        None, or a line that says why the notebook cannot go on.
    """
    driver_version = driver()
    extra = cuda_extra(
        driver_version, versions(("jax", *(f"jax-{name}-plugin" for name in _OLDEST_DRIVER))), required_jax(source)
    )
    usable = driver_version is not None and driver_version >= min(_OLDEST_DRIVER.values())
    if driver_version is not None and not usable:
        print(f"the GPU's driver, {driver_version}, is older than {min(_OLDEST_DRIVER.values())}: JAX will use the CPU")
    # Some versions of JAX are slow there.
    limits = [] if usable else ["--constraint", str(source.resolve() / "requirements" / "cpu.in")]
    target = f"{source.resolve()}[{extra}]" if extra else str(source.resolve())
    print(f"installing {target}; this takes a minute or more", flush=True)
    before = loaded()
    pip = subprocess.run(
        [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *limits, target],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    print(pip.stdout, end="")
    importlib.invalidate_caches()
    if pip.returncode:
        return f"pip could not install {target}; what it says stands above"
    replaced = [name for name, version in loaded().items() if before.get(name, version) != version]
    if replaced:
        return (
            f"{', '.join(replaced)} was in use and has been replaced: restart the session, then run the notebook from the top"
        )
    print("installed")
    return None
