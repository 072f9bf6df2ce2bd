"""``jaxrl-vis grasp train``: train the mask network."""

import dataclasses
import functools
import itertools
import time
from collections.abc import Iterator
from typing import Literal

from jaxrl_vis.cli.checks import check_counts
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices, enable_compilation_cache
from jaxrl_vis.host.worker_pool import map_unordered, share_accelerator
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.stalks.cli.options import DEFAULT_IMAGES, DEFAULT_STEPS, DEFAULT_WORKERS, TrainingOptions, check_extra

_FIRST_SEED = 100_000
"""First seed of the training rows with --seed 0; lower seeds are for evaluation."""


_RATES = {"segmentation": 1e-3, "gan": 4e-4}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Train(TrainingOptions):
    """Train the network that masks stalks, on synthetic rows: as a GAN, or as a plain segmentation."""

    loss: Literal["gan", "segmentation"] = "segmentation"
    """Loss: adversarial as in pix2pix (gan), or cross entropy and Dice of the mask (segmentation)."""
    crop: int = 384
    """Side length of square training crops in pixels, a multiple of 64."""


def train(options: Train) -> int:
    """Train the network, write its weights, and return the exit status.

    Raises:
        RequestError: An option is invalid, a package is missing, no device works, or OUT cannot be written to.
    """
    check_counts(crop=options.crop)
    options.check()
    if options.crop % 64:
        raise RequestError(f"--crop must be a multiple of 64, not {options.crop}")
    check_extra("grasping")
    check_writable(options.out, "OUT")
    family = options.read_family("grasping")
    if (options.workers or DEFAULT_WORKERS) > 1:
        share_accelerator()
    check_devices()
    enable_compilation_cache()
    return _train(options, family)


def _train(options: Train, family) -> int:
    from jaxrl_vis import __version__
    from jaxrl_vis.stalks.grasping.masks.examples import Example, synthetic_examples
    from jaxrl_vis.stalks.grasping.masks.mask_training import Plan, train
    from jaxrl_vis.stalks.grasping.masks.painter import Settings, write_weights

    first = _FIRST_SEED * (1 + options.seed)
    draw = functools.partial(synthetic_examples, family)
    sources: list[Iterator[Example]] = [
        itertools.chain.from_iterable(map_unordered(draw, itertools.count(first), options.workers or DEFAULT_WORKERS))
    ]
    settings = Settings(options.loss)
    images = options.images or DEFAULT_IMAGES
    plan = Plan(
        steps=options.steps or DEFAULT_STEPS,
        minutes=options.minutes,
        images=images,
        first=min(16, images),
        batch=options.batch,
        crop=options.crop,
        rate=options.rate or _RATES[options.loss],
        seed=options.seed,
    )
    about = {"version": __version__, "origin": f"synthetic rows of family {family.name}", "seed": options.seed}
    started = time.monotonic()

    def report(step, progress, images, losses, params) -> None:
        write_weights(options.out, params, settings, {**about, "steps": step})
        parts = "  ".join(f"{name} {value:.3f}" for name, value in losses.items())
        print(
            f"{(time.monotonic() - started) / 60:5.1f} min  {progress:4.0%}  step {step}  {images} images  {parts}", flush=True
        )

    params, steps = train(sources, settings, plan, report)
    write_weights(options.out, params, settings, {**about, "steps": steps})
    print(f"{options.out}: {options.loss}, {steps} updates on {about['origin']}, {options.out.stat().st_size / 1e6:.1f} MB")
    return 0
