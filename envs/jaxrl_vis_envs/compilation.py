"""One way to compile anything that contains the world.

XLA's CPU fusion emitters recompute a deep kinematic chain once for every use, which makes MuJoCo's forward kinematics hundreds
of times slower on a CPU. They are switched off per function here, and never by environment variable: a notebook has started JAX
long before this package is imported.

JAX 0.11 has no such option per function any more (it refuses the name). Its emitters do not explode, but leave physics on a CPU
about half as fast (FetchReach, 64 environments, two cores: 1,100 environment steps a second against 2,350).
"""

from collections.abc import Callable
from typing import Any

import jax


def compiler_options(backend: str | None = None, *, runs_once: bool = False) -> dict[str, Any]:
    """Compiler options for programs that contain physics or rendering, for ``backend`` (default: the one JAX runs on).

    ``runs_once`` is for a program that takes longer to compile than to run: a CPU's machine code is then hardly optimised
    (drawing the first parameters of all networks: 2 s to compile in place of 19).
    """
    if (backend or jax.default_backend()) != "cpu":
        return {}
    options: dict[str, Any] = {"xla_backend_optimization_level": 1} if runs_once else {}
    if jax.__version_info__ < (0, 11):
        options["xla_cpu_use_fusion_emitters"] = False
    return options


def env_jit(function: Callable, *, runs_once: bool = False, **jit_options: Any) -> Any:
    """`jax.jit` with the options of `compiler_options`; every jit of a function that moves or draws a world goes through it."""
    return jax.jit(function, compiler_options=compiler_options(runs_once=runs_once), **jit_options)


def runs_gpu_kernels() -> bool:
    """Whether hand-written kernels (Pallas, by Triton) run here: on NVIDIA GPUs of compute capability 8.0 or more.

    Everything that has a kernel has the same function in plain JAX, for all other devices.
    """
    if jax.default_backend() != "gpu":
        return False
    try:
        return float(jax.devices()[0].compute_capability) >= 8.0
    except (AttributeError, TypeError, ValueError):  # another maker's
        return False
