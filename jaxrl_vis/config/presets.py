"""Presets and their task-specific values."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from jaxrl_vis.config.groups import Config
from jaxrl_vis.config.methods import METHODS
from jaxrl_vis.errors import RequestError, nearest

_PAPER = Config().replace(
    preset="paper",
    image_size=100,
    num_envs=80,
    env_steps=800_000,
    updates_per_iteration=40,
    batch_size=512,
    replay_transitions=40_000,
    target_decay=0.98,
    target_update_interval=40,
    clip_targets_above=False,
    eval_interval=5,
)

_FAST = Config()

_CPU = _FAST.replace(
    preset="cpu",
    pixels="depth",
    image_size=32,
    num_envs=64,
    env_steps=64_000,
    updates_per_iteration=200,
    batch_size=128,
    replay_transitions=64_000,
    latent_size=128,
    hidden_sizes=(256, 256),
    eval_interval=2,
    eval_episodes=256,
)

_DEBUG = _CPU.replace(
    preset="debug",
    image_size=16,
    num_envs=4,
    env_steps=800,
    updates_per_iteration=4,
    batch_size=16,
    replay_transitions=800,
    encoder_filters=(8, 8),
    latent_size=16,
    hidden_sizes=(32,),
    eval_interval=2,
    eval_episodes=8,
    checkpoint_interval=2,
)

PRESETS: dict[str, Config] = {config.run.preset: config for config in (_PAPER, _FAST, _CPU, _DEBUG)}
"""``paper``: the authors' release. ``fast``: ours. ``cpu``: minutes on two cores. ``debug``: seconds, too short to learn."""


@dataclasses.dataclass(frozen=True)
class TaskValues:
    """Values of one task in one preset, for images or states; see docs/learner.md.

    Attributes:
        always: Values for every method.
        images: Values for image observations, except with a reward model trained alongside, which compares images.
        oracle: Values for rewards from the true state (method oracle).
        images_and_oracle: Values for images with rewards from the true state.
    """

    always: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    images: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    oracle: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    images_and_oracle: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def all(self) -> dict[str, Any]:
        """All values, whether or not they apply to the same method."""
        return {**self.always, **self.images, **self.oracle, **self.images_and_oracle}

    def choose(self, shows_images: bool, method_name: str) -> dict[str, Any]:
        """Return the values that apply to the observations and the method.

        Args:
            shows_images: True if observations are images.
            method_name: Method, built-in or ``module:Name``.
        """
        method = METHODS.get(method_name)
        oracle = method is not None and method.reward == "oracle"
        images = shows_images and (method is None or not method.is_learned)
        return {
            **self.always,
            **(self.images if images else {}),
            **(self.oracle if oracle else {}),
            **(self.images_and_oracle if images and oracle else {}),
        }


_FINGER = TaskValues(always={"actor_log": "loss"}, oracle={"trivial_goals": 0.2})
TASKS: Mapping[tuple[str, str], TaskValues] = {
    # A rollout of the hand is bound by GPU latency: with 500 environments it takes hardly longer than with 100.
    ("fast", "HandReach"): TaskValues(
        always={
            "num_envs": 500,
            "updates_per_iteration": 1000,
            "replay_transitions": 700_000,
            "random_action_probability": 0.1,
            "encoders": "shared",
            "target_encoder": False,
            "actor_interval": 2,
        },
        images={"random_shift": 2},
    ),
    # FetchReach is learned in so few steps that more frequent evaluations are worthwhile; a checkpoint takes as long as two of
    # its iterations.
    ("fast", "FetchReach"): TaskValues(
        always={
            "num_envs": 25,
            "updates_per_iteration": 50,
            "eval_interval": 4,
            "checkpoint_interval": 20,
            "encoders": "shared",
            "target_encoder": False,
        },
        images={"random_shift": 6, "relabel_probability": 0.8},
        images_and_oracle={"balance_probability": 0.3},
    ),
    ("cpu", "FetchReach"): TaskValues(
        always={
            "num_envs": 16,
            "updates_per_iteration": 50,
            "eval_interval": 8,
            "encoders": "shared",
            "target_encoder": False,
        },
        images={"random_shift": 1, "relabel_probability": 0.8},
        images_and_oracle={"balance_probability": 0.3},
    ),
    # As many sampled transitions per environment step as in the literature, or more. Until the gripper meets the box, all
    # relabelled goals are already reached: few of these are kept. From images, critics do not learn where the box is, so they
    # observe its true position; larger rollouts and fewer updates, as images take longer.
    ("fast", "FetchPush"): TaskValues(
        always={
            "num_envs": 200,
            "env_steps": 1_000_000,
            "updates_per_iteration": 5000,
            "replay_transitions": 500_000,
            "eval_interval": 5,
            "relabel_probability": 0.8,
        },
        images={
            "num_envs": 500,
            "critic_states": True,
            "target_encoder": False,
        },
        oracle={"trivial_goals": 0.2},
    ),
    ("cpu", "FetchPush"): TaskValues(
        always={
            "num_envs": 16,
            "updates_per_iteration": 600,
            "replay_transitions": 500_000,
            "eval_interval": 20,
            "eval_episodes": 64,
            "relabel_probability": 0.8,
        },
        images={"critic_states": True},
        oracle={"trivial_goals": 0.2},
    ),
    ("cpu", "PointMass"): TaskValues(
        always={"encoders": "shared", "target_encoder": False},
        images={"env_steps": 96_000, "random_shift": 1, "relabel_probability": 0.8},
        images_and_oracle={"balance_probability": 0.3},
    ),
    ("cpu", "Reacher"): TaskValues(images={"relabel_probability": 0.8}, images_and_oracle={"balance_probability": 0.3}),
    ("fast", "FingerTurn"): _FINGER,
    ("cpu", "FingerTurn"): _FINGER,
}
"""Task-specific values of presets, by (preset, task without ``Visual``)."""


def preset(name: str, **overrides: Any) -> Config:
    """Return a preset for a task and a method, with some options changed.

    Args:
        name: ``paper``, ``fast``, ``cpu`` or ``debug`` (`PRESETS`). Some have task-specific values (`TASKS`).
        **overrides: Option values by field name, regardless of the group; they take precedence.

    Raises:
        RequestError: The preset or an option is unknown.
    """
    if name not in PRESETS:
        raise RequestError(f"unknown preset {name!r}{nearest(name, list(PRESETS))}")
    config = PRESETS[name]
    env = str(overrides.get("env", config.environment.env))
    method = str(overrides.get("method", config.reward.method))
    values = TASKS.get((name, env.removeprefix("Visual")), TaskValues())
    config = config.replace(**values.choose(env.startswith("Visual"), method))
    algorithm = str(overrides.get("algorithm", config.run.algorithm))
    return config.replace(**{**_algorithm_overrides(config, algorithm), **overrides})


def _algorithm_overrides(config: Config, algorithm: str) -> dict[str, Any]:
    """Return the values in which an algorithm differs from DDPG."""
    if algorithm == "td3":  # delayed updates of the actor and the targets
        return {name: max(2, config.value(name)) for name in ("actor_interval", "target_update_interval")}
    if algorithm == "ddpg":
        return {}
    own: dict[str, Any] = {"critic_states": False}
    if algorithm == "contrastive":  # goals are future states, and an observation would be known by its goal's shift
        own |= {"future_goals": "geometric", "relabel_probability": 1.0, "balance_probability": 0.0, "trivial_goals": 1.0}
        own["random_shift"] = 0
    return own


def general_values(name: str, task: str) -> dict[str, Any]:
    """Return a preset's general values of those options for which ``task`` has values of its own."""
    values = TASKS.get((name, task.removeprefix("Visual")), TaskValues())
    return {option: PRESETS[name].value(option) for option in values.all}
