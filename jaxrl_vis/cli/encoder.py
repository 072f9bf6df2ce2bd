"""Command ``jaxrl-vis encoder``: train a small image encoder by itself."""

import dataclasses
from pathlib import Path

from jaxrl_vis.cli.checks import check_counts, check_env
from jaxrl_vis.cli.task_images import TaskImages
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices
from jaxrl_vis.report.outputs import check_writable


@dataclasses.dataclass(frozen=True)
class Encoder(TaskImages):
    """Train a small image encoder for a task, as an autoencoder, for `train --method features --reward-encoder FILE`."""

    out: Path = Path("encoder.npz")
    """The .npz file to write."""
    episodes: int = 200
    """Number of episodes of random actions that provide the training images."""
    updates: int = 2000
    """Number of gradient steps."""
    latent_size: int = 128
    """Size of the latent vector of an image."""


def run(options: Encoder) -> int:
    """Train an encoder, and print its error at the beginning and at the end."""
    check_env(options.env)
    check_counts(
        episodes=options.episodes, updates=options.updates, latent_size=options.latent_size, image_size=options.image_size
    )
    if options.out.suffix != ".npz":
        raise RequestError(f"--out {options.out}: an encoder is a file that ends in .npz")
    check_writable(options.out, "--out")
    check_devices()
    from jaxrl_vis.learner.environment import locate_env, make_env
    from jaxrl_vis.run.encoder import train_encoder

    config = locate_env(options.config(latent_size=options.latent_size, seed=options.seed, batch_size=128))
    errors = train_encoder(make_env(config), config, options.episodes, options.updates, options.out)
    print(f"{options.out}: mean squared error {errors[0]:.4f} at first, {errors[-1]:.4f} at the end")
    return 0
