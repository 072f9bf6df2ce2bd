"""Install the package of this checkout into the Python of a running notebook, with JAX for its GPU if there is one.

The first cell of each notebook runs it if the package is missing, on Colab or in any other Jupyter. It needs only the standard
library and `packaging`, which every Jupyter kernel includes.
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


def find_driver_version() -> int | None:
    """Return the major version of the NVIDIA driver; None without a GPU."""
    try:
        answer = subprocess.run(
            ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"], capture_output=True, text=True, timeout=60
        )
        return int(answer.stdout.split(".")[0]) if answer.returncode == 0 else None
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return None


def installed_versions(names: tuple[str, ...]) -> dict[str, str]:
    """Return the versions of the installed ones among the distributions ``names``."""
    installed = {}
    for name in names:
        try:
            installed[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return installed


def cuda_extra(driver_version: int | None, installed: Mapping[str, str], supported_jax: Requirement) -> str | None:
    """Return the extra of this project that installs JAX for the GPU.

    Args:
        driver_version: Major version of the NVIDIA driver; None without a GPU.
        installed: Versions of ``jax`` and its CUDA plugins, as far as they are installed.
        supported_jax: Requirement of the project for JAX.

    Returns:
        The extra; None without a GPU, with a driver too old for any build, or if the installed JAX is supported and has a
        plugin of its version.
    """
    if driver_version is None:
        return None
    plugins = {extra: installed.get(name) for extra, name in _PLUGINS.items()}
    jax = installed.get("jax")
    if jax is not None and jax in plugins.values() and supported_jax.specifier.contains(jax, prereleases=True):
        return None  # the installed JAX works, such as that of Colab
    fitting = [extra for extra, oldest in _OLDEST_DRIVER.items() if driver_version >= oldest]
    # JAX supports one build at a time, so a build of an unsupported version is replaced by the same build.
    same_build = [extra for extra in fitting if plugins[extra] is not None]
    return next(iter([*same_build, *fitting]), None)


def required_jax(source: Path) -> Requirement:
    """Return the requirement for JAX of the checkout ``source``."""
    requirements = map(Requirement, tomllib.loads((source / "pyproject.toml").read_text())["project"]["dependencies"])
    return next(requirement for requirement in requirements if requirement.name == "jax")


def loaded_versions() -> dict[str, str]:
    """Return the versions on disk of the distributions from which this process has imported modules."""
    providers = importlib.metadata.packages_distributions()
    names = {name for module in list(sys.modules) for name in providers.get(module, ())}
    return installed_versions(tuple(sorted(names)))


def install(source: Path) -> str | None:
    """Install the checkout ``source`` with pip, and print its output.

    Returns:
        None, or a line with the reason why the notebook cannot continue.
    """
    driver_version = find_driver_version()
    extra = cuda_extra(
        driver_version, installed_versions(("jax", *(f"jax-{name}-plugin" for name in _OLDEST_DRIVER))), required_jax(source)
    )
    usable = driver_version is not None and driver_version >= min(_OLDEST_DRIVER.values())
    if driver_version is not None and not usable:
        print(f"the GPU's driver, {driver_version}, is older than {min(_OLDEST_DRIVER.values())}: JAX will use the CPU")
    # Some versions of JAX are slow there.
    limits = [] if usable else ["--constraint", str(source.resolve() / "requirements" / "cpu.in")]
    target = f"{source.resolve()}[{extra}]" if extra else str(source.resolve())
    print(f"installing {target}; this takes a minute or more", flush=True)
    before = loaded_versions()
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
    replaced = [name for name, version in loaded_versions().items() if before.get(name, version) != version]
    if replaced:
        return (
            f"{', '.join(replaced)} was in use and has been replaced: restart the session, then run the notebook from the top"
        )
    print("installed")
    return None
