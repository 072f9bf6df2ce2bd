"""`play --aux`: video of a run's episodes with the predictions of its auxiliary tasks."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import enable_compilation_cache
from jaxrl_vis.learner.acting.rollout_parts import join_parts
from jaxrl_vis.learner.auxtasks import View
from jaxrl_vis.learner.auxtasks.auxiliary import Auxiliary
from jaxrl_vis.learner.auxtasks.egomotion import MAX_ANGLE
from jaxrl_vis.learner.networks.networks import Networks
from jaxrl_vis.report import auxiliary_video, videos
from jaxrl_vis.run.storage.folder import read_config
from jaxrl_vis.run.trained.policy_file import check_whole
from jaxrl_vis.run.trained.restored_run import Choice, load, open_run
from jaxrl_vis.types import Batch, Episodes, TrainState

SHOWN = ("autoencoder", "optical_flow", "egomotion")
"""Auxiliary tasks whose predictions can be shown."""


def play_auxiliary(
    run_dir: Path | str, out: Path | str, episodes: int = 6, trust: bool = False, checkpoint: Choice = None
) -> None:
    """Roll out the first seed of a run's checkpoint, and write a video of episodes and auxiliary predictions.

    Observation, goal, reconstruction, true and predicted optical flow, and the rotated image with its angle are shown side by
    side, as far as the run has the tasks. Predictions are those of the critic's heads, with ``critic_states`` of the actor's.

    Args:
        run_dir: The run folder.
        out: .gif, .mp4 (needs imageio-ffmpeg, the extra ``video``) or .html.
        episodes: Number of episodes.
        trust: As in `restored_run.open_run`.
        checkpoint: See `restored_run.Choice`.

    Raises:
        RequestError: There is no run, no usable checkpoint, no auxiliary task to show, or ``out`` cannot be written.
    """
    out = Path(out)
    videos.check_output(out)
    if out.suffix.lower() == ".png":
        raise RequestError(f"--aux makes a video: use {out.stem}.gif, .mp4 or .html instead of {out.name}")
    check_whole(run_dir, "--aux")
    tasks = read_config(Path(run_dir)).auxiliary.aux_tasks
    if not tasks:
        raise RequestError(f"the run in {run_dir} has no auxiliary tasks to show: train with --aux-tasks, or leave out --aux")
    if not set(tasks) & set(SHOWN):
        raise RequestError(
            f"the run in {run_dir} predicts nothing that can be drawn ({', '.join(tasks)}): --aux shows {', '.join(SHOWN)}"
        )
    # Uses a training rollout without exploration.
    trainer = open_run(run_dir, trust=trust, num_envs=episodes, random_action_probability=0.0, action_noise=0.0)
    env, config, networks = trainer.env, trainer.config, trainer.program.networks
    if networks is None:
        raise RequestError(f"--aux shows what networks of ddpg predict, and the run in {run_dir} has {config.run.algorithm}")
    train = load(trainer, run_dir, checkpoint).train
    enable_compilation_cache()
    parts = trainer.programs.play(train, jnp.stack([trainer.programs.evaluation_key] * config.run.seeds))
    played, outcome = jax.tree.map(lambda *leaves: join_parts(leaves, episodes, axis=1), *parts)
    auxiliary = trainer.program.auxiliary

    def predict(train: TrainState, episodes: Episodes, key: jax.Array) -> dict[str, jax.Array]:
        return _predict(networks, auxiliary, train, episodes, key)

    first, played = jax.tree.map(lambda leaf: leaf[0], (train, played))
    played = jax.jit(auxiliary.with_stored)(played)
    keys = jax.random.split(jax.random.key(config.run.seed), episodes)
    per_episode = jax.jit(predict)
    predictions = [
        jax.device_get(per_episode(first, jax.tree.map(lambda leaf, index=index: leaf[index], played), keys[index]))
        for index in range(episodes)
    ]
    values = {name: np.stack([prediction[name] for prediction in predictions]) for name in predictions[0]}
    channels = env.observation_spec.shape[0] // env.frame_stack
    images = np.asarray(played.observations)[:, :, :channels]  # the newest of stacked images
    episode_images = videos.EpisodeImages(images[:, :-1], images[:, -1], np.asarray(outcome["success"][0]))
    shown = auxiliary_video.Predictions(
        **{name: value[:, :, :channels] if name in ("reconstruction", "rotated") else value for name, value in values.items()}
    )
    drawn = auxiliary_video.draw_frames(episode_images, shown, trainer.programs.image_seconds)
    videos.write_images(*drawn, out, trainer.programs.image_seconds)


def _predict(networks: Networks, auxiliary: Auxiliary, train: TrainState, episode: Episodes, key: jax.Array) -> dict[str, Any]:
    """Compute the fields of `auxiliary_video.Predictions` for one episode.

    Args:
        networks: Architecture of the parameters.
        auxiliary: The auxiliary tasks.
        train: The learner of one seed.
        episode: One episode of `Episodes`.
        key: Random key of the rotations.
    """
    observations, actions = episode.observations, episode.actions
    count = actions.shape[0]
    before, after = observations[:count], observations[1 : count + 1]
    goals = jnp.broadcast_to(observations[-1], before.shape)
    nothing = jnp.zeros((count, 0))  # true states are not used here
    batch = Batch(jnp.stack([before, goals, after]), actions, nothing, nothing)
    batch = auxiliary.with_targets(key, batch, episode.stored)
    names = ("before", "after", *batch.views)
    inputs = networks.prepare_batch(networks.batch_scaling(train.statistics._replace(states=None)), batch)
    params = train.agent.actor if networks.critic_state_size else train.agent.critic
    latents = networks.encode_pieces(params, inputs.pieces(*names))
    latent_t, latent_tp1, *view_latents = latents.reshape(len(names), count, networks.config.network.latent_size)
    image = networks.normalize(networks.scaling(train.normalizer), before) if auxiliary.needs_image else None
    view = View(latent_t, actions, latent_tp1, image)
    predicted = auxiliary.predictions(params["heads"], view, dict(zip(batch.views, view_latents, strict=True)), batch)
    fields: dict[str, Any] = {}
    if "autoencoder" in predicted:
        fields["reconstruction"] = _as_image(networks, train, predicted["autoencoder"])
    if "optical_flow" in predicted:
        fields |= {"flow": batch.targets["optical_flow"], "flow_predicted": predicted["optical_flow"]}
    if "egomotion" in predicted:
        degrees = jnp.degrees(MAX_ANGLE)
        fields |= {"rotated": batch.views["egomotion"], "angle": degrees * batch.targets["egomotion"][:, 0]}
        fields["angle_predicted"] = degrees * predicted["egomotion"][:, 0]
    return fields


def _as_image(networks: Networks, train: TrainState, values: jax.Array) -> jax.Array:
    """Convert normalised images [T, C or 1, H, W] to uint8; a single grey channel is scaled linearly instead."""
    mean, scale = networks.scaling(train.normalizer)
    height, width = values.shape[-2:]
    if values.shape[1] == mean.shape[0]:
        levels = values / scale[:, :height, :width] + mean[:, :height, :width]
    else:  # one normalised grey channel
        levels = 127.5 * (1.0 + values / networks.config.network.normalizer_clip)
    return jnp.clip(jnp.round(levels), 0, 255).astype(jnp.uint8)
