"""Which environment an adapter is for: one that is made by its name, or one that there is already."""

from typing import Any

from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.registry import make


def goal_env(env: Any, overrides: dict[str, Any]) -> GoalEnv:
    """The environment behind an adapter.

    Args:
        env: The name of an environment, or a `GoalEnv`.
        overrides: Options that go with the name.

    Raises:
        ValueError: As `jaxrl_vis_envs.make`; or ``env`` is neither, or there are options for one that is made already.
    """
    if isinstance(env, str):
        return make(env, **overrides)
    if not isinstance(env, GoalEnv):
        kind = f"the class {env.__name__}" if isinstance(env, type) else f"a {type(env).__name__}"
        raise ValueError(f"env must be the name of an environment, or a GoalEnv that is made already, got {kind}")
    if overrides:
        raise ValueError(
            f"{', '.join(overrides)}: options go with the name of an environment, not with one that is made already"
        )
    return env
