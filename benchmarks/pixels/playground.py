"""MuJoCo Playground's dm_control suite: its tasks on MJX, and the camera of each."""

import logging
from typing import Any

from jaxrl_vis.errors import RequestError

SITE_GROUPS = (0, 1, 2)
"""Groups of sites that `mujoco.Renderer` shows by default: in FingerTurn's tasks one of the sites is the target."""


def suite() -> Any:
    """Import Playground's dm_control suite, whose models come with the package (no download).

    Raises:
        RequestError: Playground is not installed.
    """
    # The import logs a warning if MuJoCo Warp, which is not used here, is missing.
    logging.disable(logging.WARNING)
    try:
        from mujoco_playground import dm_control_suite  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise RequestError(f"the tasks need MuJoCo Playground: pip install playground ({error})") from error
    finally:
        logging.disable(logging.NOTSET)
    return dm_control_suite


def tasks() -> tuple[str, ...]:
    """Return the names of all tasks.

    Raises:
        RequestError: Playground is not installed.
    """
    return tuple(suite().ALL_ENVS)


def load(task: str, **changes: Any) -> Any:
    """Make the environment of a task, with the physics of MJX in JAX.

    Args:
        task: Name of the task.
        **changes: Entries of its configuration.

    Raises:
        RequestError: Playground is not installed, or has no such task.
    """
    module = suite()
    if task not in module.ALL_ENVS:
        raise RequestError(f"there is no task {task!r}; there are {', '.join(module.ALL_ENVS)}")
    config = module.get_default_config(task)
    # The default is MuJoCo Warp, which needs an NVIDIA GPU.
    config.impl = "jax"
    config.update(changes)
    return module.load(task, config=config)


def camera(env: Any) -> str:
    """Return the name of the camera of a task: the first of its model, which dm_control renders by default."""
    return env.mj_model.camera(0).name
