"""Compilation of programs that contain physics or rendering: compiler options, target platform, GPU kernels.

XLA's CPU fusion emitters recompute a deep kinematic chain once for every use, which makes MuJoCo's forward kinematics hundreds
of times slower on a CPU. They are disabled here per function, never by environment variable, because a notebook initialises JAX
long before this package is imported. XLA also delegates small sums to a library with its own threads (YNNPACK), although the
call takes longer than the sum (docs/lab/physics_parity.md).

JAX 0.11 no longer has this option per function, and runs physics on a CPU about half as fast: `make` and the notebooks install
0.10 where there is no GPU (requirements/cpu.in).

On a GPU the many small kernels of a gradient step are launched together, as a CUDA graph. By default XLA chains them; here
independent kernels may run concurrently, which makes gradient steps a tenth to a fifth faster (docs/lab/gradient_step.md).

All matrix products there have one tile, `_TILE`, unless NVIDIA's own kernels are faster: XLA would compile and time some thirty
kernels for each, in four fifths of the compilation time of gradient steps, which became no faster.

Code that is fast on a CPU is slow on a GPU and vice versa, and some functions have a hand-written kernel for NVIDIA GPUs
(Pallas, by Triton). The choice follows the platform that a program is compiled for, which is not always the default backend
(`dispatch_by_platform`). The environment variable ``JAXRL_VIS_KERNELS`` and the context manager `kernels` choose between
kernels and the same functions in plain JAX: ``0`` never uses a kernel, ``1`` uses them on every NVIDIA GPU, and ``auto`` (the
default) uses each kernel of which a small instance compiles. Training does not wait for these instances
(`assume_kernels_compile`).
"""

import concurrent.futures
import contextlib
import functools
import importlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any

import jax

KERNELS_VARIABLE = "JAXRL_VIS_KERNELS"
_CHOICES = {"auto": None, "": None, "0": False, "1": True}

# Platform of the branch of `dispatch_by_platform` that is being traced, choice of `kernels`, and True within
# `assume_kernels_compile`; None outside of them. They are part of the key of JAX's trace cache, so a function that was traced
# for one platform is traced again for another.
_platform = jax.make_user_context(default_value=None)
_kernels = jax.make_user_context(default_value=None)
_assume = jax.make_user_context(default_value=None)
# For a product [M, K] x [K, N] in Triton: rows, columns and depth of a block, then its schedule. Layers here are 50 to 256
# wide. With blocks of half the height or width, gradient steps took 2 to 8 % longer.
_TILE = "block_m: 64 block_n: 64 block_k: 64 num_stages: 3 num_warps: 4 num_ctas: 1"
# Probes of the kernels that were used without compiling their probes.
_assumed: set[Callable[[], object]] = set()


def compiler_options(backend: str | None = None, *, runs_once: bool = False) -> dict[str, Any]:
    """Return the compiler options for programs that contain physics or rendering.

    Args:
        backend: JAX's name of the backend; None for the default backend.
        runs_once: Do not optimise a CPU's machine code, for programs that take longer to compile than to run (initialising all
            networks: 1.2 s to compile instead of 2.3, with bitwise equal results).
    """
    backend = backend or jax.default_backend()
    if backend == "gpu":
        return {
            "xla_gpu_command_buffer_scheduling_mode": "CONCURRENT",
            "xla_gpu_override_gemm_autotuner": _TILE,
            "xla_gpu_experimental_enable_fusion_autotuner": False,
        }
    if backend != "cpu":
        return {}
    options: dict[str, Any] = {"xla_cpu_experimental_ynn_fusion_type": ""}
    if jax.__version_info__ < (0, 11):
        options["xla_cpu_use_fusion_emitters"] = False
    return options | ({"xla_backend_optimization_level": 0} if runs_once else {})


def jit(function: Callable, *, runs_once: bool = False, **jit_options: Any) -> Any:
    """Compile a function that steps or renders environments: `jax.jit` with the options that physics needs.

    Args:
        function: The function to compile.
        runs_once: True for programs that take longer to compile than to run (see `compiler_options`).
        **jit_options: Options of `jax.jit`, such as ``donate_argnums``.
    """
    return jax.jit(function, compiler_options=compiler_options(runs_once=runs_once), **jit_options)


def accelerator() -> str | None:
    """Return the platform other than "cpu" that this process can compile for ("cuda", "rocm", "tpu", ...); None if none."""
    backend = jax.default_backend()
    if backend not in ("cpu", "gpu"):
        return backend
    return next((name for name in ("cuda", "rocm", "tpu") if _has_devices(name)), None)


def _has_devices(platform: str) -> bool:
    try:
        return bool(jax.devices(platform))
    except RuntimeError:  # unknown to this version of JAX, or absent
        return False


def dispatch_by_platform(function: Callable, *arguments: Any) -> Any:
    """Call a function whose implementation depends on the platform (`targets_cpu`, `use_gpu_kernels`).

    In a process with an accelerator the function is traced twice, for the accelerator and for a CPU, and a compiled program
    contains only its own platform's trace, whatever the default backend is: under `jax.jit` with a device or with committed
    arrays, `jax.vmap` and `jax.grad`. Nested calls only call the function.

    Args:
        function: Function from pytrees of arrays to a pytree of arrays, with the same result on all platforms.
        arguments: Positional arguments of the function.

    Returns:
        Result of the function.
    """
    other = accelerator() if _platform.value is None else None
    if other is None:
        return function(*arguments)

    def branch(platform: str) -> Callable:
        def trace(*arguments: Any) -> Any:
            with tracing_for(platform):
                return function(*arguments)

        return trace

    # Code for a CPU is plain JAX, hence valid on any other platform for which a program is exported.
    return jax.lax.platform_dependent(*arguments, default=branch("cpu"), **{other: branch(other)})


@contextlib.contextmanager
def tracing_for(platform: str | None) -> Iterator[None]:
    """Trace for ``platform``; needed by derivative rules, which JAX traces after the branch they belong to."""
    with _platform(platform):
        yield


@contextlib.contextmanager
def tracing_for_default_device() -> Iterator[None]:
    """Trace for JAX's default device only.

    For programs that run only there: functions in `dispatch_by_platform` are traced once instead of twice, which halves the
    time to trace a program of physics and images.
    """
    device = jax.config.jax_default_device
    platform = jax.default_backend() if device is None else getattr(device, "platform", str(device))
    with tracing_for("cpu" if platform == "cpu" else accelerator()):
        yield


def target_platform() -> str:
    """Return the platform of the innermost `tracing_for` or `dispatch_by_platform`, or the default backend outside of them."""
    return _platform.value or jax.default_backend()


def targets_cpu() -> bool:
    """Return True if the current trace is for a CPU."""
    return target_platform() == "cpu"


@contextlib.contextmanager
def kernels(enabled: bool | None) -> Iterator[None]:
    """Trace with kernels on NVIDIA GPUs (True), without them (False), or as the environment variable specifies (None)."""
    with _kernels(enabled):
        yield


@contextlib.contextmanager
def assume_kernels_compile() -> Iterator[None]:
    """Trace with kernels without compiling their probes first, which takes seconds and nearly always succeeds.

    If the program then fails to compile, call `any_kernel_failed`.
    """
    with _assume(True):
        yield


def any_kernel_failed() -> bool:
    """Return True if a kernel used under `assume_kernels_compile` does not compile; print each such kernel to stderr.

    If it returns True, trace the program again outside of `assume_kernels_compile`.
    """
    return not all([_compiles(probe) for probe in sorted(_assumed, key=lambda probe: probe.__module__)])


def use_gpu_kernels(probe: Callable[[], jax.stages.Traced] | None = None) -> bool:
    """Return True if the current trace uses hand-written kernels.

    They are used on NVIDIA GPUs of compute capability 8.0 or more if the probe compiles, unless JAXRL_VIS_KERNELS or `kernels`
    overrides this. Every function with a kernel also exists in plain JAX, for all other devices.

    Args:
        probe: Function that traces a small instance of the kernel, called once per process; if that does not compile, one line
            is printed to stderr. It is not called within `assume_kernels_compile`. None for a kernel that is known to compile.

    Raises:
        ValueError: The environment variable is not 0, 1 or auto.
    """
    chosen = _kernels.value
    if chosen is None:
        chosen = _chosen_by_environment()
    if target_platform() not in ("cuda", "gpu") or chosen is False:
        return False
    _register_triton_dialect()
    if chosen is True or not _has_tensor_cores() or probe is None:
        return chosen is True or _has_tensor_cores()
    if _assume.value:
        _assumed.add(probe)
        return True
    return _compiles(probe)


def _chosen_by_environment() -> bool | None:
    value = os.environ.get(KERNELS_VARIABLE, "auto").strip().lower()
    if value not in _CHOICES:
        raise ValueError(f"{KERNELS_VARIABLE} is {value!r}: set it to 0 (plain JAX), 1 (kernels) or auto")
    return _CHOICES[value]


@functools.cache
def _register_triton_dialect() -> None:
    """Register the Python module of Triton's dialect under the name at which MLIR looks for it.

    MLIR tries to import it for nearly every value of a kernel, and Python does not cache failed imports: without this, they
    take a third of the time to lower a program with kernels.
    """
    with contextlib.suppress(ImportError):
        sys.modules.setdefault("jaxlib.mlir.dialects.tt", importlib.import_module("jaxlib.triton.dialect"))


def _has_tensor_cores() -> bool:
    """Return True if there is an NVIDIA GPU of compute capability 8.0 or more, which Pallas requires."""
    try:
        return float(jax.devices("cuda")[0].compute_capability) >= 8.0
    except (RuntimeError, AttributeError, TypeError, ValueError):  # no GPU, or not NVIDIA's
        return False


@functools.cache
def _compiles(probe: Callable[[], jax.stages.Traced]) -> bool:
    """Return True if a probe compiles for the first NVIDIA GPU; otherwise print the reason to stderr. Cached per probe."""
    gpu = jax.devices("cuda")[0]

    def compile_it() -> None:
        with jax.default_device(gpu), tracing_for("cuda"):
            probe().lower().compile()

    try:
        # Probes are called during unrelated traces; the current trace is thread-local.
        # (`jax.ensure_compile_time_eval` would also evaluate the inside of the kernel, which is impossible.)
        with concurrent.futures.ThreadPoolExecutor(1) as pool:
            pool.submit(compile_it).result()
    except Exception as error:  # Pallas, Triton, ptxas and XLA each raise their own types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        with contextlib.suppress(OSError, ValueError):  # stderr cannot be written
            print(
                f"jaxrl-vis: a GPU kernel ({probe.__module__}) does not compile on {gpu.device_kind}, so plain JAX takes its "
                f"place ({KERNELS_VARIABLE}=0 does so without trying): {reason}",
                file=sys.stderr,
            )
        return False
    return True
