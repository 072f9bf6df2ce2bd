"""Names of the built-in tasks, and help with misspelt names. Loads neither JAX nor MuJoCo."""

import difflib
from collections.abc import Iterable

TASKS = {
    "FetchReach": "jaxrl_vis_envs.tasks.fetch_reach",
    "FingerTurn": "jaxrl_vis_envs.tasks.finger_turn",
    "HandReach": "jaxrl_vis_envs.tasks.hand_reach",
    "Reacher": "jaxrl_vis_envs.tasks.reacher",
    "SawyerReach": "jaxrl_vis_envs.tasks.sawyer_reach",
    "StalkReach": "jaxrl_vis_envs.tasks.stalk_reach",
}
"""The module of each task. It registers two environments: one that sees the state, by this name, and one that sees images."""


def visual_name(task: str) -> str:
    """The name of the environment that sees images of ``task``."""
    return f"Visual{task}"


def nearest(word: str, choices: Iterable[str], otherwise: str | None = None) -> str:
    """How to mend a misspelt word: '; did you mean X or Y?', with the nearest of ``choices``.

    Args:
        word: What was given.
        choices: What is allowed.
        otherwise: What to say where none is near; None for a list of all ``choices``.
    """
    lowered = {choice.lower(): choice for choice in choices}
    found = [lowered[match] for match in difflib.get_close_matches(word.lower(), list(lowered), n=3, cutoff=0.5)]
    if found:
        return f"; did you mean {' or '.join(found)}?"
    return f"; choose one of {', '.join(lowered.values())}" if otherwise is None else f"; {otherwise}"
