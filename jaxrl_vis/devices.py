"""What there is to compute on: asked of JAX, or, where an answer must not wait for JAX, guessed."""

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

from jaxrl_vis import fields
from jaxrl_vis.errors import RequestError
from jaxrl_vis.files import make_private, user_cache
from jaxrl_vis.provenance import child_environment

_MOST_MEMORY = 0.9
"""Share of a GPU's memory; what drivers, CUDA graphs and libraries take comes on top."""
_LEAST_KEPT_S = 1.0  # JAX's own: what takes longer to compile should be kept
_BLOCK = 4096  # bytes; a full disk still makes files, but empty ones

# The packages by which JAX reaches an accelerator, and files that show that the machine has one.
_NVIDIA = (("jax_cuda12_plugin", "jax_cuda13_plugin"), ("/dev/nvidiactl", "/dev/nvidia0", "/dev/dxg"))
_TPU = (("libtpu",), ("/dev/accel0", "/dev/vfio/0"))


def claim_memory() -> None:
    """Lets JAX take nine tenths of a GPU's memory, which is more than its own three quarters; call it before JAX is imported.

    For what has a GPU to itself, as training has. What the user or a study has set (`shared`) stays as it is.
    """
    names = ("XLA_CLIENT_MEM_FRACTION", "XLA_PYTHON_CLIENT_MEM_FRACTION")
    if not any(os.environ.get(name) for name in names):
        os.environ[names[1]] = str(_MOST_MEMORY)


def start_devices() -> None:
    """Lets JAX start its devices in a thread of its own, which for a GPU takes a second or two: time to import the rest.

    Whoever uses devices, or calls `check_devices`, waits for it. If it fails, they fail, too, and say why.
    """
    import jax

    def start() -> None:
        with contextlib.suppress(Exception):
            jax.devices()

    threading.Thread(target=start, name="start devices").start()


def check_devices() -> None:
    """Starts JAX, which fails where it is told to use what is not there.

    Raises:
        RequestError: JAX_PLATFORMS asks for a platform that JAX cannot use here, or JAX is told not to compile.
    """
    import jax

    if jax.config.jax_disable_jit:
        raise RequestError(
            "JAX is told not to compile, and without that nothing here would end: unset JAX_DISABLE_JIT, or call"
            " jax.config.update('jax_disable_jit', False) first"
        )
    asked = jax.config.jax_platforms
    try:
        jax.default_backend()
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        if not asked:
            raise RequestError(f"JAX finds no device to compute on: {' '.join(str(error).split())}") from error
        there = _platforms_without(asked)
        raise RequestError(f"JAX_PLATFORMS={asked}, but JAX finds no such device here, only {there}{_mend(asked)}") from error


def enable_compilation_cache() -> str:
    """Keeps compiled programs in a folder, so that the second start takes seconds.

    A folder that was chosen already (JAX_COMPILATION_CACHE_DIR, or jax.config) is left as it is; otherwise it is
    ``jaxrl-vis/xla`` in the user's cache folder, if that can be made. `cache_fault` says what is wrong with it.

    Returns:
        The folder; empty where there is none.
    """
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    from jaxrl_vis.cache_entries import mend_damaged_entries

    default = default_cache()
    if not jax.config.jax_compilation_cache_dir and _why_not_writable(default) is None:
        with contextlib.suppress(OSError):
            make_private(default)  # it holds machine code, which runs
        jax.config.update("jax_compilation_cache_dir", str(default))
        # JAX decides at its first compilation whether it has a cache, and a notebook has compiled something by now.
        compilation_cache.reset_cache()
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    hush_cache()
    mend_damaged_entries()
    return str(jax.config.jax_compilation_cache_dir or "")


def hush_cache() -> None:
    """Lets JAX be silent about a cache with a fault, which the run says once; JAX would warn of each program."""
    import jax

    if jax.config.jax_compilation_cache_dir and cache_fault() is not None:
        warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry", UserWarning)


def default_cache() -> Path:
    """The folder of compiled programs where nobody has chosen another."""
    return user_cache() / "xla"


def cache_fault() -> str | None:
    """Why the next start will not find what is compiled now, after `enable_compilation_cache`; None where it will."""
    import jax

    if not jax.config.jax_enable_compilation_cache or jax.config.jax_compilation_cache_max_size == 0:
        return "JAX is told to keep no compiled programs"
    folder = jax.config.jax_compilation_cache_dir
    if not folder:
        why = _why_not_writable(default_cache())
        return f"{why}; set JAX_COMPILATION_CACHE_DIR to a folder that can" if why else "no cache is set up"
    if jax.config.jax_persistent_cache_min_compile_time_secs > _LEAST_KEPT_S:
        return f"only what takes {jax.config.jax_persistent_cache_min_compile_time_secs:g} s to compile is kept"
    if "://" in folder:  # of a cloud, which JAX looks at
        return None
    return _why_not_writable(Path(folder))


def _why_not_writable(folder: Path) -> str | None:
    """Why a folder, which is made if need be, takes no file; None where it does."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(_BLOCK))
    except OSError as error:
        return f"{folder} cannot be written ({error.strerror or type(error).__name__})"
    return None


def count_devices(asked: str) -> int:
    """How many devices an option means: a number, or ``all`` that JAX finds, in all processes.

    Raises:
        RequestError: It is neither.
    """
    if asked.lower() != "all":
        return fields.read("--devices", int, [asked])
    check_devices()
    import jax

    return len(jax.devices())


@dataclasses.dataclass(frozen=True)
class Device:
    """Where a process may run.

    Attributes:
        name: For people.
        environment: Variables that keep a process to this device.
    """

    name: str
    environment: Mapping[str, str]


# Asked in a process of its own: one that has looked at a GPU holds some of its memory until it ends.
_ASK = """
import json, sys
from jaxrl_vis.devices import check_devices
from jaxrl_vis.errors import RequestError
try:
    check_devices()
except RequestError as error:
    sys.exit(str(error))
import jax
print(json.dumps([[device.platform, device.device_kind] for device in jax.local_devices()]))
"""


def list_devices() -> list[Device]:
    """Each GPU that this process may use; or one entry that leaves everything as it is, where there is one device or no GPU.

    Raises:
        RequestError: JAX finds no device.
    """
    environment = child_environment() | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    done = subprocess.run([sys.executable, "-c", _ASK], env=environment, capture_output=True, text=True)
    lines = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
    if done.returncode or not lines:
        raise RequestError(lines[-1] if lines else "JAX finds no device to compute on")
    found = json.loads(lines[-1])
    (platform, kind), count = found[0], len(found)
    if platform not in ("gpu", "cuda") or count == 1:
        return [Device("the CPU" if platform == "cpu" else kind, {})]
    visible = [word.strip() for word in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if word.strip()]
    names = visible if len(visible) == count else [str(number) for number in range(count)]
    return [Device(f"GPU {name}", {"CUDA_VISIBLE_DEVICES": name}) for name in names]


def shared(devices: Sequence[Device], processes: int) -> list[Device]:
    """Each device so many times, for that many processes side by side on it; GPU memory is divided among them."""
    if processes == 1:
        return list(devices)
    share = {"XLA_PYTHON_CLIENT_MEM_FRACTION": f"{_MOST_MEMORY / processes:.3f}"}
    return [Device(device.name, {**device.environment, **share}) for _ in range(processes) for device in devices]


def guess_accelerator() -> bool:
    """Whether JAX will run on an accelerator: asked without importing JAX, so a guess, for help that comes at once."""
    asked = [word.strip() for word in os.environ.get("JAX_PLATFORMS", "").split(",") if word.strip()]
    if asked:
        return asked[0] != "cpu"
    return any(_is_installed(packages) and _is_there(files) for packages, files in (_NVIDIA, _TPU))


def _is_installed(packages: tuple[str, ...]) -> bool:
    return any(importlib.util.find_spec(package) for package in packages)


def _is_there(files: tuple[str, ...]) -> bool:
    return any(Path(file).exists() for file in files)


def _platforms_without(asked: str) -> str:
    """What JAX finds if it is not told what to use: such as ``cpu``. What it is told stays as it is."""
    import jax
    from jax.extend.backend import clear_backends

    try:
        jax.config.update("jax_platforms", "")
        return jax.default_backend()
    except (RuntimeError, AssertionError):
        return "nothing"
    finally:
        jax.config.update("jax_platforms", asked)
        clear_backends()  # or else the next question would be answered with what was found here


def _mend(asked: str) -> str:
    wanted = {word.strip().lower() for word in asked.split(",")}
    if "cpu" in wanted:
        return "; write JAX_PLATFORMS=cpu"
    packages, files = _NVIDIA
    install = wanted & {"cuda", "gpu"} and _is_there(files) and not _is_installed(packages)
    return "; install this project with the extra cuda12 or cuda13" if install else "; unset JAX_PLATFORMS to run on that"
