"""Training of a small image encoder, as an autoencoder on episodes of random actions, for the method ``features``."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import jaxrl_vis_envs
from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.ddpg.learned_reward import RewardInputs, make_autoencoder
from jaxrl_vis.learner.networks import frozen_encoder, normalizer
from jaxrl_vis.learner.networks.networks import Networks
from jaxrl_vis.learner.resolved import resolve
from jaxrl_vis.types import Batch, NormalizerState
from jaxrl_vis_envs.base import GoalEnv


def _collect(env: GoalEnv, episodes: int) -> Callable[[jax.Array], jax.Array]:
    """Build the function key -> images [N, C, H, W] uint8 of episodes of random actions: after every step, and of the goals.

    N is ``episodes`` times T + 1.
    """

    def episode(key: jax.Array) -> jax.Array:
        start_key, action_key = jax.random.split(key)
        start: Any = env.reset(start_key)

        def step(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
            state = env.advance(state, action)
            return state, env.observe(state)

        actions = jax.random.uniform(action_key, (env.horizon, env.action_size), minval=-1.0, maxval=1.0)
        images = jax.lax.scan(step, start, actions)[1]
        return jnp.concatenate([images, start.obs["desired_goal"][None]])

    def collect(key: jax.Array) -> jax.Array:
        images = jax.vmap(episode)(jax.random.split(key, episodes))
        return images.reshape(-1, *images.shape[2:])

    return jaxrl_vis_envs.jit(collect)


def train_encoder(env: GoalEnv, config: Config, episodes: int, updates: int, path: Path | str) -> list[float]:
    """Train an encoder, and write it to a file (`frozen_encoder.load`).

    Args:
        env: The task.
        config: Sizes of the encoder, batch size, learning rate (the critic's) and seed.
        episodes: Number of episodes of random actions.
        updates: Number of gradient steps.
        path: The file, .npz.

    Returns:
        The mean squared reconstruction error of normalised images, for each gradient step.

    Raises:
        RequestError: The task's observations are states.
    """
    if len(env.observation_spec.shape) != 3:
        raise RequestError(
            f"an encoder is trained on images, and {config.environment.env} shows states: name its Visual variant"
        )
    config = config.replace(method="autoencoder", random_shift=0, compute_dtype="float32")
    networks = Networks(config, env.observation_spec, env.action_size, 0.0)
    model = make_autoencoder(networks, config, resolve(config, env.horizon))
    init_key, image_key, batch_key = jax.random.split(jax.random.key(config.run.seed), 3)
    images = _collect(env, episodes)(image_key)
    statistics: NormalizerState = normalizer.update(normalizer.init(env.observation_spec), images, (0,))
    scaling = networks.scaling(statistics)

    def update(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        chosen = images[jax.random.randint(key, (config.run.batch_size,), 0, len(images))]
        nothing = jnp.zeros((len(chosen), env.action_size))
        batch = Batch(jnp.stack([chosen] * 3), nothing, nothing, nothing)
        pieces = [(networks.prepare(scaling, chosen), slice(None))]
        compared = RewardInputs(pieces, pieces, networks.normalize(scaling, chosen), batch)
        loss, gradient = jax.value_and_grad(lambda params: model.loss_and_reward(params, compared)[0])(state.params)
        return model.apply(state, gradient), loss

    train = jax.jit(lambda keys: jax.lax.scan(update, model.init(init_key), keys))
    state, errors = train(jax.random.split(batch_key, updates))
    frozen_encoder.save(path, jax.device_get(state.params["encoder"]), jax.device_get(scaling))
    return [float(error) for error in errors]
