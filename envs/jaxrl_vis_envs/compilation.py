"""One way to compile anything that contains the world.

XLA's CPU fusion emitters recompute a deep kinematic chain once for every use, which makes MuJoCo's forward kinematics hundreds
of times slower on a CPU. They are switched off per function here, and never by environment variable: a notebook has started JAX
long before this package is imported.
"""

from collections.abc import Callable
from typing import Any

import jax


def compiler_options(backend: str | None = None) -> dict[str, Any]:
    """Compiler options for programs that contain physics or rendering, for ``backend`` (default: the one JAX runs on)."""
    if (backend or jax.default_backend()) == "cpu":
        return {"xla_cpu_use_fusion_emitters": False}
    return {}


def world_jit(function: Callable, **jit_options: Any) -> Any:
    """`jax.jit` with the options of `compiler_options`; every jit of a function that moves or draws a world goes through it."""
    return jax.jit(function, compiler_options=compiler_options(), **jit_options)
