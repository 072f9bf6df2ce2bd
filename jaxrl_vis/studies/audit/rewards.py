"""Rewards to audit, by name: built-in ones, the reward model of a run, or ``module:function``."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.config import Config
from jaxrl_vis.config.methods import METHODS
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.host import plugins
from jaxrl_vis.learner.ddpg.learned_reward import make_learned_reward
from jaxrl_vis.learner.memory.rewards import make_reward
from jaxrl_vis.run.trained.policy_file import check_whole
from jaxrl_vis.run.trained.restored_run import load, open_run
from jaxrl_vis.studies.audit.episodes import Reward
from jaxrl_vis.types import Batch

BUILT_IN = ("indicator", "indicator_tolerance", "features")
"""Built-in rewards, which need neither true states nor a run."""


def _make_batch(images: jax.Array, goals: jax.Array) -> Batch:
    """Return a batch with ``images`` [B, ...] as achieved observations, and placeholders for actions and true states."""
    nothing = jnp.zeros((len(images), 1))
    return Batch(jnp.stack([images, goals, images]), nothing, nothing, nothing)


def _reward_of_run(run_dir: Path, trust: bool) -> Reward:
    """Return the reward of the model that the first seed of a run has trained, scaled to [0, 1]; ``trust`` as in `open_run`.

    Raises:
        RequestError: The run has no reward model; from the reward: images have another shape.
    """
    check_whole(run_dir, "an audit of its reward")
    trainer = open_run(run_dir, trust=trust)
    program, resolved = trainer.program, trainer.program.resolved
    if not resolved.method.is_learned:
        raise RequestError(f"the run in {run_dir} has no model of rewards: train with --method autoencoder or classifier")
    train = jax.tree.map(lambda leaf: leaf[0], load(trainer, run_dir).train)
    if not hasattr(train.agent, "reward_model"):
        raise RequestError(f"the run in {run_dir} has no model of rewards: its algorithm is {trainer.config.run.algorithm}")
    networks = program.networks
    model = make_learned_reward(networks, trainer.config, resolved)
    assert model is not None
    scaling = networks.batch_scaling(train.statistics)
    low, high = resolved.reward_negative, resolved.reward_positive

    shape = networks.observation_spec.shape

    def reward(images: jax.Array, goals: jax.Array) -> jax.Array:
        if images.shape[1:] != shape:
            mismatch = f"the run in {run_dir} sees images of {shape}, and these are of {images.shape[1:]}"
            raise RequestError(f"{mismatch}: give --pixels and --image-size of the run")
        batch = _make_batch(images, goals)
        inputs = networks.prepare_batch(scaling, batch)
        rewards = model.compute_batch_rewards(train.agent.reward_model, scaling.observations, inputs, batch).reward
        return (rewards - low) / (high - low)

    return reward


def find_reward(name: str, config: Config, trust: bool = False) -> Reward:
    """Return a reward by name.

    Args:
        name: One of `BUILT_IN`, a run folder, or ``module:function`` of images and goal images.
        config: Configuration with the tolerance and encoder of the built-in rewards.
        trust: See `run.trained.restored_run.open_run`.

    Raises:
        RequestError: The reward is unknown, or something that it needs is missing.
    """
    if name in BUILT_IN:
        function = make_reward(config, METHODS[name])
        return lambda images, goals: function(_make_batch(images, goals), images, 1.0, 0.0)
    if (Path(name) / "config.json").exists():
        return _reward_of_run(Path(name), trust)
    if ":" not in name:
        others = "run folders and module:function are rewards, too"
        raise RequestError(f"unknown reward {name!r}{nearest(name, BUILT_IN)} ({others})")
    plugin: Any = plugins.find_component("reward", name, {}, config.environment.env_folder)
    if not callable(plugin):
        raise RequestError(f"{name} is not a reward: it must be a function of images and goal images")
    own: Any = plugin
    return own
