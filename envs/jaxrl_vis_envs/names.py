"""Names of the built-in tasks, and suggestions for misspelt names. Imports neither JAX nor MuJoCo."""

import difflib
from collections.abc import Iterable

TASKS = {
    "FetchPush": "jaxrl_vis_envs.tasks.fetch_push",
    "FetchReach": "jaxrl_vis_envs.tasks.fetch_reach",
    "FingerTurn": "jaxrl_vis_envs.tasks.finger_turn",
    "HandReach": "jaxrl_vis_envs.tasks.hand_reach",
    "PointMass": "jaxrl_vis_envs.tasks.point_mass",
    "Reacher": "jaxrl_vis_envs.tasks.reacher",
    "SawyerReach": "jaxrl_vis_envs.tasks.sawyer_reach",
    "StalkReach": "jaxrl_vis_envs.tasks.stalk_reach",
}
"""Module of each task. It registers two environments: the state variant by this name, and one that observes images."""


def visual_name(task: str) -> str:
    """Return the name of the variant of ``task`` that observes images."""
    return f"Visual{task}"


def nearest(word: str, choices: Iterable[str], otherwise: str | None = None) -> str:
    """Return a hint for a misspelt word: '; did you mean X or Y?', with the nearest of ``choices``.

    Args:
        word: The misspelt word.
        choices: Valid words.
        otherwise: Hint if none is near; None lists all ``choices``.
    """
    lowered = {choice.lower(): choice for choice in choices}
    matches = [lowered[match] for match in difflib.get_close_matches(word.lower(), list(lowered), n=3, cutoff=0.5)]
    if matches:
        return f"; did you mean {' or '.join(matches)}?"
    return f"; choose one of {', '.join(lowered.values())}" if otherwise is None else f"; {otherwise}"
