"""``jaxrl-vis encoder``."""

import dataclasses
from pathlib import Path
from typing import Annotated

from jaxrl_vis.cli.checks import check_counts, check_env
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.config import Pixels, preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices
from jaxrl_vis.report.outputs import check_writable


@dataclasses.dataclass(frozen=True)
class Encoder:
    """Train a small encoder of a task's images, as an autoencoder, for `train --method features --reward-encoder FILE`."""

    env: Annotated[str, AlsoPositional()] = "VisualFetchReach"
    """Environment with images: a name that `jaxrl-vis envs` lists, or module:Name for your own."""
    out: Path = Path("encoder.npz")
    """The .npz file to write."""
    episodes: int = 200
    """Number of episodes of random actions whose images it is trained on."""
    updates: int = 2000
    """Number of gradient steps."""
    latent_size: int = 128
    """Size of an encoded image."""
    pixels: Pixels = "rgbd"
    """Channels of the images."""
    image_size: int = 64
    """Height and width of the images, in pixels."""
    env_options: tuple[str, ...] = ()
    """Further options of the environment, as name=value."""
    seed: int = 0
    """Seed of episodes and training."""


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

    config = preset(
        "fast",
        env=options.env,
        pixels=options.pixels,
        image_size=options.image_size,
        env_options=options.env_options,
        latent_size=options.latent_size,
        seed=options.seed,
        random_shift=0,
        batch_size=128,
    )
    config = locate_env(config)
    errors = train_encoder(make_env(config), config, options.episodes, options.updates, options.out)
    print(f"{options.out}: mean squared error {errors[0]:.4f} at first, {errors[-1]:.4f} at the end")
    return 0
