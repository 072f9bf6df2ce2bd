"""Tasks that `benchmarks.pixels.train` trains from images, with the settings of each.

CartpoleBalance   MuJoCo Playground's, with the settings and the networks that it has for images (its release 0.2.0), but for
                  the task itself: rewards, time step and episodes of 1,000 steps are those of its state task, so that a return
                  is "of 1,000". An observation is the last three RGB images, where theirs is in grey.
FetchReach        a manipulation task of this project, through its adapter to brax: move the gripper of a Fetch robot to the
                  goal in an image. Observations are an RGB-D image and one of the goal, the reward the negative distance.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax

from benchmarks.pixels import playground
from jaxrl_vis_envs import pixels
from jaxrl_vis_envs.adapters.brax import BraxEnv

IMAGE_SIZE = 64


@dataclasses.dataclass(frozen=True)
class Task:
    """A task that can be trained.

    Attributes:
        make: Makes the environment, with images alone as its observation.
        wrapper: Returns the function that wraps it for brax's trainers.
        settings: Arguments of brax's trainer.
        networks: Arguments of brax's networks.
        measure: Name of what an evaluation measures, of `score`.
        score: Returns it, from the metrics of an evaluation by brax.
        unit: Its unit.
        target: The value that a run is timed to.
        inputs: What an observation consists of, for the records.
    """

    make: Callable[[], pixels.PixelEnv]
    wrapper: Callable[[], Any]
    settings: dict[str, Any]
    networks: dict[str, Any]
    measure: str
    score: Callable[[Mapping[str, Any]], float]
    unit: str
    target: float
    inputs: dict[str, Any]


_FRAMES = 3
_COMMON: dict[str, Any] = {
    "num_eval_envs": 128,
    "num_minibatches": 8,
    "unroll_length": 10,
    "max_grad_norm": 1.0,
    "entropy_cost": 5e-3,
    "learning_rate": 5e-4,
    "normalize_observations": False,
    "deterministic_eval": True,
}
_HIDDEN_LAYERS = {"policy_hidden_layer_sizes": (256, 256), "value_hidden_layer_sizes": (256, 256), "normalise_channels": True}


def _make_cartpole() -> pixels.PixelEnv:
    env = playground.load("CartpoleBalance")
    return pixels.wrap(env, "fixed", IMAGE_SIZE, frames=_FRAMES, layout="images")


def _playground_wrapper() -> Any:
    from mujoco_playground import wrapper  # pyright: ignore[reportMissingImports]

    return wrapper.wrap_for_brax_training


def _make_fetch() -> pixels.PixelEnv:
    env = BraxEnv("FetchReach", reward="dense")
    task: Any = env.goal_env

    def goal(state: Any) -> Any:
        return task.goal_configuration(state.pipeline_state.goal_state)

    return pixels.wrap(env, task.camera, IMAGE_SIZE, ("rgb", "depth"), goal, layout="images", depth_range=(0.4, 1.8))


def _brax_wrapper() -> Any:
    from brax.envs.wrappers import training

    return training.wrap


TASKS = {
    "CartpoleBalance": Task(
        _make_cartpole,
        _playground_wrapper,
        {
            **_COMMON,
            "num_timesteps": 5_000_000,
            "num_evals": 11,
            "episode_length": 1000,
            "num_envs": 1024,
            "batch_size": 256,
            "unroll_length": 20,
            "num_updates_per_batch": 8,
            "discounting": 0.99,
            "learning_rate": 1e-3,
            "entropy_cost": 0.02,
            "reward_scaling": 1.0,
        },
        {
            "policy_hidden_layer_sizes": (128, 64),
            "value_hidden_layer_sizes": (128, 64),
            "normalise_channels": True,
            "cnn_output_channels": (16, 32),
            "cnn_kernel_size": (5, 3),
            "cnn_stride": (2, 2),
            "cnn_activation": jax.nn.elu,
            "cnn_max_pool": True,
            "cnn_global_pool": "none",
            "cnn_kernel_init_fn": jax.nn.initializers.orthogonal,
            "cnn_kernel_init_kwargs": {"scale": math.sqrt(2.0)},
            "output_kernel_init_fn": jax.nn.initializers.orthogonal,
            "output_kernel_init_kwargs": {"scale": 0.2},
        },
        "return",
        lambda metrics: round(float(metrics["eval/episode_reward"]), 1),
        "of 1,000",
        900.0,
        {"frames": _FRAMES},
    ),
    "FetchReach": Task(
        _make_fetch,
        _brax_wrapper,
        {
            **_COMMON,
            "num_timesteps": 3_000_000,
            "num_evals": 11,
            # Environments start anew, with other goals, so many times between two evaluations: brax's own restarts repeat the
            # first episode.
            "num_resets_per_eval": 3,
            "episode_length": 50,
            "num_envs": 2048,
            "batch_size": 256,
            "num_updates_per_batch": 4,
            "discounting": 0.95,
            "reward_scaling": 10.0,
        },
        # Where the gripper is in the image is lost in brax's default, the mean over the image.
        {**_HIDDEN_LAYERS, "cnn_global_pool": "none"},
        "success",
        lambda metrics: round(float(metrics["eval/episode_success"] / metrics["eval/avg_episode_length"]), 3),
        "share of steps within 5 cm of the goal",
        0.8,
        {"outputs": ["rgb", "depth"], "goal_image": True},
    ),
}
SMOKE: dict[str, Any] = {
    "num_timesteps": 64,
    "num_evals": 2,
    "num_resets_per_eval": 1,
    "episode_length": 20,
    "num_envs": 4,
    "num_eval_envs": 4,
    "batch_size": 4,
    "num_minibatches": 2,
    "num_updates_per_batch": 1,
    "unroll_length": 4,
}
"""Settings with which a run is as short as it gets."""
