"""Names of worlds, and how to make them. A new world is one file in `tasks` and one line in `_BUILT_IN`.

Imports no MuJoCo: a built-in task's file is loaded when the task is first made, and registers its own names then.
"""

import dataclasses
import difflib
import importlib
from collections.abc import Callable, Iterable
from typing import Any

from jaxrl_vis_envs.base import GoalEnv

_BUILT_IN = {
    "FetchReach": "jaxrl_vis_envs.tasks.fetch_reach",
    "FingerTurn": "jaxrl_vis_envs.tasks.finger_turn",
    "HandReach": "jaxrl_vis_envs.tasks.hand_reach",
    "Reacher": "jaxrl_vis_envs.tasks.reacher",
    "SawyerReach": "jaxrl_vis_envs.tasks.sawyer_reach",
    "VisualFetchReach": "jaxrl_vis_envs.tasks.fetch_reach",
    "VisualFingerTurn": "jaxrl_vis_envs.tasks.finger_turn",
    "VisualHandReach": "jaxrl_vis_envs.tasks.hand_reach",
    "VisualReacher": "jaxrl_vis_envs.tasks.reacher",
    "VisualSawyerReach": "jaxrl_vis_envs.tasks.sawyer_reach",
}


@dataclasses.dataclass(frozen=True)
class _Entry:
    factory: Callable[[Any], GoalEnv]
    config_class: type


_ENTRIES: dict[str, _Entry] = {}


class UnknownEnvironmentError(ValueError):
    """No world has that name."""


class UnknownOverrideError(ValueError):
    """The world's configuration has no field of that name."""


def register(name: str, factory: Callable[[Any], GoalEnv], config_class: type) -> None:
    """Adds a world.

    Args:
        name: What `make` calls it.
        factory: Builds the environment from an instance of ``config_class``.
        config_class: A frozen dataclass, all of whose fields have defaults; its fields are the overrides that `make` takes.

    Raises:
        ValueError: The name is taken by another factory, or ``config_class`` is not a dataclass.
    """
    if not dataclasses.is_dataclass(config_class):
        raise ValueError(f"config_class of {name!r} must be a dataclass, got {config_class!r}")
    entry = _Entry(factory, config_class)
    if _ENTRIES.get(name, entry) != entry:
        raise ValueError(f"an environment called {name!r} exists already; choose another name")
    _ENTRIES[name] = entry


def list_envs() -> list[str]:
    """Names of all worlds, sorted."""
    return sorted({*_BUILT_IN, *_ENTRIES})


def config_class(name: str) -> type:
    """The frozen dataclass whose fields `make` takes as overrides.

    Raises:
        UnknownEnvironmentError: No such world; the message names the nearest ones.
    """
    return _entry(name).config_class


def make(name: str, **overrides: Any) -> GoalEnv:
    """Builds a world.

    Args:
        name: One of `list_envs`.
        **overrides: Fields of its configuration to change, such as ``image_size=32``.

    Raises:
        UnknownEnvironmentError: No such world; the message names the nearest ones.
        UnknownOverrideError: No such field; the message names the nearest ones.
        ValueError: A field's value is out of range.
    """
    entry = _entry(name)
    fields = [field.name for field in dataclasses.fields(entry.config_class)]
    for override in overrides:
        if override not in fields:
            raise UnknownOverrideError(f"{name} has no option {override!r}{_nearest(override, fields)}")
    env = entry.factory(entry.config_class(**overrides))
    env.name = name
    return env


def _entry(name: str) -> _Entry:
    if name not in _ENTRIES and name in _BUILT_IN:
        importlib.import_module(_BUILT_IN[name])
    if name not in _ENTRIES:
        raise UnknownEnvironmentError(f"no environment is called {name!r}{_nearest(name, list_envs())}")
    return _ENTRIES[name]


def _nearest(word: str, choices: Iterable[str]) -> str:
    """'; did you mean X?', or all ``choices`` where none is near ``word``."""
    lowered = {choice.lower(): choice for choice in choices}
    found = [lowered[match] for match in difflib.get_close_matches(word.lower(), list(lowered), n=3, cutoff=0.5)]
    return f"; did you mean {' or '.join(found)}?" if found else f"; choose one of {', '.join(lowered.values())}"
