"""The command that trains as a configuration says."""

import dataclasses
import shlex

from jaxrl_vis.config import Config, preset


def options_of(config: Config) -> list[str]:
    """What follows ``jaxrl-vis train``: the task, the preset, and what differs from that."""
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


def command_of(config: Config) -> str:
    """The shortest command that trains as ``config`` says, to be typed."""
    return shlex.join(["jaxrl-vis", "train", *options_of(config)])
