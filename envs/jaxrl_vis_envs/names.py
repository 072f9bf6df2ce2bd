"""Names of the built-in tasks, and help with misspelt names. Loads neither JAX nor MuJoCo."""

import difflib
from collections.abc import Iterable

TASKS = {
    "FetchReach": "jaxrl_vis_envs.tasks.fetch_reach",
    "FingerTurn": "jaxrl_vis_envs.tasks.finger_turn",
    "HandReach": "jaxrl_vis_envs.tasks.hand_reach",
    "Reacher": "jaxrl_vis_envs.tasks.reacher",
    "SawyerReach": "jaxrl_vis_envs.tasks.sawyer_reach",
}
"""The module of each task. It registers two environments: one that sees the state, by this name, and one that sees images."""


def visual_name(task: str) -> str:
    """The name of the environment that sees images of ``task``."""
    return f"Visual{task}"


def nearest(word: str, choices: Iterable[str]) -> str:
    """'; did you mean X or Y?' for a misspelt ``word``, or a list of all ``choices`` when none is near."""
    lowered = {choice.lower(): choice for choice in choices}
    found = [lowered[match] for match in difflib.get_close_matches(word.lower(), list(lowered), n=3, cutoff=0.5)]
    return f"; did you mean {' or '.join(found)}?" if found else f"; choose one of {', '.join(lowered.values())}"
