"""Configuration of a training run: options in groups, presets and checks.

    fields       annotations of options: types, bounds, names
    methods      reward methods, and names of a learner's components
    groups       the options, with their defaults and help: `Config`
    presets      presets and their task-specific values
    validation   checks of a whole configuration

Imports no JAX.
"""

from jaxrl_vis.config.groups import (
    HOST,
    OPTIONS,
    RESUMABLE,
    UNMEASURED,
    Config,
    Mark,
    Pixels,
    changes,
    config_from_dict,
    data_devices,
    marked,
    weighting_options,
)
from jaxrl_vis.config.presets import PRESETS, TASKS, general_values, preset
from jaxrl_vis.config.validation import validate

__all__ = [
    "HOST",
    "OPTIONS",
    "PRESETS",
    "RESUMABLE",
    "TASKS",
    "UNMEASURED",
    "Config",
    "Mark",
    "Pixels",
    "changes",
    "config_from_dict",
    "data_devices",
    "general_values",
    "marked",
    "weighting_options",
    "preset",
    "validate",
]
