"""How programs that contain physics or rendering are compiled: with which options, for which platform, with which kernels.

XLA's CPU fusion emitters recompute a deep kinematic chain once for every use, which makes MuJoCo's forward kinematics hundreds
of times slower on a CPU. They are switched off per function here, and never by environment variable: a notebook has started JAX
long before this package is imported. XLA also hands small sums over to a library (YNNPACK), with threads of its own, although
to call it takes longer than to add a few numbers: without, FetchReach in 16 environments is simulated 1.3 times as fast on two
cores, and gradient steps take up to a seventh less.

JAX 0.11 has no such option per function any more (it refuses the name). Its emitters do not explode, but leave physics on a CPU
about half as fast (FetchReach, 64 environments, two cores: 1,100 environment steps a second against 2,350). So `make` and the
notebooks install 0.10 where there is no GPU (requirements/cpu.in).

On a GPU the many small kernels of a gradient step are launched together, as a CUDA graph. XLA makes a chain of them, unless
it is told that those which do not wait for each other may run side by side: a gradient step of VisualFetchReach (64x64, H100)
then took 548 us in place of 689 with the preset paper, and 438 in place of 489 with fast.

XLA also looks for the best tile of every product of matrices there, by compiling some thirty kernels for each and timing them.
That was four fifths of what it took to compile gradient steps (66 to 75 processor seconds in place of 18), for steps no faster
than with one tile for all of them (paper 544 us and 540 to 562, fast 379 and 377 us), which is `_TILE`. Where one of NVIDIA's
own kernels is faster, as with large matrices, XLA still takes that.

What is fast on a CPU is slow on a GPU and vice versa, and some functions have a hand-written kernel for NVIDIA GPUs
(Pallas, by Triton). Which of these is used follows the platform that a program is compiled for, which is not always that of the
default backend: `by_platform`. The environment variable ``JAXRL_VIS_KERNELS`` and the context manager `kernels` choose between
the kernels and the same functions in plain JAX: ``0`` never uses a kernel, ``1`` uses them on every NVIDIA GPU, and ``auto``
(the default) uses each where a small instance of it compiles. A run does not wait for those: `trusting_kernels`.
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

# The platform of the branch of `by_platform` that is being traced, the choice of `kernels`, and whether this is within
# `trusting_kernels`; None outside of them. They are part of what JAX knows a traced function by, so that one which was traced
# for a platform is traced again for another.
_platform = jax.make_user_context(default_value=None)
_kernels = jax.make_user_context(default_value=None)
_trust = jax.make_user_context(default_value=None)
# Of a product [M, K] x [K, N] in Triton: rows, columns and depth of a block, then how it is computed. Layers here are 50 to 256
# wide. Blocks half as high or as wide took 2 to 8 % longer a gradient step.
_TILE = "block_m: 64 block_n: 64 block_k: 64 num_stages: 3 num_warps: 4 num_ctas: 1"
# Of the kernels that were used without asking.
_trusted: set[Callable[[], object]] = set()


def compiler_options(backend: str | None = None, *, runs_once: bool = False) -> dict[str, Any]:
    """Compiler options for programs that contain physics or rendering, for ``backend`` (default: the one JAX runs on).

    ``runs_once`` is for a program that takes longer to compile than to run: a CPU's machine code is then not optimised
    (drawing the first parameters of all networks: 1.2 s to compile in place of 2.3, and the same bits).
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


def env_jit(function: Callable, *, runs_once: bool = False, **jit_options: Any) -> Any:
    """`jax.jit` with the options of `compiler_options`; every jit of a function that steps or draws environments uses it.

    Args:
        function: The function to compile.
        runs_once: It takes longer to compile than to run; see `compiler_options`.
        **jit_options: Of `jax.jit`, such as ``donate_argnums``.
    """
    return jax.jit(function, compiler_options=compiler_options(runs_once=runs_once), **jit_options)


def accelerator() -> str | None:
    """The platform besides "cpu" that this process can compile for: "cuda", "rocm", "tpu" or another's name; None for none."""
    backend = jax.default_backend()
    if backend not in ("cpu", "gpu"):
        return backend
    return next((name for name in ("cuda", "rocm", "tpu") if _has_devices(name)), None)


def _has_devices(platform: str) -> bool:
    try:
        return bool(jax.devices(platform))
    except RuntimeError:  # unknown to this JAX, or not there
        return False


def by_platform(function: Callable, *arguments: Any) -> Any:
    """Calls a function that asks for its platform (`targets_cpu`, `runs_gpu_kernels`) and has the same result on all of them.

    In a process with an accelerator the function is traced twice, for that and for a CPU, and a program that is compiled for
    either contains only the one for it, whatever the default backend is: under `jax.jit` with a device or with committed
    arrays, `jax.vmap`, `jax.grad`. Within such a call further ones do nothing.

    Args:
        function: Takes pytrees of arrays and returns one.
        arguments: What it is called with.

    Returns:
        Its result.
    """
    other = accelerator() if _platform.value is None else None
    if other is None:
        return function(*arguments)

    def branch(platform: str) -> Callable:
        def trace(*arguments: Any) -> Any:
            with tracing_for(platform):
                return function(*arguments)

        return trace

    # What is written for a CPU is plain JAX, so it is right for any other platform that a program is exported to.
    return jax.lax.platform_dependent(*arguments, default=branch("cpu"), **{other: branch(other)})


@contextlib.contextmanager
def tracing_for(platform: str | None) -> Iterator[None]:
    """What is traced inside is for ``platform``; for rules of derivatives, which JAX traces after the branch they belong to."""
    with _platform(platform):
        yield


@contextlib.contextmanager
def tracing_for_default_device() -> Iterator[None]:
    """What is traced inside is for the device that JAX uses where nobody names one.

    For programs that will run there and nowhere else: functions of `by_platform` are traced once in place of twice, which
    halves the time that a program of physics and images takes to trace.
    """
    device = jax.config.jax_default_device
    platform = jax.default_backend() if device is None else getattr(device, "platform", str(device))
    with tracing_for("cpu" if platform == "cpu" else accelerator()):
        yield


def target_platform() -> str:
    """The platform of the innermost `tracing_for` or branch of `by_platform`; outside of them, the default backend."""
    return _platform.value or jax.default_backend()


def targets_cpu() -> bool:
    """Whether what is being traced is for a CPU."""
    return target_platform() == "cpu"


@contextlib.contextmanager
def kernels(enabled: bool | None) -> Iterator[None]:
    """What is traced inside uses kernels on NVIDIA GPUs (True), never does (False), or as the environment says (None)."""
    with _kernels(enabled):
        yield


@contextlib.contextmanager
def trusting_kernels() -> Iterator[None]:
    """What is traced inside uses kernels without asking first whether they compile: asking takes seconds, and nearly all do.

    Whoever compiles the program asks afterwards if it does not compile: `distrusted_kernels`.
    """
    with _trust(True):
        yield


def distrusted_kernels() -> bool:
    """Whether any kernel that `trusting_kernels` has let into a program does not compile; one line on stderr names each.

    If so, what was traced there is worth another try, outside of it.
    """
    return not all([_compiles(probe) for probe in sorted(_trusted, key=lambda probe: probe.__module__)])


def runs_gpu_kernels(probe: Callable[[], object] | None = None) -> bool:
    """Whether hand-written kernels are used in what is being traced.

    They are on NVIDIA GPUs of compute capability 8.0 or more where the probe compiles, unless JAXRL_VIS_KERNELS or `kernels`
    says otherwise. Everything that has a kernel has the same function in plain JAX, for all other devices.

    Args:
        probe: Compiles a small instance of the kernel, and raises whatever that raises. It is called once in a process; if it
            raises, one line on stderr says so. Within `trusting_kernels` it is not called. None for a kernel that is known to
            compile.

    Raises:
        ValueError: The environment variable holds something else than 0, 1 or auto.
    """
    chosen = _kernels.value
    if chosen is None:
        chosen = _chosen_by_environment()
    if target_platform() not in ("cuda", "gpu") or chosen is False:
        return False
    _name_triton_dialect()
    if chosen is True or not _has_tensor_cores() or probe is None:
        return chosen is True or _has_tensor_cores()
    if _trust.value:
        _trusted.add(probe)
        return True
    return _compiles(probe)


def _chosen_by_environment() -> bool | None:
    value = os.environ.get(KERNELS_VARIABLE, "auto").strip().lower()
    if value not in _CHOICES:
        raise ValueError(f"{KERNELS_VARIABLE} is {value!r}: set it to 0 (plain JAX), 1 (kernels) or auto")
    return _CHOICES[value]


@functools.cache
def _name_triton_dialect() -> None:
    """Lets MLIR find the Python module of Triton's dialect, which jaxlib keeps elsewhere than MLIR expects it.

    It looks for one, by an import, for nearly every value of a kernel, and Python does not remember that an import has failed:
    a third of the time that it takes to lower a program with kernels.
    """
    with contextlib.suppress(ImportError):
        sys.modules.setdefault("jaxlib.mlir.dialects.tt", importlib.import_module("jaxlib.triton.dialect"))


def _has_tensor_cores() -> bool:
    """Whether there is an NVIDIA GPU of compute capability 8.0 or more, which is what Pallas asks for."""
    try:
        return float(jax.devices("cuda")[0].compute_capability) >= 8.0
    except (RuntimeError, AttributeError, TypeError, ValueError):  # none there, or another maker's
        return False


@functools.cache
def _compiles(probe: Callable[[], object]) -> bool:
    """Whether a probe compiles for the first NVIDIA GPU."""
    gpu = jax.devices("cuda")[0]

    def compile_it() -> None:
        with jax.default_device(gpu), tracing_for("cuda"):
            probe()

    try:
        # Probes are called while something else is traced, of which they are no part: what is being traced is a thread's own.
        # (`jax.ensure_compile_time_eval` would evaluate the insides of the kernel, too, which nothing can.)
        with concurrent.futures.ThreadPoolExecutor(1) as pool:
            pool.submit(compile_it).result()
    except Exception as error:  # Pallas, Triton, ptxas and XLA each have their own
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        with contextlib.suppress(OSError, ValueError):  # nobody can read it
            print(
                f"jaxrl-vis: a GPU kernel ({probe.__module__}) does not compile on {gpu.device_kind}, so plain JAX takes its "
                f"place ({KERNELS_VARIABLE}=0 does so without trying): {reason}",
                file=sys.stderr,
            )
        return False
    return True
