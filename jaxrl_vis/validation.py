"""Validation of configurations, with one-line messages that name the problem and the remedy.

Imports no JAX, so that the command line can reject a request at once.
"""

import dataclasses
import math

from jaxrl_vis import fields
from jaxrl_vis.config import Config, data_devices_of
from jaxrl_vis.errors import RequestError
from jaxrl_vis.methods import METHODS

_LARGEST_SEED = 2**32 - 1  # a random key uses 32 bits of it: larger seeds would repeat smaller ones
_LARGEST_COUNT = 2**31 - 1  # arrays are indexed by int32; environment steps are counted on the host, without bound

_OL_AUX = ("ol_aux", "ol_aux_ablation")
_OF_WEIGHTINGS = {
    **dict.fromkeys(("weighting_interval", "weighting_beta", "weighting_main_grad", "weighting_window"), _OL_AUX),
    "weighting_fixed": ("fixed",),
    "weighting_log": ("cosine",),
}
_FALSE_REWARDS = ("reward_false_positives", "reward_false_negatives")
_SHARES = (
    *("relabel_probability", "balance_probability", "trivial_goals", "random_action_probability", "target_decay"),
    *(*_FALSE_REWARDS, "reward_clutter"),
)
_AT_LEAST_0 = (
    *("seed", "full_checkpoint_interval", "random_shift", "action_penalty", "weighting_beta"),
    *("action_noise", "observation_noise", "reward_noise"),
)


def validate(config: Config) -> Config:
    """Return ``config`` if it is valid by itself; constraints that depend on the environment are checked elsewhere.

    Raises:
        RequestError: A field is of the wrong type or out of range. The message names the field and its value.
    """
    for name, hint in fields.hints(Config).items():
        fields.check(name, hint, getattr(config, name))
    for field in dataclasses.fields(Config):
        value = getattr(config, field.name)
        if field.type is int and field.name not in ("seed", "full_checkpoint_interval", "random_shift") and value < 1:
            raise RequestError(f"{field.name} must be at least 1, not {value}")
        if field.type is int and field.name not in ("seed", "env_steps") and value > _LARGEST_COUNT:
            raise RequestError(f"{field.name} must be at most {_LARGEST_COUNT}, not {value}")
    if config.frame_stack is not None and config.frame_stack < 1:
        raise RequestError(f"frame_stack must be at least 1, not {config.frame_stack}")
    if config.replay_mean_age is not None and not 1 <= config.replay_mean_age <= _LARGEST_COUNT:
        raise RequestError(f"replay_mean_age must be from 1 to {_LARGEST_COUNT}, or none, not {config.replay_mean_age}")
    for name in ("encoder_filters", "hidden_sizes"):
        if any(size < 1 for size in getattr(config, name)):
            raise RequestError(f"{name} must all be at least 1, not {' '.join(map(str, getattr(config, name)))}")
    for name in _SHARES:
        value = getattr(config, name)
        if value is not None and not 0.0 <= value <= 1.0:
            raise RequestError(f"{name} is a share and must lie in [0, 1], not {value}")
    for name in ("actor_learning_rate", "critic_learning_rate", "normalizer_floor", "normalizer_clip", "randomize_strength"):
        if not getattr(config, name) > 0.0:
            raise RequestError(f"{name} must be positive, not {getattr(config, name)}")
    for name in _AT_LEAST_0:
        value = getattr(config, name)
        if value is not None and value < 0:
            raise RequestError(f"{name} must be at least 0, not {value}")
    if config.updates_per_iteration % config.actor_interval:
        raise RequestError(
            f"actor_interval ({config.actor_interval}) must divide updates_per_iteration ({config.updates_per_iteration})"
        )
    if config.n_step > 1 and config.method in METHODS and METHODS[config.method].filter:
        raise RequestError(f"n_step {config.n_step} with method {config.method}: the filter's valid range assumes one step")
    _validate_reward(config)
    _validate_auxiliary(config)
    if not config.randomize and _is_set(config, "randomize_strength"):
        raise RequestError(f"randomize_strength {config.randomize_strength} has no effect: choose what varies with --randomize")
    _validate_devices(config)
    if config.seed + config.seeds - 1 > _LARGEST_SEED:
        raise RequestError(f"seed {config.seed} is too large: the last of {config.seeds} must be at most {_LARGEST_SEED}")
    return config


def _is_set(config: Config, name: str) -> bool:
    """Return True if a field differs from its default."""
    return getattr(config, name) != next(field.default for field in dataclasses.fields(Config) if field.name == name)


def _validate_auxiliary(config: Config) -> None:
    """Raise a RequestError for an option of another weighting, or one of auxiliary tasks without any tasks."""
    for name, weightings in _OF_WEIGHTINGS.items():
        if _is_set(config, name) and config.weighting not in weightings:
            raise RequestError(
                f"{name} is an option of weighting {' and '.join(weightings)}, which {config.weighting} does not use: "
                f"leave it out, or choose --weighting {weightings[0]}"
            )
    if _is_set(config, "aux_form") and not config.aux_tasks:
        raise RequestError(f"aux_form {config.aux_form} is a form of auxiliary tasks, and there are none: add --aux-tasks")


def _validate_devices(config: Config) -> None:
    """Raise a RequestError if the devices cannot be divided among seeds, environments or batches."""
    devices, along_data = config.devices, data_devices_of(config)
    if along_data < 1:
        raise RequestError(f"data_devices must be at least 1, not {along_data}")
    if devices % along_data:
        raise RequestError(f"data_devices ({along_data}) must divide devices ({devices})")
    groups = devices // along_data
    if config.seeds % groups:
        where = f"{groups} devices" if along_data == 1 else f"{groups} groups of {along_data} devices"
        more = math.ceil(config.seeds / groups) * groups
        raise RequestError(
            f"seeds {config.seeds} cannot be divided among {where}: write --seeds {more}, or --data-devices {devices} to "
            "divide each learner"
        )
    for name in ("num_envs", "batch_size", "eval_episodes"):
        value = getattr(config, name)
        if value % along_data:
            option, more = f"--{name.replace('_', '-')}", math.ceil(value / along_data) * along_data
            raise RequestError(f"{name} {value} cannot be divided among {along_data} devices: write {option} {more}")


def _validate_reward(config: Config) -> None:
    """Raise a RequestError for reward options that do not fit the method or contradict each other."""
    kind = METHODS[config.method].reward if config.method in METHODS else "own"  # a function of transitions
    errors = {name: getattr(config, name) > 0.0 for name in ("reward_noise", *_FALSE_REWARDS)}
    reads_states = {"n_step": config.n_step > 1, "trivial_goals": config.trivial_goals < 1.0, **errors}
    for name, is_set in reads_states.items():
        if is_set and kind != "oracle":
            raise RequestError(f"{name} needs true states, which method {config.method} does not use: choose --method oracle")
        if is_set and name in errors and config.n_step > 1:
            raise RequestError(f"n_step {config.n_step} and {name} exclude each other: errors apply to single rewards")
    if config.reward_clutter < 1.0 and not any(getattr(config, name) for name in _FALSE_REWARDS):
        raise RequestError(
            f"reward_clutter is where false rewards occur, and there are none: set {' or '.join(_FALSE_REWARDS)}"
        )
    for name in _FALSE_REWARDS:
        if getattr(config, name) > config.reward_clutter:
            raise RequestError(
                f"{name} ({getattr(config, name)}) is a share of the whole workspace and cannot exceed reward_clutter "
                f"({config.reward_clutter}), the share of it where false rewards occur"
            )
    for name, is_set in (("random_shift", config.random_shift > 0), ("normalizers separate", config.normalizers == "separate")):
        if is_set and kind == "autoencoder":
            raise RequestError(f"{name} and method {config.method} exclude each other: it compares unmodified images")
