"""Command line equivalent of a configuration."""

import shlex

from jaxrl_vis.config import Config, preset


def training_options(config: Config) -> list[str]:
    """Return the arguments of ``jaxrl-vis train``: the task, the preset, and the options that differ from it."""
    words = [config.environment.env, "--preset", config.run.preset]
    base = preset(config.run.preset, env=config.environment.env, method=config.reward.method).replace(
        method=preset(config.run.preset).reward.method
    )
    for name, value in config.replace(env=base.environment.env, preset=base.run.preset).flat().items():
        if value == base.value(name):
            continue
        option = "--" + name.replace("_", "-")
        if isinstance(value, bool):
            words.append(option if value else option.replace("--", "--no-", 1))
        else:
            words += [option, *map(str, value)] if isinstance(value, tuple) else [option, str(value)]
    return words


def training_command(config: Config) -> str:
    """Return the shortest command that trains with ``config``, quoted for a shell."""
    return shlex.join(["jaxrl-vis", "train", *training_options(config)])
