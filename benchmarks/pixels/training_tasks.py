"""Tasks that `benchmarks.pixels.train` trains from images, with the settings of each.

CartpoleBalance   MuJoCo Playground's, with its settings and networks for images (release 0.2.0). Rewards are those of its state
                  task, with 1,000 steps of 0.04 s per episode, so that the maximum return is 1,000; an episode ends when the
                  pole hangs down in training, as in its image task, but not in evaluations. An observation is the last three
                  images, in RGB instead of grey.
FetchReach        a manipulation task of this project, through its adapter to brax: move the gripper of a Fetch robot to the
                  goal in an image. Observations are an RGB-D image and one of the goal, the reward the negative distance.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.pixels import playground
from jaxrl_vis_envs import pixels
from jaxrl_vis_envs.adapters.brax import BraxEnv

IMAGE_SIZE = 64


@dataclasses.dataclass(frozen=True)
class Task:
    """Trainable task.

    Attributes:
        make: Function that creates the environment, with images as its only observation.
        wrapper: Function that returns the function that wraps the environment for brax's trainers.
        settings: Arguments of brax's trainer.
        networks: Arguments of brax's networks.
        measure: Name of the score.
        score: Function from the metrics of brax's evaluation to the score.
        unit: Unit of the score.
        target: Score up to which a run is timed.
        inputs: Description of an observation, for the records.
        make_evaluated: Function that creates the environment of evaluations; None for that of training.
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
    make_evaluated: Callable[[], pixels.PixelEnv] | None = None


_FRAMES = 3
_CARTPOLE_CONTROL_PERIOD = 0.04
"""Control period, s: over three images 0.01 s apart, a falling pole moves by less than a pixel."""
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


class _UntilFallen:
    """CartpoleBalance with episodes that end when the pole hangs down.

    Otherwise a random policy would see an upright pole only in the first second of each episode.
    """

    def __init__(self, env: Any) -> None:
        self.env = env

    def step(self, state: Any, action: jax.Array) -> Any:
        """Step, and end the episode if the pole points downwards."""
        state = self.env.step(state, action)
        has_fallen = state.data.xmat[self.env.mj_model.body("pole_1").id, 2, 2] < 0.0
        return state.replace(done=jnp.maximum(state.done, has_fallen.astype(state.done.dtype)))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "env" not in vars(self):
            raise AttributeError(name)
        return getattr(self.env, name)


def _make_cartpole(terminates: bool) -> pixels.PixelEnv:
    env = playground.load("CartpoleBalance", ctrl_dt=_CARTPOLE_CONTROL_PERIOD)
    return pixels.wrap(_UntilFallen(env) if terminates else env, "fixed", IMAGE_SIZE, frames=_FRAMES, layout="images")


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
        functools.partial(_make_cartpole, terminates=True),
        _playground_wrapper,
        {
            **_COMMON,
            "num_timesteps": 1_000_000,
            "num_evals": 13,
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
        {"frames": _FRAMES, "step_s": _CARTPOLE_CONTROL_PERIOD},
        functools.partial(_make_cartpole, terminates=False),
    ),
    "FetchReach": Task(
        _make_fetch,
        _brax_wrapper,
        {
            **_COMMON,
            "num_timesteps": 3_000_000,
            "num_evals": 11,
            # Number of resets with new goals between two evaluations: brax's automatic resets repeat the first episode.
            "num_resets_per_eval": 3,
            "episode_length": 50,
            "num_envs": 2048,
            "batch_size": 256,
            "num_updates_per_batch": 4,
            "discounting": 0.95,
            "reward_scaling": 10.0,
        },
        # Brax's default, the mean over the image, would lose the gripper's position.
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
"""Settings of the shortest possible run."""
