"""The environments: physics, cameras and goals, as traceable JAX functions.

    env = jaxrl_vis_envs.make("VisualFetchReach", image_size=64)
    state = env.reset(jax.random.key(0))

Compile functions of environments with `jit`, which is `jax.jit` with the options that physics needs.

Importing this package loads neither MuJoCo nor JAX, because the learner's leaf modules import only `jaxrl_vis_envs.goals`. The
names below are resolved on first use.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxrl_vis_envs.base import GoalEnv, State
    from jaxrl_vis_envs.compiling.compilation import jit
    from jaxrl_vis_envs.registry import UnknownEnvironmentError, UnknownOverrideError, list_envs, make, register
    from jaxrl_vis_envs.task_modules import TaskModuleError

_HOME = {
    "GoalEnv": "base",
    "State": "base",
    "TaskModuleError": "task_modules",
    "UnknownEnvironmentError": "registry",
    "UnknownOverrideError": "registry",
    "jit": "compiling.compilation",
    "list_envs": "registry",
    "make": "registry",
    "register": "registry",
}

__all__ = [
    "GoalEnv",
    "State",
    "TaskModuleError",
    "UnknownEnvironmentError",
    "UnknownOverrideError",
    "jit",
    "list_envs",
    "make",
    "register",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
