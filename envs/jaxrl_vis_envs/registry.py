"""Names of environments, and how to make them. A new built-in task is one file in `tasks` and one line in `names.TASKS`.

Imports no MuJoCo: a built-in task's file is loaded when the task is first made, and registers its own names then.
"""

import dataclasses
import importlib
from collections.abc import Callable
from typing import Any

from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.names import TASKS, nearest, visual_name

_BUILT_IN = {**TASKS, **{visual_name(task): module for task, module in TASKS.items()}}


@dataclasses.dataclass(frozen=True)
class _Entry:
    factory: Callable[[Any], GoalEnv]
    config_class: type
    state_variant: str | None = None


_ENTRIES: dict[str, _Entry] = {}


class UnknownEnvironmentError(ValueError):
    """No environment has that name."""


class UnknownOverrideError(ValueError):
    """The environment's configuration has no field of that name."""


def register(name: str, factory: Callable[[Any], GoalEnv], config_class: type, state_variant: str | None = None) -> None:
    """Adds an environment.

    Args:
        name: What `make` calls it.
        factory: Builds the environment from an instance of ``config_class``.
        config_class: A frozen dataclass, all of whose fields have defaults; its fields are the overrides that `make` takes.
            An environment that observes images has a field ``image_size`` (see `pixels.PixelsConfig`).
        state_variant: The environment with the same physics that observes the state, where there is one.

    Raises:
        ValueError: The name is taken by another factory, or ``config_class`` is not a dataclass.
    """
    if not dataclasses.is_dataclass(config_class):
        raise ValueError(f"config_class of {name!r} must be a dataclass, got {config_class!r}")
    entry = _Entry(factory, config_class, state_variant)
    if _ENTRIES.get(name, entry) != entry:
        raise ValueError(f"an environment called {name!r} exists already; choose another name")
    _ENTRIES[name] = entry


def list_envs() -> list[str]:
    """Names of all environments, sorted."""
    return sorted({*_BUILT_IN, *_ENTRIES})


def config_class(name: str) -> type:
    """The frozen dataclass whose fields `make` takes as overrides.

    Raises:
        UnknownEnvironmentError: No such environment; the message names the nearest ones.
    """
    return _entry(name).config_class


def has_images(name: str) -> bool:
    """Whether the environment observes images, without building it.

    Raises:
        UnknownEnvironmentError: No such environment.
    """
    return any(field.name == "image_size" for field in dataclasses.fields(config_class(name)))


def state_variant(name: str) -> str | None:
    """The environment with the same physics that observes the state, without building it: ``name`` itself, or None.

    Raises:
        UnknownEnvironmentError: No such environment.
    """
    return _entry(name).state_variant if has_images(name) else name


def make(name: str, **overrides: Any) -> GoalEnv:
    """Builds an environment.

    Args:
        name: One of `list_envs`.
        **overrides: Fields of its configuration to change, such as ``image_size=32``.

    Raises:
        UnknownEnvironmentError: No such environment; the message names the nearest ones.
        UnknownOverrideError: No such field; the message names the nearest ones.
        ValueError: A field's value is out of range, or JAX computes in 64 bits and the environment does not.
    """
    entry = _entry(name)
    fields = [field.name for field in dataclasses.fields(entry.config_class)]
    for override in overrides:
        if override not in fields:
            raise UnknownOverrideError(f"{name} has no option {override!r}{nearest(override, fields)}")
    env = entry.factory(entry.config_class(**overrides))
    env.name = name
    return env


def _entry(name: str) -> _Entry:
    if name not in _ENTRIES and name in _BUILT_IN:
        importlib.import_module(_BUILT_IN[name])
    if name not in _ENTRIES:
        raise UnknownEnvironmentError(f"no environment is called {name!r}{nearest(name, list_envs())}")
    return _ENTRIES[name]
