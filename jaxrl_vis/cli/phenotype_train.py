"""``jaxrl-vis phenotype train``."""

import dataclasses
import functools
import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from jaxrl_vis.cli.checks import check_counts, check_extra
from jaxrl_vis.cli.parsing import ByPlaceToo
from jaxrl_vis.devices import check_devices, enable_compilation_cache
from jaxrl_vis.errors import RequestError
from jaxrl_vis.evaluation_pool import results_of, share_accelerator
from jaxrl_vis.report.outputs import check_writable

_FIRST_SEED = 100_000
"""Of the plots that networks learn from: evaluations use the seeds below."""


@dataclasses.dataclass(frozen=True)
class Train:
    """Train the networks that find and outline stalks, on synthetic plots or on your own annotated images."""

    out: Annotated[Path, ByPlaceToo()]
    """The file to write, .npz; give it to `phenotype run` as --weights."""
    data: Path | None = None
    """A folder of annotated images (annotations.json of COCO, or .xml of Pascal VOC or .json of LabelMe beside each image), in
    place of synthetic plots."""
    spec: Path | None = None
    """A JSON or TOML file with the values of a synthetic family of your own."""
    minutes: float | None = None
    """Most minutes; the weights are written at the end, and every half minute before."""
    steps: int = 20000
    """Most updates."""
    images: int = 800
    """How many images to learn from."""
    batch: int = 8
    """Images per update."""
    snips: int = 32
    """Strips at full resolution per update, for the masks."""
    rate: float = 1e-3
    """Highest learning rate."""
    workers: int = 4
    """How many processes draw synthetic plots while the networks learn; 1: a thread of this one."""
    width: int | None = None
    """Width of a synthetic image in pixels, in place of the family's 3376; what is seen stays the same."""
    seed: int = 0
    """Of everything random."""


def train(options: Train) -> int:
    """Trains the networks and writes their weights."""
    check_counts(
        steps=options.steps,
        images=options.images,
        batch=options.batch,
        snips=options.snips,
        workers=options.workers,
        width=options.width,
    )
    if options.data is not None and (options.spec is not None or options.width is not None):
        raise RequestError("--data takes images of your own: leave out --spec and --width, which describe synthetic ones")
    if options.minutes is not None and not options.minutes > 0:
        raise RequestError(f"--minutes must be more than 0, not {options.minutes:g}")
    if options.out.suffix != ".npz":
        raise RequestError(f"the weights go into a file that ends in .npz, not {options.out}")
    check_extra("phenotype", "phenotyping")
    check_writable(options.out, "OUT")
    if options.workers > 1:
        share_accelerator()
    check_devices()
    enable_compilation_cache()
    return _train(options)


def _train(options: Train) -> int:
    from jaxrl_vis import __version__
    from jaxrl_vis.phenotyping.detector.detect import Settings
    from jaxrl_vis.phenotyping.detector.weights import write_weights
    from jaxrl_vis.phenotyping.training.examples import Example, annotated_examples, settings_for, synthetic_examples
    from jaxrl_vis.phenotyping.training.loop import Plan, train
    from jaxrl_vis_envs.plants import TRAINING, read

    settings = Settings()
    sources: list[Iterator[Example]]
    if options.data is not None:
        settings = settings_for(options.data, settings)
        sources = [annotated_examples(options.data, settings)]
        origin = "annotated images"
    else:
        try:
            family = TRAINING if options.spec is None else read(options.spec)
            family = family if options.width is None else family.at_width(options.width)
        except ValueError as error:
            raise RequestError(str(error)) from error
        first = _FIRST_SEED * (1 + options.seed)
        draw = functools.partial(synthetic_examples, family, settings)
        sources = [itertools.chain.from_iterable(results_of(draw, itertools.count(first), options.workers))]
        origin = f"synthetic plots of family {family.name}"
    plan = Plan(
        steps=options.steps,
        minutes=options.minutes,
        images=options.images,
        first=min(24, options.images),
        batch=options.batch,
        snips=options.snips,
        rate=options.rate,
        seed=options.seed,
    )
    about = {"version": __version__, "origin": origin, "steps": 0, "seed": options.seed}
    started = time.monotonic()

    def report(step, progress, images, losses, params) -> None:
        write_weights(options.out, params, settings, {**about, "steps": step})
        parts = "  ".join(f"{name} {value:.3f}" for name, value in losses.items())
        print(
            f"{(time.monotonic() - started) / 60:5.1f} min  {progress:4.0%}  step {step}  {images} images  {parts}", flush=True
        )

    params, steps = train(sources, settings, plan, report)
    write_weights(options.out, params, settings, {**about, "steps": steps})
    print(f"{options.out}: {steps} updates on {origin}, {options.out.stat().st_size / 1e6:.1f} MB")
    return 0
