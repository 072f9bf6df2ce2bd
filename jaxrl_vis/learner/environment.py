"""Construction of the environment that a configuration describes."""

import dataclasses
from typing import Any

import jaxrl_vis_envs
from jaxrl_vis.config import OPTIONS, Config, fields, validate
from jaxrl_vis.config.groups import EnvironmentOptions
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.host import plugins
from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.randomization import typical
from jaxrl_vis_envs.registry import config_class, load
from jaxrl_vis_envs.task_modules import import_root


def _option_of_environment(name: str) -> str | None:
    """Return the command-line option that sets a field of an environment; None if only ``env_options`` sets it."""
    if name == "randomization":
        return "--randomize"
    is_own = name in OPTIONS and OPTIONS[name].group == "environment"
    return f"--{name.replace('_', '-')}" if is_own else None


def locate_env(config: Config) -> Config:
    """Validate ``config``, and return it with ``env_folder`` set to the folder from which its ``module:Name`` are imported.

    It is None if there are none, or if their modules are installed.

    Raises:
        RequestError: The configuration is invalid, the environment is unknown, a module cannot be imported, or the modules are
            in several folders.
    """
    validate(config)
    try:
        folders = {config.environment.env: load(config.environment.env, config.environment.env_folder)}
    except ValueError as error:
        raise RequestError(str(error)) from error
    for kind, name in plugins.custom_names(config).items():
        if kind != "task":
            folders[name] = import_root(plugins.load(name, config.environment.env_folder)[0])
    names = {folder: name for name, folder in folders.items() if folder is not None}
    if len(names) > 1:
        where = " and ".join(f"{name} in {folder}" for folder, name in names.items())
        raise RequestError(f"modules of a run must lie in one folder, or be installed; here are {where}")
    return config.replace(env_folder=next(iter(names), None))


def make_env(config: Config) -> GoalEnv:
    """Build the environment of a configuration.

    Raises:
        RequestError: The configuration is invalid, or the environment is unknown or does not support the options.
    """
    locate_env(config)
    try:
        options = config.environment
        names = {field.name for field in dataclasses.fields(config_class(options.env))}
        settings: dict[str, Any] = {}
        if "image_size" in names:
            settings["image_size"] = options.image_size
        if "pixels" in names:
            settings["pixels"] = options.pixels
        if options.frame_stack is not None:
            settings["frame_stack"] = options.frame_stack
        if options.randomize:
            settings["randomization"] = typical(*options.randomize, strength=options.randomize_strength)
        return jaxrl_vis_envs.make(options.env, **settings, **_read_options(options))
    except ValueError as error:
        raise RequestError(str(error)) from error


def _read_options(environment: EnvironmentOptions) -> dict[str, Any]:
    """Convert ``env_options`` to the fields of the environment's configuration.

    Raises:
        RequestError: An option is not of the form ``name=value``, has an unknown name or an invalid value, or is one that has a
            command-line option of its own or cannot be written as text.
    """
    if not environment.env_options:
        return {}
    hints = fields.hints(config_class(environment.env))
    options: dict[str, Any] = {}
    for option in environment.env_options:
        name, equals, value = option.partition("=")
        if not equals:
            raise RequestError(f"an environment's option is written name=value, not {option!r}")
        if own := _option_of_environment(name):
            raise RequestError(f"{name} has an option of its own: {own}")
        if name not in hints:
            choices = [choice for choice in hints if _option_of_environment(choice) is None]
            raise RequestError(f"{environment.env} has no option {name!r}{nearest(name, choices)}")
        if not fields.is_known(hints[name]):
            raise RequestError(f"{name} cannot be set by name=value: it is a {hints[name]}, neither a number nor a word")
        _, _, several = fields.unwrap(hints[name])
        options[name] = fields.read(name, hints[name], value.split(",") if several else [value])
    return options
