"""Configurations: their checks, the origin of their defaults, and how they are read back from a file."""

import dataclasses
import json
import math
import typing
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from jaxrl_vis.config import PRESETS, Config, Pixels, config_from_dict, fields, preset, validate
from jaxrl_vis.config.methods import METHODS, MethodName
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.resolved import resolve
from jaxrl_vis_envs.pixels import CHANNELS

BAD_VALUES: tuple[tuple[str, Any, str], ...] = (
    ("hidden_sizes", (0,), "hidden_sizes must all be at least 1, not 0"),
    ("encoder_filters", (0, 8), "encoder_filters must all be at least 1, not 0 8"),
    ("encoder_filters", (-4, 8), "encoder_filters must all be at least 1, not -4 8"),
    ("seed", 99999999999999999999, "seed 99999999999999999999 is too large"),
    ("seed", 2**32, "seed 4294967296 is too large"),
    ("seed", -1, "seed must be at least 0"),
    ("actor_interval", 3, "actor_interval (3) must divide updates_per_iteration"),
    ("actor_interval", 0, "actor_interval must be at least 1"),
    ("random_shift", -1, "random_shift must be at least 0"),
    ("action_penalty", -1.0, "action_penalty must be at least 0, not -1.0"),
    ("weighting_beta", -5.0, "weighting_beta must be at least 0, not -5.0"),
    ("weighting_beta", 5.0, "weighting_beta is an option of weighting ol_aux and ol_aux_ablation, which none does not use"),
    ("weighting_interval", 10, "weighting_interval is an option of weighting ol_aux and ol_aux_ablation"),
    ("weighting_fixed", 0.1, "weighting_fixed is an option of weighting fixed, which none does not use"),
    ("weighting_log", True, "weighting_log is an option of weighting cosine"),
    ("aux_form", "release", "aux_form release is a form of auxiliary tasks, and there are none: add --aux-tasks"),
    ("randomize_strength", 3.0, "randomize_strength 3.0 has no effect: choose what varies with --randomize"),
    ("replay_mean_age", 0, "replay_mean_age must be at least 1, not 0"),
    ("trivial_goals", 1.5, "trivial_goals is a share and must lie in [0, 1]"),
    ("encoders", "joint", "encoders cannot be 'joint'"),
    ("num_envs", 10**20, "num_envs must be at most"),
    ("num_envs", "abc", "num_envs must be a whole number, not 'abc'"),
    ("num_envs", 2.5, "num_envs must be a whole number"),
    ("num_envs", True, "num_envs must be a whole number"),
    ("num_envs", None, "num_envs must be a whole number"),
    ("env", 5, "env must be a word, not 5"),
    ("method", "orakel", "method cannot be 'orakel'; did you mean oracle"),
    ("pixels", ["rgb"], "pixels cannot be"),
    ("randomize", "camera", "randomize must be a list"),
    ("randomize", ("camra",), "randomize cannot be 'camra'; did you mean camera"),
    ("hidden_sizes", (8, "8"), "hidden_sizes must be a whole number, not '8'"),
    ("clip_targets_above", "no", "clip_targets_above must be true or false"),
    ("action_noise", math.nan, "action_noise must be a finite number"),
    ("action_noise", -0.1, "action_noise must be at least 0"),
    ("discount", math.inf, "discount must be a finite number"),
    ("action_penalty", -math.inf, "action_penalty must be a finite number"),
    ("action_penalty", 10**400, "action_penalty must be a finite number"),
    ("balance_probability", 1.5, "balance_probability is a share"),
)


@pytest.mark.parametrize(("name", "value", "complaint"), BAD_VALUES, ids=lambda value: str(value)[:24])
def test_bad_values_are_refused_by_name(name: str, value: Any, complaint: str) -> None:
    with pytest.raises(RequestError) as refused:
        validate(preset("debug", **{name: value}))
    assert str(refused.value).startswith(complaint)


def test_the_largest_seeds_are_different_ones() -> None:
    config = validate(preset("debug", seed=2**32 - 2, seeds=2))
    with pytest.raises(RequestError, match="seed 4294967294 is too large: the last of 3"):
        validate(config.replace(seeds=3))
    first, last = (jax.random.key_data(jax.random.key(seed)) for seed in (config.run.seed, config.run.seed + 1))
    assert not np.array_equal(first, last)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_make_sense_and_come_back_from_json(name: str) -> None:
    config = validate(PRESETS[name].replace(randomize=("camera", "lights"), discount=0.5))
    assert config_from_dict(json.loads(json.dumps(dataclasses.asdict(config)))) == config


def test_a_preset_leaves_out_what_the_method_cannot_do() -> None:
    """The finger's presets replace most trivial goals, but only where rewards are computed from true states."""
    for name, env in (("fast", "VisualFingerTurn"), ("cpu", "FingerTurn")):
        assert validate(preset(name, env=env)).goals.trivial_goals < 1.0
        assert validate(preset(name, env=env, trivial_goals=0.9)).goals.trivial_goals == 0.9
        for method in METHODS:
            config = validate(preset(name, env=env, method=method))
            assert config.goals.trivial_goals == 1.0 or METHODS[method].reward == "oracle"
    with pytest.raises(RequestError, match="indicatr"):
        validate(preset("fast", env="VisualFingerTurn", method="indicatr"))


def test_numbers_from_elsewhere_are_welcome() -> None:
    config = validate(preset("debug", seed=np.int64(3), action_noise=np.float32(0.5)))
    assert config_from_dict(dataclasses.asdict(config)) == config
    assert isinstance(config_from_dict({"ddpg": {"discount": 0}}).ddpg.discount, float)


def test_a_preset_shifts_images_where_there_are_some() -> None:
    assert preset("fast", env="VisualFetchReach").network.random_shift > 0
    assert preset("fast", env="VisualFetchReach", method="indicator").network.random_shift > 0
    assert preset("fast", env="VisualFetchReach", random_shift=0).network.random_shift == 0
    assert preset("fast", env="VisualHandReach").network.random_shift > 0
    assert preset("fast", env="FetchReach").network.random_shift == preset("fast", env="HandReach").network.random_shift == 0
    assert validate(preset("fast", env="VisualFetchReach", method="autoencoder")).network.random_shift == 0


def test_a_preset_relabels_as_the_method_and_the_observations_ask_for() -> None:
    assert preset("fast", env="VisualFetchReach").goals.balance_probability == 0.3
    indicator = preset("fast", env="VisualFetchReach", method="indicator_balance_filter")  # with a balance of its own
    assert (indicator.goals.relabel_probability, indicator.goals.balance_probability) == (0.8, None)
    assert preset("cpu", env="VisualReacher").goals.balance_probability == 0.3
    for other in ({"env": "FetchReach"}, {"env": "Reacher"}, {"env": "VisualFetchReach", "method": "autoencoder"}):
        config = preset("cpu", **other)
        assert (config.goals.relabel_probability, config.goals.balance_probability) == (0.9, None)


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ([1], "a configuration must be a dictionary"),
        ({"rum": {}}, "unknown group of options 'rum'; did you mean run"),
        ({"run": 3}, "run must be a dictionary of options, not int"),
        ({"ddpg": {"batch_size": 2}}, "unknown option 'batch_size' in ddpg"),
        ({"environment": {"frame_stack": "two"}}, "frame_stack must be a whole number, not 'two'"),
        ({"run": {"batch_sizes": 2}}, "unknown option 'batch_sizes' in run; did you mean batch_size"),
        ({"run": {"[" * 3000: 2}}, f"unknown option '{'[' * 60}' in run"),
        ({"run": {"num_envs": "abc"}}, "num_envs must be a whole number, not 'abc'"),
        ({"reward": {"method": "indicator"}, "environment": {"env": 5}}, "env must be a word, not 5"),
        ({"network": {"hidden_sizes": [8, None]}}, "hidden_sizes must be a whole number, not None"),
        ({"network": {"hidden_sizes": 8}}, "hidden_sizes must be a list"),
        ({"ddpg": {"discount": [0.9]}}, "discount must be a finite number"),
    ],
)
def test_a_saved_configuration_of_the_wrong_types_is_refused_by_name(values: Any, complaint: str) -> None:
    with pytest.raises(RequestError) as refused:
        config_from_dict(values)
    assert complaint in str(refused.value) and "\n" not in str(refused.value)


def test_words_become_values() -> None:
    assert fields.read("x", int | None, ["None"]) is None
    assert fields.read("x", float | None, ["1e-3"]) == 1e-3
    assert fields.read("x", tuple[int, ...], ["-4", "8"]) == (-4, 8)
    assert fields.read("x", tuple[int, ...], []) == ()
    assert fields.read("x", Path | None, ["a/b"]) == Path("a/b")
    for hint, word in ((int, "1.5"), (int, "none"), (float, "nan"), (float | None, "inf"), (Pixels, "rgba")):
        with pytest.raises(RequestError, match="^x "):
            fields.read("x", hint, [word])


def test_allowed_values_are_written_once() -> None:
    assert typing.get_args(Pixels) == tuple(CHANNELS)
    hints = fields.hints(Config)
    assert fields.choices(hints["method"]) == tuple(METHODS)
    assert fields.choices(hints["randomize"]) == ("camera", "lights", "colours", "dynamics")
    assert fields.choices(hints["seed"]) == ()


def test_defaults_follow_the_method() -> None:
    """R+ = 1 and R- = -1 of the indicator are from the thesis, section 5.1.4; the filter's threshold is its band's middle."""
    resolved = {name: resolve(Config().replace(method=name), 50) for name in METHODS}
    discount = 1 - 1 / 50
    for name, (positive, balance) in {
        "oracle": (0.0, 0.0),
        "indicator": (1.0, 0.0),
        "indicator_balance_filter": (1.0, 0.5),
    }.items():
        assert (resolved[name].reward_positive, resolved[name].reward_negative) == (positive, -1.0)
        assert resolved[name].balance_probability == balance and resolved[name].discount == discount
    assert resolved["oracle"].filter_threshold == resolved["indicator"].filter_threshold == math.inf
    best = 1 / (1 - discount)
    assert resolved["indicator_balance_filter"].filter_threshold == pytest.approx((-1 + discount * best + best) / 2)
    assert METHODS["indicator_balance_filter"].balance_probability == 0.5 and METHODS["indicator"].balance_probability == 0.0
    assert [name for name in METHODS if METHODS[name].needs_images] == ["autoencoder", "classifier", "features"]
    autoencoder = resolved["autoencoder"]
    assert (autoencoder.reward_positive, autoencoder.reward_negative, autoencoder.balance_probability) == (1.0, 0.0, 0.0)
    assert (autoencoder.target_minimum, autoencoder.target_maximum) == (0.0, best)


def test_a_threshold_needs_a_method_that_filters() -> None:
    with pytest.raises(RequestError, match="--method indicator_balance_filter"):
        resolve(Config().replace(filter_threshold=0.0), 50)
    with pytest.raises(RequestError, match="outside its band"):
        resolve(Config().replace(method="indicator_balance_filter", filter_threshold=1000.0), 50)


@pytest.mark.parametrize("method", ["autoencoder", "features"])
def test_trivial_goals_need_a_reward_that_tells_what_is_reached(method: MethodName) -> None:
    with pytest.raises(RequestError, match=f"trivial_goals needs the oracle or an indicator.*{method}"):
        validate(Config().replace(method=method, trivial_goals=0.5))
    assert validate(Config().replace(method="indicator", trivial_goals=0.5))


@pytest.mark.parametrize("option", [{"n_step": 3}, {"reward_noise": 0.5}])
@pytest.mark.parametrize("method", [name for name in METHODS if METHODS[name].reward != "oracle"])
def test_what_reads_true_states_is_refused_where_there_are_none(option: dict[str, Any], method: MethodName):
    with pytest.raises(RequestError, match=next(iter(option))):
        validate(Config().replace(method=method, **option))
