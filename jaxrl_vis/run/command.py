"""Command line equivalent of a configuration."""

import dataclasses
import shlex

from jaxrl_vis.config import Config, preset


def training_options(config: Config) -> list[str]:
    """Return the arguments of ``jaxrl-vis train``: the task, the preset, and the fields that differ from it."""
    words = [config.env, "--preset", config.preset]
    base = preset(config.preset, env=config.env, method=config.method).replace(method=preset(config.preset).method)
    for field in dataclasses.fields(Config):
        value = getattr(config, field.name)
        if field.name in ("env", "preset") or value == getattr(base, field.name):
            continue
        option = "--" + field.name.replace("_", "-")
        if isinstance(value, bool):
            words.append(option if value else option.replace("--", "--no-", 1))
        else:
            words += [option, *map(str, value)] if isinstance(value, tuple) else [option, str(value)]
    return words


def training_command(config: Config) -> str:
    """Return the shortest command that trains with ``config``, quoted for a shell."""
    return shlex.join(["jaxrl-vis", "train", *training_options(config)])
