"""``jaxrl-vis phenotype train --data``: training on annotated images."""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices, enable_compilation_cache
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.stalks.cli.options import BAND_WEIGHTS, DetectorTraining

if TYPE_CHECKING:
    from jaxrl_vis.stalks.phenotyping.detector.detect import Settings
    from jaxrl_vis.stalks.phenotyping.training.examples import Example
    from jaxrl_vis.stalks.phenotyping.training.photographs import Split
    from jaxrl_vis.stalks.phenotyping.training.tuning import TuningResult

_STEPS = 1500
_RATE, _RATE_FROM_RANDOM = 3e-4, 1e-3


def train_on_images(options: DetectorTraining, folder: Path) -> int:
    """Train on a folder of annotated images, and return the exit status.

    Write the weights and, beside them, an HTML report on held-out images, if there are enough images to hold some out.

    Raises:
        RequestError: The annotations or images are unusable, the initial weights do not fit them, or a file cannot be written.
    """
    began = time.monotonic()

    def echo(line: str) -> None:
        print(f"{time.monotonic() - began:6.1f} s  {line}", flush=True)

    echo(f"reading the annotations in {folder} ...")
    page = options.out.with_suffix(".html")
    check_writable(page, "OUT")
    from jaxrl_vis.stalks.phenotyping.io.annotations import read_annotations

    names = read_annotations(folder, options.label)
    echo(f"{folder}: {names['summary']}")
    check_devices()
    enable_compilation_cache()
    from jaxrl_vis import __version__
    from jaxrl_vis.stalks.phenotyping.detector.weights import write_weights
    from jaxrl_vis.stalks.phenotyping.training.annotated import has_outlines
    from jaxrl_vis.stalks.phenotyping.training.tuning import Tuning, tune

    start, settings, origin = _start(options, folder, echo)
    masks = has_outlines(folder, options.label)
    if not masks:
        echo("masks stay as they are: no annotation has an outline, only boxes")
    examples = _read_examples(options, folder, settings, len(names["images"]), echo)
    parts = _split(options, [image["file_name"] for image in names["images"]], examples, echo)
    tuning = Tuning(
        steps=options.steps or _STEPS,
        minutes=options.minutes,
        batch=options.batch,
        crops=options.crops if masks or start is None else 0,
        rate=options.rate or (_RATE_FROM_RANDOM if start is None else _RATE),
        seed=options.seed,
    )

    def save_best(params: Any, step: int) -> None:
        about = {"version": __version__, "origin": f"annotated images{origin}", "steps": step, "seed": options.seed}
        write_weights(options.out, params, settings, about)

    tuned = tune(examples, parts, settings, tuning, start, echo, save_best)
    save_best(tuned.params, tuned.best_step)
    echo(f"the end: {tuned.stop_reason}; weights are those of update {tuned.best_step}")
    if parts.test:
        _report(page, examples, parts, tuned, settings, start, masks, echo)
    size = options.out.stat().st_size / 1e6
    echo(f"{options.out}: {tuned.updates} updates on annotated images{origin}, {size:.1f} MB")
    return 0


def _read_examples(options: DetectorTraining, folder: Path, settings: Settings, count: int, echo: Any) -> list[Example]:
    """Read all images with their stalks and stalk crops, and report the progress every few seconds."""
    from jaxrl_vis.stalks.phenotyping.training.annotated import annotated_examples

    examples, last_report = [], time.monotonic()
    echo(f"reading {count} images ...")
    for example in annotated_examples(folder, settings, options.label):
        examples.append(example)
        if time.monotonic() - last_report > 5.0:
            last_report = time.monotonic()
            echo(f"{len(examples)} of {count} images read")
    return examples


def _split(options: DetectorTraining, names: list[str], examples: list[Example], echo: Any) -> Split:
    """Split the images by photograph into training, early-stopping and test sets, and report their sizes."""
    from jaxrl_vis.stalks.phenotyping.training.photographs import MIN_IMAGES, group_by_photograph, split_images

    parts = split_images(group_by_photograph(names, [example.image for example in examples]), options.seed)
    if not parts.test:
        echo(
            f"{parts.photographs} photographs, fewer than {MIN_IMAGES}: none is held out, "
            "so nothing tells how good the weights are"
        )
    else:
        echo(
            f"{len(examples)} images of {parts.photographs} photographs: {len(parts.train)} to learn from, {len(parts.stop)} "
            f"to decide when to stop, {len(parts.test)} for the report"
        )
    return parts


def _report(
    page: Path,
    examples: list[Example],
    split: Split,
    tuned: TuningResult,
    settings: Settings,
    start: Any,
    masks: bool,
    echo: Any,
) -> None:
    """Write the page that compares the weights before and after training on the test images, and print its scores."""
    import jax.numpy as jnp

    from jaxrl_vis.stalks.phenotyping.report.training_page import write_page
    from jaxrl_vis.stalks.phenotyping.training.held_out import mask_overlap, score_detections

    test = [examples[place] for place in split.test]
    scores = {name: score_detections(detections) for name, detections in (("before", tuned.before), ("after", tuned.after))}
    overlaps = dict.fromkeys(scores, math.nan)
    if masks:
        pairs = {"before": start, "after": tuned.params}
        overlaps = {
            name: mask_overlap(params["segmenter"], test, settings, jnp.float32)
            for name, params in pairs.items()
            if params is not None
        }
    for name, result in scores.items():
        overlap = overlaps.get(name, math.nan)
        echo(
            f"{name:6} on {result.images} held-out images: {result.true_positives} of {result.labels} "
            f"{'sections' if settings.section else 'stalks'} found, "
            f"{result.detections - result.true_positives} false detections, F1 {result.f1:.2f}, AP50 {result.ap50:.2f}"
            + (f", masks overlap {overlap:.2f}" if math.isfinite(overlap) else "")
        )
    facts = [
        f"{len(split.train)} images to learn from, {len(split.stop)} to decide when to stop, {len(split.test)} for this page; "
        f"{split.photographs} photographs, no copy of one on both sides.",
        f"{tuned.updates} updates in {tuned.update_s / 60:.1f} min after {tuned.compile_s:.0f} s of compilation; the end: "
        f"{tuned.stop_reason}; the weights are those of update {tuned.best_step}.",
    ]
    write_page(page, facts, test, {"before": tuned.before, "after": tuned.after}, scores, overlaps)
    echo(f"{page}: the held-out images, before and after")


def _start(options: DetectorTraining, folder: Path, echo: Any) -> tuple[Any, Settings, str]:
    """Return the initial parameters (None for random ones), settings of the networks, and a phrase for the origin.

    Without a calibration, networks detect sections: nothing in an image shows where the band is. With one, parameters are
    random if the shipped weights are for stalks of a very different size.

    Raises:
        RequestError: Weights given by ``--start`` are for stalks of a very different size.
    """
    from jaxrl_vis.stalks.phenotyping.detector.detect import Settings
    from jaxrl_vis.stalks.phenotyping.detector.weights import PHOTOGRAPHS, SHIPPED, read_weights
    from jaxrl_vis.stalks.phenotyping.io.calibration import find_calibration
    from jaxrl_vis.stalks.phenotyping.training.annotated import fit_settings
    from jaxrl_vis.stalks.phenotyping.training.detector_training import start_sections

    start = options.start or "shipped"
    calibrated = find_calibration(folder) is not None
    if start == "random":
        settings = Settings() if calibrated else Settings().for_sections()
        return None, fit_settings(folder, settings, options.label), ""
    shipped = SHIPPED if calibrated else PHOTOGRAPHS
    params, settings, _ = read_weights(shipped if start == "shipped" else Path(start))
    origin = f", from {'the weights that ship' if start == 'shipped' else start}"
    if not calibrated and not settings.section:
        params, settings = start_sections(params, settings, options.seed)
        echo(f"{start}: {BAND_WEIGHTS}")
    if settings.section:
        return params, fit_settings(folder, settings, options.label), origin
    fitting = fit_settings(folder, settings, options.label)
    if not 0.5 <= fitting.band_height / settings.band_height <= 2.0:
        why = (
            f"boxes of {folder} are {fitting.band_height:.0f} pixels tall in images of {fitting.width}, and those that "
            f"the weights `{start}` find {settings.band_height:.0f}"
        )
        if options.start is not None:
            raise RequestError(f"{why}: annotate stalks from 8 to 16 inches above the ground, or give --start random")
        echo(f"starting from random weights: {why}")
        return None, fitting, ""
    # The weights are tied to their anchors, so these are kept instead of those that fit the annotations. The number of
    # candidates is not: training adapts the head to new ones.
    settings = dataclasses.replace(
        fitting,
        band_height=settings.band_height,
        anchor_widths=settings.anchor_widths,
        candidates=Settings().candidates,
    )
    return params, settings, origin
