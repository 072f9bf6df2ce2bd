"""``jaxrl-vis phenotype train``: train the detection and segmentation networks."""

import dataclasses
import functools
import itertools
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxrl_vis.cli.checks import check_counts
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices, enable_compilation_cache
from jaxrl_vis.host.worker_pool import map_unordered, share_accelerator
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.stalks.cli.options import (
    BAND_WEIGHTS,
    DEFAULT_IMAGES,
    DEFAULT_STEPS,
    DEFAULT_WORKERS,
    DetectorTraining,
    check_extra,
)
from jaxrl_vis.stalks.cli.tuning import train_on_images

if TYPE_CHECKING:
    from jaxrl_vis.stalks.phenotyping.detector.detect import Settings
    from jaxrl_vis.stalks.phenotyping.training.examples import Example
    from jaxrl_vis_envs.plants import Family

_FIRST_SEED = 100_000
"""First seed of the training plots with --seed 0; lower seeds are for evaluation."""


def train(options: DetectorTraining) -> int:
    """Train the networks, write their weights, and return the exit status.

    Raises:
        RequestError: An option, the annotations or the initial weights are invalid, a package is missing, no device works, or
            OUT cannot be written to.
    """
    check_counts(crops=options.crops)
    options.check()
    drawn = (options.family, options.shift, options.spec, options.mix, options.frames, options.width)
    if options.data is not None and any((*drawn, options.images, options.workers)):
        raise RequestError(
            "--data takes images of your own: leave out --spec, --mix and --width, --family, --shift, --frames, --images and "
            "--workers, which are for synthetic ones"
        )
    if options.label and options.data is None:
        raise RequestError("--label goes with --data: synthetic plots have their own labels")
    check_extra("phenotyping")
    check_writable(options.out, "OUT")
    if options.data is not None:
        return train_on_images(options, options.data)
    if (options.workers or DEFAULT_WORKERS) > 1:
        share_accelerator()
    check_devices()
    enable_compilation_cache()
    return _train(options)


def _train(options: DetectorTraining) -> int:
    from jaxrl_vis import __version__
    from jaxrl_vis.stalks.phenotyping.detector.weights import write_weights
    from jaxrl_vis.stalks.phenotyping.training.detector_training import Plan, train
    from jaxrl_vis.stalks.phenotyping.training.examples import Example

    mixed = [dataclasses.replace(options, family=None, shift=(), spec=spec) for spec in options.mix]
    families = [source.read_family("phenotyping") for source in (options, *mixed)]
    before, settings, origin_before = _start(options, any(family.scene.share > 0 for family in families))
    first = _FIRST_SEED * (1 + options.seed)
    draw = functools.partial(_draw_examples, families, settings)
    sources: list[Iterator[Example]] = [
        itertools.chain.from_iterable(map_unordered(draw, itertools.count(first), options.workers or DEFAULT_WORKERS))
    ]
    origin = f"synthetic plots of {'families' if options.mix else 'family'} {' and '.join(family.name for family in families)}"
    images = options.images or DEFAULT_IMAGES
    plan = Plan(
        steps=options.steps or DEFAULT_STEPS,
        minutes=options.minutes,
        images=images,
        first=min(24, images),
        batch=options.batch,
        crops=options.crops,
        rate=options.rate or (1e-3 if before is None else 3e-4),
        seed=options.seed,
    )
    about = {"version": __version__, "origin": origin + origin_before, "steps": 0, "seed": options.seed}
    started = time.monotonic()

    def report(step, progress, images, losses, params) -> None:
        write_weights(options.out, params, settings, {**about, "steps": step})
        parts = "  ".join(f"{name} {value:.3f}" for name, value in losses.items())
        print(
            f"{(time.monotonic() - started) / 60:5.1f} min  {progress:4.0%}  step {step}  {images} images  {parts}", flush=True
        )

    params, steps = train(sources, settings, plan, report, start=before)
    write_weights(options.out, params, settings, {**about, "steps": steps})
    print(f"{options.out}: {steps} updates on {origin}{origin_before}, {options.out.stat().st_size / 1e6:.1f} MB")
    return 0


def _draw_examples(families: "Sequence[Family]", settings: "Settings", seed: int) -> "list[Example]":
    """Return the examples of the plot of a seed, of one family after the other."""
    from jaxrl_vis.stalks.phenotyping.training.examples import synthetic_examples

    return synthetic_examples(families[seed % len(families)], settings, seed)


def _start(options: DetectorTraining, is_daytime: bool) -> tuple[Any, "Settings", str]:
    """Return the initial parameters (None for random ones), settings of the networks, and a phrase for the origin.

    For daytime plots, networks detect sections: nothing in an image of an unknown camera shows where the band is.
    """
    from jaxrl_vis.stalks.phenotyping.detector.detect import Settings
    from jaxrl_vis.stalks.phenotyping.detector.weights import PHOTOGRAPHS, SHIPPED, read_weights
    from jaxrl_vis.stalks.phenotyping.training.detector_training import start_sections

    start = options.start or "random"
    if start == "random":
        return None, Settings().for_sections() if is_daytime else Settings(), ""
    shipped = PHOTOGRAPHS if is_daytime else SHIPPED
    params, settings, _ = read_weights(shipped if start == "shipped" else Path(start))
    if is_daytime and not settings.section:
        params, settings = start_sections(params, settings, options.seed)
        print(f"{start}: {BAND_WEIGHTS}", flush=True)
    # The number of candidates is not tied to the weights: training adapts the head to new ones.
    settings = dataclasses.replace(settings, candidates=Settings().candidates)
    return params, settings, f", from {'the weights that ship' if start == 'shipped' else start}"
