"""Compute devices: queried from JAX, or guessed if the answer must not wait for JAX."""

import contextlib
import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

from jaxrl_vis.config import fields
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import make_private, user_cache
from jaxrl_vis.host.provenance import child_environment

_MAX_MEMORY = 0.9
"""Fraction of a GPU's memory that JAX preallocates; drivers, CUDA graphs and libraries need the rest."""
_DEFAULT_MIN_COMPILE_S = 1.0  # JAX's default: programs that take longer to compile should be cached
_BLOCK = 4096  # bytes; a full disk can still create empty files

# Packages through which JAX uses an accelerator, and files that indicate its presence.
_NVIDIA = (("jax_cuda12_plugin", "jax_cuda13_plugin"), ("/dev/nvidiactl", "/dev/nvidia0", "/dev/dxg"))
_TPU = (("libtpu",), ("/dev/accel0", "/dev/vfio/0"))


def claim_memory() -> None:
    """Let JAX preallocate 90 % of a GPU's memory instead of its default 75 %; call it before importing JAX.

    For processes with exclusive use of a GPU, as in training. Values set by the user or a study (`shared`) are not changed.
    """
    names = ("XLA_CLIENT_MEM_FRACTION", "XLA_PYTHON_CLIENT_MEM_FRACTION")
    if not any(os.environ.get(name) for name in names):
        os.environ[names[1]] = str(_MAX_MEMORY)


def start_devices() -> None:
    """Initialise JAX's devices in a background thread, which takes a second or two for a GPU, while imports continue.

    Any use of the devices, or `check_devices`, waits for the thread. If initialisation fails, that use raises the error.
    """
    import jax

    def start() -> None:
        with contextlib.suppress(Exception):
            jax.devices()

    threading.Thread(target=start, name="start devices").start()


def check_devices() -> None:
    """Initialise JAX's devices and report errors of its configuration.

    Raises:
        RequestError: JAX finds no device, JAX_PLATFORMS names a platform that is not available, or compilation is disabled.
    """
    import jax

    if jax.config.jax_disable_jit:
        raise RequestError(
            "compilation is disabled in JAX, without which nothing here would finish: unset JAX_DISABLE_JIT, or call"
            " jax.config.update('jax_disable_jit', False) first"
        )
    requested = jax.config.jax_platforms
    try:
        jax.default_backend()
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        if not requested:
            raise RequestError(f"JAX finds no device to compute on: {' '.join(str(error).split())}") from error
        available = _default_platform(requested)
        raise RequestError(
            f"JAX_PLATFORMS={requested}, but JAX finds no such device here, only {available}{_hint(requested)}"
        ) from error


def enable_compilation_cache() -> str:
    """Enable JAX's persistent compilation cache, so that later starts take seconds.

    A folder that is already configured (JAX_COMPILATION_CACHE_DIR, or jax.config) is kept; otherwise it is ``jaxrl-vis/xla`` in
    the user's cache folder, if that can be created. `cache_fault` reports problems with it. Programs that take at least 0.3 s
    to compile are cached, unless JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS is set.

    Returns:
        The folder; empty if there is none.
    """
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    from jaxrl_vis.host.cache_entries import repair_damaged_entries

    default = default_cache()
    if not jax.config.jax_compilation_cache_dir and _write_fault(default) is None:
        with contextlib.suppress(OSError):
            make_private(default)  # it holds machine code that will be executed
        jax.config.update("jax_compilation_cache_dir", str(default))
        # JAX decides at its first compilation whether to use a cache; a notebook may already have compiled something.
        compilation_cache.reset_cache()
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    silence_cache_warnings()
    repair_damaged_entries()
    return str(jax.config.jax_compilation_cache_dir or "")


def silence_cache_warnings() -> None:
    """Suppress JAX's warnings about an unusable cache, one per program; the run reports it once."""
    import jax

    if jax.config.jax_compilation_cache_dir and cache_fault() is not None:
        warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry", UserWarning)


def default_cache() -> Path:
    """Return the default folder of the compilation cache."""
    return user_cache() / "xla"


def cache_fault() -> str | None:
    """Return why programs compiled now will not be reused, after `enable_compilation_cache`; None if they will."""
    import jax

    if not jax.config.jax_enable_compilation_cache or jax.config.jax_compilation_cache_max_size == 0:
        return "the compilation cache is disabled in JAX"
    folder = jax.config.jax_compilation_cache_dir
    if not folder:
        reason = _write_fault(default_cache())
        return f"{reason}; set JAX_COMPILATION_CACHE_DIR to a writable folder" if reason else "no cache is set up"
    if jax.config.jax_persistent_cache_min_compile_time_secs > _DEFAULT_MIN_COMPILE_S:
        return (
            f"only programs that take {jax.config.jax_persistent_cache_min_compile_time_secs:g} s or more to compile are cached"
        )
    if "://" in folder:  # cloud storage, which JAX checks itself
        return None
    return _write_fault(Path(folder))


def _write_fault(folder: Path) -> str | None:
    """Return why a folder, created if missing, cannot hold new files; None if it can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(_BLOCK))
    except OSError as error:
        return f"{folder} cannot be written ({error.strerror or type(error).__name__})"
    return None


def parse_device_count(requested: str) -> int:
    """Parse a number of devices: a number, or ``all`` for the devices of all processes.

    Raises:
        RequestError: The value is neither.
    """
    if requested.lower() != "all":
        return fields.read("--devices", int, [requested])
    check_devices()
    import jax

    return len(jax.devices())


@dataclasses.dataclass(frozen=True)
class Device:
    """Device available to a process.

    Attributes:
        name: Name for messages.
        environment: Variables that restrict a process to this device.
    """

    name: str
    environment: Mapping[str, str]


CPU = "the CPU"
"""Name of the only device on a machine without accelerators."""

# Run in a separate process: once initialised, JAX holds some of a GPU's memory until the process ends.
_LIST_DEVICES = """
import json, sys
from jaxrl_vis.host.devices import check_devices
from jaxrl_vis.errors import RequestError
try:
    check_devices()
except RequestError as error:
    sys.exit(str(error))
import jax
print(json.dumps([[device.platform, device.device_kind] for device in jax.local_devices()]))
"""


def list_devices() -> list[Device]:
    """List the GPUs that this process may use; a single entry without variables if there is only one device or no GPU.

    Raises:
        RequestError: JAX finds no device.
    """
    environment = child_environment() | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    done = subprocess.run([sys.executable, "-c", _LIST_DEVICES], env=environment, capture_output=True, text=True)
    lines = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
    if done.returncode or not lines:
        raise RequestError(lines[-1] if lines else "JAX finds no device to compute on")
    devices = json.loads(lines[-1])
    (platform, kind), count = devices[0], len(devices)
    if platform not in ("gpu", "cuda") or count == 1:
        return [Device(CPU if platform == "cpu" else kind, {})]
    visible = [word.strip() for word in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if word.strip()]
    names = visible if len(visible) == count else [str(number) for number in range(count)]
    return [Device(f"GPU {name}", {"CUDA_VISIBLE_DEVICES": name}) for name in names]


def shared(devices: Sequence[Device], processes: int) -> list[Device]:
    """Return every device once per parallel process, with GPU memory divided among the processes of a device."""
    if processes == 1:
        return list(devices)
    share = {"XLA_PYTHON_CLIENT_MEM_FRACTION": f"{_MAX_MEMORY / processes:.3f}"}
    return [Device(device.name, {**device.environment, **share}) for _ in range(processes) for device in devices]


def guess_accelerator() -> bool:
    """Guess whether JAX will use an accelerator, without importing JAX, for fast help output."""
    requested = [word.strip() for word in os.environ.get("JAX_PLATFORMS", "").split(",") if word.strip()]
    if requested:
        return requested[0] != "cpu"
    return any(_exists(files) and _is_installed(packages) for packages, files in (_NVIDIA, _TPU))


def _is_installed(packages: tuple[str, ...]) -> bool:
    return any(importlib.util.find_spec(package) for package in packages)


def _exists(files: tuple[str, ...]) -> bool:
    return any(Path(file).exists() for file in files)


def _default_platform(requested: str) -> str:
    """Return the platform that JAX chooses without JAX_PLATFORMS, such as ``cpu``, or ``nothing``. The setting is restored."""
    import jax
    from jax.extend.backend import clear_backends

    try:
        jax.config.update("jax_platforms", "")
        return jax.default_backend()
    except (RuntimeError, AssertionError):
        return "nothing"
    finally:
        jax.config.update("jax_platforms", requested)
        clear_backends()  # otherwise the next call would return the backend initialised here


def _hint(requested: str) -> str:
    wanted = {word.strip().lower() for word in requested.split(",")}
    if "cpu" in wanted:
        return "; write JAX_PLATFORMS=cpu"
    packages, files = _NVIDIA
    install = wanted & {"cuda", "gpu"} and _exists(files) and not _is_installed(packages)
    return "; install this project with the extra cuda12 or cuda13" if install else "; unset JAX_PLATFORMS to run on that"
