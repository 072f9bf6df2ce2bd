"""Lookup of the environment behind an adapter, by name or as an existing object."""

from typing import Any

from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.registry import make


def goal_env(env: Any, overrides: dict[str, Any]) -> GoalEnv:
    """Return the environment behind an adapter.

    Args:
        env: Name of an environment, or a `GoalEnv`.
        overrides: Configuration overrides for a named environment.

    Raises:
        ValueError: As in `jaxrl_vis_envs.make`; or ``env`` is neither, or there are overrides for an existing `GoalEnv`.
    """
    if isinstance(env, str):
        return make(env, **overrides)
    if not isinstance(env, GoalEnv):
        kind = f"the class {env.__name__}" if isinstance(env, type) else f"a {type(env).__name__}"
        raise ValueError(f"env must be the name of an environment, or an existing GoalEnv, got {kind}")
    if overrides:
        raise ValueError(f"{', '.join(overrides)}: options can be changed for a named environment, not for an existing one")
    return env
