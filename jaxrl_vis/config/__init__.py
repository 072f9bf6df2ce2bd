"""Configuration of a training run: options in groups, presets, checks, and values that follow from it.

    fields       annotations of options: types, bounds, names
    methods      reward methods, and names of the parts of a learner
    groups       the options, with their defaults and help: `Config`
    presets      values of each preset, and of tasks in it
    validation   checks of a whole configuration
    resolved     values that follow from a configuration and an environment's horizon

Imports no JAX.
"""

from jaxrl_vis.config.groups import Config, Pixels, changes, config_from_dict, data_devices
from jaxrl_vis.config.presets import PRESETS, preset

__all__ = ["PRESETS", "Config", "Pixels", "changes", "config_from_dict", "data_devices", "preset"]
