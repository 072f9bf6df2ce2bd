"""Validation of configurations, with one-line messages that name the problem and the remedy.

Imports no JAX, so that the command line can reject a request without delay.
"""

import math

from jaxrl_vis.config import fields
from jaxrl_vis.config.groups import (
    DIVIDED,
    FALSE_REWARD,
    NEEDS_STATES,
    OPTIONS,
    Config,
    OfAlgorithm,
    OfMethod,
    data_devices,
    marked,
    options_read_by,
    weighting_options,
)
from jaxrl_vis.config.methods import ALGORITHMS, METHODS
from jaxrl_vis.errors import RequestError

_MAX_SEED = 2**32 - 1  # random keys use 32 bits of the seed: larger seeds would repeat smaller ones


def validate(config: Config) -> Config:
    """Return ``config`` if it is valid by itself; constraints that depend on the environment are checked elsewhere.

    Raises:
        RequestError: An option is of the wrong type or out of range, or contradicts another. The message names the option and
            its value.
    """
    values = config.flat()
    for name, option in OPTIONS.items():
        fields.check(name, option.hint, values[name])
    for name, option in OPTIONS.items():
        fields.check_bounds(option, values[name])
    run, study = config.run, config.study
    if run.updates_per_iteration % config.ddpg.actor_interval:
        raise RequestError(
            f"actor_interval ({config.ddpg.actor_interval}) must divide updates_per_iteration ({run.updates_per_iteration})"
        )
    method = METHODS.get(config.reward.method)
    if study.n_step > 1 and method is not None and method.filter:
        raise RequestError(
            f"n_step {study.n_step} with method {config.reward.method}: the filter's valid range assumes one step"
        )
    for name, algorithms in options_read_by(OfAlgorithm).items():
        if _is_changed(config, name) and run.algorithm in ALGORITHMS and run.algorithm not in algorithms.names:
            readers = " or ".join(algorithms.names)
            raise RequestError(f"{name} is an option of --algorithm {readers}, and this is {run.algorithm}: leave it out")
    for name, reader in options_read_by(OfMethod).items():
        if _is_changed(config, name) and config.reward.method in METHODS and config.reward.method != reader.name:
            raise RequestError(
                f"{name} is an option of --method {reader.name}, and this is {config.reward.method}: leave it out"
            )
    _validate_reward(config)
    _validate_auxiliary(config)
    environment = config.environment
    if not environment.randomize and _is_changed(config, "randomize_strength"):
        raise RequestError(
            f"randomize_strength {environment.randomize_strength} has no effect: choose what varies with --randomize"
        )
    _validate_devices(config)
    if run.stop_at is not None and run.stop_at > 1 and run.best_by in (None, "success"):
        raise RequestError(f"stop_at {run.stop_at:g} can never be reached: success is from 0 to 1, such as --stop-at 0.95")
    if run.seed + run.seeds - 1 > _MAX_SEED:
        raise RequestError(f"seed {run.seed} is too large: the last of {run.seeds} must be at most {_MAX_SEED}")
    return config


def _is_changed(config: Config, name: str) -> bool:
    """Return True if an option differs from its default."""
    return config.value(name) != OPTIONS[name].default


def _validate_auxiliary(config: Config) -> None:
    """Raise a RequestError for an option of another weighting, or for one of auxiliary tasks if there are none."""
    weighting = config.auxiliary.weighting
    for name, weightings in weighting_options().items():
        if weightings and _is_changed(config, name) and weighting not in weightings:
            raise RequestError(
                f"{name} is an option of weighting {' and '.join(weightings)}, which {weighting} does not use: "
                f"leave it out, or choose --weighting {weightings[0]}"
            )
    if _is_changed(config, "aux_form") and not config.auxiliary.aux_tasks:
        form = config.study.aux_form
        raise RequestError(f"aux_form {form} is a form of auxiliary tasks, and there are none: add --aux-tasks")


def _validate_devices(config: Config) -> None:
    """Raise a RequestError if the devices cannot be divided among seeds, environments or batches."""
    seeds, devices, along_data = config.run.seeds, config.run.devices, data_devices(config)
    if devices % along_data:
        raise RequestError(f"data_devices ({along_data}) must divide devices ({devices})")
    groups = devices // along_data
    if seeds % groups:
        where = f"{groups} devices" if along_data == 1 else f"{groups} groups of {along_data} devices"
        rounded = math.ceil(seeds / groups) * groups
        raise RequestError(
            f"seeds {seeds} cannot be divided among {where}: write --seeds {rounded}, or --data-devices {devices} to "
            "divide each learner"
        )
    for name in marked(DIVIDED):
        value = config.value(name)
        if value % along_data:
            option, rounded = f"--{name.replace('_', '-')}", math.ceil(value / along_data) * along_data
            raise RequestError(f"{name} {value} cannot be divided among {along_data} devices: write {option} {rounded}")


def _validate_reward(config: Config) -> None:
    """Raise a RequestError for reward options that do not fit the method or contradict each other."""
    name, study = config.reward.method, config.study
    kind = METHODS[name].reward if name in METHODS else "own"  # a function of transitions
    for option in marked(NEEDS_STATES):
        if _is_changed(config, option) and kind != "oracle":
            raise RequestError(f"{option} needs true states, which method {name} does not use: choose --method oracle")
    if _is_changed(config, "trivial_goals") and kind not in ("oracle", "indicator", "indicator_tolerance"):
        raise RequestError(
            "trivial_goals needs the oracle or an indicator, to determine which goals are reached, "
            f"not method {name}: leave it out"
        )
    false_rewards = {option: config.value(option) for option in marked(FALSE_REWARD)}
    for option, value in {**false_rewards, "reward_noise": study.reward_noise}.items():
        if value > 0.0 and study.n_step > 1:
            raise RequestError(f"n_step {study.n_step} and {option} exclude each other: errors apply to single rewards")
    if study.reward_clutter < 1.0 and not any(false_rewards.values()):
        raise RequestError(f"reward_clutter is where false rewards occur, and there are none: set {' or '.join(false_rewards)}")
    for option, value in false_rewards.items():
        if value > study.reward_clutter:
            raise RequestError(
                f"{option} ({value}) is a share of the whole workspace and cannot exceed reward_clutter "
                f"({study.reward_clutter}), the share of it where false rewards occur"
            )
    unlike = {"random_shift": config.network.random_shift > 0, "normalizers separate": study.normalizers == "separate"}
    for option, is_set in unlike.items():
        if is_set and name in METHODS and METHODS[name].is_learned:
            raise RequestError(f"{option} and method {name} exclude each other: it compares unmodified images")
