"""``jaxrl-vis grasp train``."""

import dataclasses
import functools
import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from jaxrl_vis.cli.checks import check_counts, check_extra
from jaxrl_vis.cli.families import family_of
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.devices import check_devices, enable_compilation_cache
from jaxrl_vis.errors import RequestError
from jaxrl_vis.evaluation_pool import map_unordered, share_accelerator
from jaxrl_vis.report.outputs import check_writable

_FIRST_SEED = 100_000
"""Of the rows that networks learn from: evaluations use the seeds below."""


_RATES = {"segmentation": 1e-3, "gan": 4e-4}


@dataclasses.dataclass(frozen=True)
class Train:
    """Train the network that paints stalks red, on synthetic rows: against a discriminator, or as a plain segmentation."""

    out: Annotated[Path, AlsoPositional()]
    """The file to write, .safetensors; give it to `grasp run` and `grasp eval` as --weights."""
    loss: Literal["gan", "segmentation"] = "segmentation"
    """What it learns by: a discriminator as in pix2pix, or cross entropy and Dice of the mask."""
    family: Literal["training", "shifted"] = "training"
    """What rows are drawn from; `shifted` is what evaluations are to be held against."""
    spec: Path | None = None
    """A JSON or TOML file with the values of a family of your own."""
    minutes: float | None = None
    """Most minutes; the weights are written at the end, and every half minute before."""
    steps: int = 20000
    """Most updates."""
    images: int = 800
    """How many images to learn from."""
    batch: int = 16
    """Crops per update."""
    crop: int = 384
    """Height and width of a crop, pixels: a multiple of 64."""
    rate: float | None = None
    """Highest learning rate; 0.001 for segmentation and 0.0004 for gan if not given."""
    workers: int = 4
    """How many processes draw rows while the network learns; 1: a thread of this one."""
    width: int | None = None
    """Width of a synthetic image in pixels, in place of the family's 1024; what is seen stays the same."""
    seed: int = 0
    """Of everything random."""


def train(options: Train) -> int:
    """Trains the network and writes its weights."""
    check_counts(
        steps=options.steps,
        images=options.images,
        batch=options.batch,
        crop=options.crop,
        workers=options.workers,
        width=options.width,
    )
    if options.minutes is not None and not options.minutes > 0:
        raise RequestError(f"--minutes must be more than 0, not {options.minutes:g}")
    if options.rate is not None and not options.rate > 0:
        raise RequestError(f"--rate must be more than 0, not {options.rate:g}")
    if options.crop % 64:
        raise RequestError(f"--crop must be a multiple of 64, not {options.crop}")
    if options.out.suffix != ".safetensors":
        raise RequestError(f"the weights go into a file that ends in .safetensors, not {options.out}")
    check_extra("grasp", "grasping")
    check_writable(options.out, "OUT")
    family = family_of(_Drawn(options.family, options.spec, options.width), "grasping")
    if options.workers > 1:
        share_accelerator()
    check_devices()
    enable_compilation_cache()
    return _train(options, family)


@dataclasses.dataclass(frozen=True)
class _Drawn:
    """What images are drawn from."""

    family: str
    spec: Path | None
    width: int | None
    shift: tuple[str, ...] = ()
    frames: int | None = None


def _train(options: Train, family) -> int:
    from jaxrl_vis import __version__
    from jaxrl_vis.grasping.masks.examples import Example, synthetic_examples
    from jaxrl_vis.grasping.masks.loop import Plan, train
    from jaxrl_vis.grasping.masks.painter import Settings, write_weights

    first = _FIRST_SEED * (1 + options.seed)
    draw = functools.partial(synthetic_examples, family)
    sources: list[Iterator[Example]] = [
        itertools.chain.from_iterable(map_unordered(draw, itertools.count(first), options.workers))
    ]
    settings = Settings(options.loss)
    plan = Plan(
        steps=options.steps,
        minutes=options.minutes,
        images=options.images,
        first=min(16, options.images),
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
