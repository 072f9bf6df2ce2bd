"""Environment of a configuration."""

import dataclasses
from typing import Any

import jaxrl_vis_envs
from jaxrl_vis import fields
from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.host import plugins
from jaxrl_vis.validation import validate
from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.randomization import typical
from jaxrl_vis_envs.registry import config_class, load
from jaxrl_vis_envs.task_modules import import_folder

# Options of an environment that `Config` has fields of its own for.
_OWN_FIELDS = {
    "image_size": "--image-size",
    "pixels": "--pixels",
    "frame_stack": "--frame-stack",
    "randomization": "--randomize",
}


def locate_env(config: Config) -> Config:
    """Return ``config`` with the folder of its ``module:Name`` parts filled in.

    Raises:
        RequestError: There is no such environment, its module cannot be imported, or the modules are in several folders.
    """
    validate(config)
    try:
        folders = {config.env: load(config.env, config.env_folder)}
    except ValueError as error:
        raise RequestError(str(error)) from error
    for kind, name in plugins.own_names(config).items():
        if kind != "task":
            folders[name] = import_folder(plugins.load(name, config.env_folder)[0])
    places = {folder: name for name, folder in folders.items() if folder is not None}
    if len(places) > 1:
        where = " and ".join(f"{name} in {folder}" for folder, name in places.items())
        raise RequestError(f"modules of a run must lie in one folder, or be installed; here are {where}")
    return config.replace(env_folder=next(iter(places), None))


def make_env(config: Config) -> GoalEnv:
    """Build the environment of a configuration.

    Raises:
        RequestError: There is no such environment, or it cannot be made like that.
    """
    locate_env(config)
    try:
        names = {field.name for field in dataclasses.fields(config_class(config.env))}
        settings: dict[str, Any] = {name: getattr(config, name) for name in ("image_size", "pixels") if name in names}
        if config.frame_stack is not None:
            settings["frame_stack"] = config.frame_stack
        if config.randomize:
            settings["randomization"] = typical(*config.randomize, strength=config.randomize_strength)
        return jaxrl_vis_envs.make(config.env, **settings, **_read_options(config))
    except ValueError as error:
        raise RequestError(str(error)) from error


def _read_options(config: Config) -> dict[str, Any]:
    """``env_options`` as the fields of the environment's configuration hold them.

    Raises:
        RequestError: One is not ``name=value``, names no field, or has a value that does not suit.
    """
    if not config.env_options:
        return {}
    hints = fields.hints(config_class(config.env))
    found: dict[str, Any] = {}
    for option in config.env_options:
        name, equals, value = option.partition("=")
        if not equals:
            raise RequestError(f"an environment's option is written name=value, not {option!r}")
        if name in _OWN_FIELDS:
            raise RequestError(f"{name} has an option of its own: {_OWN_FIELDS[name]}")
        if name not in hints:
            choices = [each for each in hints if each not in _OWN_FIELDS]
            raise RequestError(f"{config.env} has no option {name!r}{nearest(name, choices)}")
        if not fields.is_known(hints[name]):
            raise RequestError(f"{name} cannot be set by name=value: it is a {hints[name]}, neither a number nor a word")
        _, _, several = fields.unwrap(hints[name])
        found[name] = fields.read(name, hints[name], value.split(",") if several else [value])
    return found
