"""Registry of environments and their construction. A new built-in task is one file in `tasks` and one line in `names.TASKS`.

    Reacher             built in, added with `register`, or provided by an installed package (see `task_modules`)
    my_task:MyReach     in a module of your own: a subclass of `GoalEnv`, or an environment the module registers by that name

Imports no MuJoCo: the file of a task is loaded when the task is first requested, and then registers its own names.
"""

import dataclasses
import importlib
import inspect
import typing
from collections.abc import Callable
from types import ModuleType
from typing import Any

from jaxrl_vis_envs import task_modules
from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.names import TASKS, nearest, visual_name
from jaxrl_vis_envs.task_modules import TaskModuleError

_BUILT_IN = {**TASKS, **{visual_name(task): module for task, module in TASKS.items()}}
# Attributes every environment must define.
_CONSTANTS = ("horizon", "action_size", "threshold", "control_period")
# Positional parameters of its methods.
_METHODS = {"reset": ("key",), "advance": ("state", "action"), "observe": ("state",)}


@dataclasses.dataclass(frozen=True)
class _Entry:
    factory: Callable[[Any], GoalEnv]
    config_class: type
    state_variant: str | None = None


_ENTRIES: dict[str, _Entry] = {}


class UnknownEnvironmentError(ValueError):
    """Error for a name that matches no environment, several, or one that is incomplete."""


class UnknownOverrideError(ValueError):
    """Error for an override that is not a field of the environment's configuration."""


def register(name: str, factory: Callable[[Any], GoalEnv], config_class: type, state_variant: str | None = None) -> None:
    """Register an environment.

    Args:
        name: Name for `make`.
        factory: Function that builds the environment from an instance of ``config_class``.
        config_class: Frozen dataclass whose fields all have defaults; they are the overrides that `make` accepts. An
            environment that observes images has a field ``image_size`` (see `pixels.PixelsConfig`).
        state_variant: Name of the environment with the same physics that observes the state, if there is one.

    Raises:
        ValueError: The name is registered with another factory or is not a word, ``factory`` is not callable, or
            ``config_class`` is not such a dataclass.
    """
    if not isinstance(name, str) or not name or task_modules.is_custom(name):
        raise ValueError(f"the name of an environment must be a word without a colon, such as 'MyReach', got {name!r}")
    if not callable(factory):
        raise ValueError(f"factory of {name!r} must be a function from its configuration, got {factory!r}")
    if not (isinstance(config_class, type) and dataclasses.is_dataclass(config_class)):
        raise ValueError(f"config_class of {name!r} must be a dataclass, got {config_class!r}")
    missing = _without_default(config_class)
    if missing is not None:
        raise ValueError(f"{config_class.__name__}.{missing} of {name!r} needs a default")
    entry = _Entry(factory, config_class, state_variant)
    if _ENTRIES.get(name, entry) != entry or _BUILT_IN.get(name, config_class.__module__) != config_class.__module__:
        raise ValueError(f"an environment called {name!r} exists already; choose another name")
    _ENTRIES[name] = entry


def list_envs() -> list[str]:
    """Return the sorted names of all environments that are built in, registered, or provided by installed packages."""
    return sorted({*_BUILT_IN, *_ENTRIES, *task_modules.entry_points()})


def is_built_in(name: str) -> bool:
    """Return True if the environment is part of this package."""
    return name in _BUILT_IN


def config_class(name: str) -> type:
    """Return the configuration dataclass of an environment, whose fields `make` accepts as overrides.

    Raises:
        UnknownEnvironmentError: There is no such environment; the message suggests the nearest names.
        TaskModuleError: Its module cannot be imported.
    """
    return _entry(name).config_class


def has_images(name: str) -> bool:
    """Return True if the environment observes images, without building it.

    Raises:
        UnknownEnvironmentError: There is no such environment.
        TaskModuleError: Its module cannot be imported.
    """
    return any(field.name == "image_size" for field in dataclasses.fields(config_class(name)))


def state_variant(name: str) -> str | None:
    """Return the name of the environment with the same physics that observes the state, without building it.

    Returns:
        ``name`` itself if it observes the state; None if there is no such variant.

    Raises:
        UnknownEnvironmentError: There is no such environment.
        TaskModuleError: Its module cannot be imported.
    """
    variant = _entry(name).state_variant if has_images(name) else name
    if variant is None or not task_modules.is_custom(name) or task_modules.is_custom(variant):
        return variant
    return f"{task_modules.split(name)[0]}:{variant}"


def visual_variant(name: str) -> str | None:
    """Return the name of the environment with the same physics that observes images, without building it; None if none.

    Raises:
        UnknownEnvironmentError: There is no such environment.
        TaskModuleError: Its module cannot be imported.
    """
    if has_images(name):
        return name
    module, colon, task = name.rpartition(":")
    visual = f"{module}{colon}{visual_name(task)}"
    try:
        return visual if state_variant(visual) == name else None
    except UnknownEnvironmentError:
        return None


def load(name: str, folder: str | None = None) -> str | None:
    """Import the module of an environment and return its folder, so that it can be found again from another working directory.

    Args:
        name: Name of an environment.
        folder: For ``module:Name``, folder from which the module was imported earlier, searched before the current folder.

    Returns:
        Folder that must be on Python's path to import the module of ``module:Name``; None for an installed module, and for all
        other names.

    Raises:
        UnknownEnvironmentError: There is no such environment; the message suggests the nearest names.
        TaskModuleError: Its module cannot be imported.
    """
    _entry(name, folder)
    if not task_modules.is_custom(name):
        return None
    return task_modules.import_root(task_modules.load(task_modules.split(name)[0], folder))


def make(name: str, **overrides: Any) -> GoalEnv:
    """Build an environment.

    Args:
        name: One of `list_envs`, or ``module:Name`` for one in a module of your own, in the current folder or importable.
        **overrides: Fields of its configuration to change, such as ``image_size=32``.

    Raises:
        UnknownEnvironmentError: There is no such environment; the message suggests the nearest names.
        UnknownOverrideError: There is no such field; the message suggests the nearest names.
        TaskModuleError: Its module cannot be imported, or the environment cannot be built.
        ValueError: A field's value is out of range, the environment lacks an attribute or a method has the wrong parameters, or
            JAX runs in 64 bits and the environment does not support it.
    """
    entry = _entry(name)
    fields = [field.name for field in dataclasses.fields(entry.config_class)]
    for override in overrides:
        if override not in fields:
            raise UnknownOverrideError(f"{name} has no option {override!r}{nearest(override, fields)}")
    env = _build(name, entry, entry.config_class(**overrides))
    if not isinstance(env, GoalEnv):
        raise ValueError(f"{name} is not an environment but {env!r}: its factory must return a jaxrl_vis_envs.GoalEnv")
    for constant in _CONSTANTS:
        if not hasattr(env, constant):
            raise ValueError(f"{name} has no {constant}: every environment must define {', '.join(_CONSTANTS)}")
    for method, parameters in _METHODS.items():
        signature = inspect.signature(getattr(env, method))
        try:
            signature.bind(*parameters)
        except TypeError:
            raise ValueError(f"{name}: {method} must take ({', '.join(parameters)}), not {signature}") from None
    env.name = name
    return env


def _build(name: str, entry: _Entry, config: Any) -> GoalEnv:
    if name in _BUILT_IN:
        return entry.factory(config)
    try:
        return entry.factory(config)
    except ValueError:
        raise
    except Exception as error:  # noqa: BLE001 - user code may raise anything
        file = inspect.getsourcefile(entry.config_class)
        raise TaskModuleError(f"{name} cannot be built: {task_modules.describe_error(error, file)}") from error


def _entry(name: str, folder: str | None = None) -> _Entry:
    if not isinstance(name, str):
        raise UnknownEnvironmentError(
            f"an environment is requested by its name, or as 'module:Name' for one of your own, not by {name!r}"
        )
    if task_modules.is_custom(name):
        module, task = task_modules.split(name)
        return _module_entry(name, task_modules.load(module, folder), task)
    if name not in _ENTRIES and name in _BUILT_IN:
        importlib.import_module(_BUILT_IN[name])
    if name in _ENTRIES:
        return _ENTRIES[name]
    points = task_modules.entry_points().get(name, [])
    if not points:
        hint = nearest(name, list_envs())
        if "." in name:
            hint = "; a task of your own is written module:Name, such as my_task:MyReach"
        raise UnknownEnvironmentError(f"unknown environment {name!r}{hint}")
    if len(points) > 1:
        choices = " or ".join(sorted(point.value for point in points))
        raise UnknownEnvironmentError(f"several installed packages have a {name}: request {choices}")
    (point,) = points
    return _module_entry(name, task_modules.load(point.module, installed=True), point.attr)


def _module_entry(name: str, module: ModuleType, task: str) -> _Entry:
    """Return the entry of ``task`` in a module: the one that it registered under that name, or else one for its class.

    Raises:
        UnknownEnvironmentError: There is none, or it is not a complete environment.
    """
    registered = {
        registered_name: entry
        for registered_name, entry in _ENTRIES.items()
        if registered_name not in _BUILT_IN and f"{entry.config_class.__module__}.".startswith(f"{module.__name__}.")
    }
    if task in registered:
        return registered[task]
    if not hasattr(module, task):
        classes = [attribute for attribute, value in vars(module).items() if _is_task(value) and not inspect.isabstract(value)]
        choices = sorted({*registered, *classes})
        hint = nearest(task, choices) if choices else ", nor any other subclass of jaxrl_vis_envs.GoalEnv"
        raise UnknownEnvironmentError(f"{module.__name__} has no {task}{hint}")
    task_class = getattr(module, task)
    if not _is_task(task_class):
        kind = "a class" if inspect.isclass(task_class) else f"of type {type(task_class).__name__}"
        raise UnknownEnvironmentError(
            f"{name} is not an environment but {kind}: it must be a subclass of jaxrl_vis_envs.GoalEnv"
        )
    if inspect.isabstract(task_class):
        missing = ", ".join(sorted(task_class.__abstractmethods__))
        raise UnknownEnvironmentError(f"{name} is not complete: it must define {missing}")
    return _class_entry(name, task_class)


def _class_entry(name: str, task: type[GoalEnv]) -> _Entry:
    """Build an entry from a task's class, which is constructed as ``task(config)`` with an annotated ``config``.

    Raises:
        UnknownEnvironmentError: ``config`` is not annotated with a dataclass, or a field of that has no default.
    """
    build: Any = task
    parameters = list(inspect.signature(task).parameters.values())
    if not parameters:
        return _Entry(lambda config: build(), _NoSettings)
    first = parameters[0].name
    try:
        settings = typing.get_type_hints(task.__init__).get(first)
    except NameError as error:
        raise UnknownEnvironmentError(f"the annotations of {name} cannot be read: {error}") from error
    if not (isinstance(settings, type) and dataclasses.is_dataclass(settings)):
        raise UnknownEnvironmentError(
            f"the settings of {name} are unknown: annotate {first!r} of its __init__ with a dataclass of them"
        )
    missing = _without_default(settings)
    if missing is not None:
        raise UnknownEnvironmentError(f"{settings.__name__}.{missing} of {name} needs a default")
    return _Entry(build, settings)


def _without_default(settings: Any) -> str | None:
    """Return the name of the first dataclass field without a default; None if all have one."""
    for field in dataclasses.fields(settings):
        if field.init and field.default is field.default_factory is dataclasses.MISSING:
            return field.name
    return None


@dataclasses.dataclass(frozen=True)
class _NoSettings:
    """Empty configuration, for an environment without settings."""


def _is_task(value: Any) -> bool:
    return inspect.isclass(value) and issubclass(value, GoalEnv)
