"""Lookup of a run's components: built-in ones by name, custom ones as ``module:Name``. Imports no JAX by itself.

Applies to algorithms, reward methods, auxiliary losses and weightings, and likewise to tasks (`jaxrl_vis_envs.task_modules`). A
module is imported from ``Config.env_folder``, else from the current folder, else from Python's search path.
"""

from collections.abc import Mapping
from types import ModuleType
from typing import Any, TypeVar

from jaxrl_vis.config import Config, fields
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis_envs import task_modules

T = TypeVar("T")


def custom_names(config: Config) -> dict[str, str]:
    """Return the custom components ``module:Name`` of a configuration, by role: task, algorithm, aux_tasks 1, ..."""
    names = {"task": config.environment.env}
    for field, hint in fields.hints(Config).items():
        if not fields.names_components(hint):
            continue
        value = config.value(field)
        names |= (
            {f"{field} {number}": name for number, name in enumerate(value, 1)} if isinstance(value, tuple) else {field: value}
        )
    return {kind: name for kind, name in names.items() if task_modules.is_custom(name)}


def find_component(kind: str, name: str, known: Mapping[str, T], folder: str | None = None) -> T | Any:
    """Return a component by name; a ``module:Name`` is imported.

    Args:
        kind: Kind of the component, for messages.
        name: A key of ``known``, or ``module:Name``.
        known: Built-in components by name.
        folder: Folder from which modules are imported first; None to begin with the current folder.

    Raises:
        RequestError: There is no such component, or its module cannot be imported.
    """
    if not task_modules.is_custom(name):
        if name not in known:
            raise RequestError(f"unknown {kind} {name!r}{nearest(name, known)}")
        return known[name]
    module, attribute = load(name, folder)
    if not hasattr(module, attribute):
        names = [public for public in vars(module) if not public.startswith("_")]
        raise RequestError(f"{module.__name__} has no {attribute}{nearest(attribute, names)}")
    return getattr(module, attribute)


def load(name: str, folder: str | None = None) -> tuple[ModuleType, str]:
    """Import the module of ``module:Name``; return it and ``Name``. For ``folder`` see `find_component`.

    Raises:
        RequestError: ``name`` does not have this form, or the module cannot be imported.
    """
    try:
        module, attribute = task_modules.split(name)
        return task_modules.load(module, folder), attribute
    except ValueError as error:
        raise RequestError(str(error)) from error


def build_component(kind: str, name: str, maker: Any, *arguments: Any, expected_type: type) -> Any:
    """Call the function that builds a component, and return its result after checking the type.

    Args:
        kind, name: As in `find_component`, for messages.
        maker: The function, or the component itself, which is returned as it is.
        arguments: Arguments of the function.
        expected_type: Class of the component.

    Raises:
        RequestError: The function fails, or returns another type.
    """
    if isinstance(maker, expected_type):
        return maker
    problem = f"{name} is not {'an' if kind[0] in 'aeiou' else 'a'} {kind}"
    if not callable(maker):
        raise RequestError(f"{problem}: it must be a function that returns a {expected_type.__name__}, not {maker!r}")
    try:
        made = maker(*arguments)
    except RequestError:
        raise
    except Exception as error:  # noqa: BLE001 - somebody else's code may raise anything
        file = getattr(getattr(maker, "__code__", None), "co_filename", None)
        raise RequestError(f"{kind} {name} cannot be made: {task_modules.describe_error(error, file)}") from error
    if not isinstance(made, expected_type):
        raise RequestError(f"{problem}: it returned a {type(made).__name__}, not a {expected_type.__name__}")
    return made
