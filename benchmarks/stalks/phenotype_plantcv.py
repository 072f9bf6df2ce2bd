"""Comparison of widths of the same masks by PlantCV's `morphology.segment_width` and by ours, on synthetic plots.

PlantCV is not a dependency, and pins versions of many packages. So there are two steps, which may run on two machines:

    python benchmarks/stalks/phenotype_plantcv.py masks.npz --plots 10    # here: render plots, detect stalks, store their masks
    python benchmarks/stalks/phenotype_plantcv.py masks.npz               # with PlantCV installed; needs only NumPy besides

PlantCV measures pixels. Our widths are converted to millimetres by stereo, and PlantCV's by the same factor for the same mask,
so that only the widths of masks are compared. PlantCV is used as documented: skeletonize, prune, segment_width.
"""

import argparse
import functools
import sys
from pathlib import Path
from typing import Any

import numpy as np

PRUNED = 50
"""Length of the skeleton's barbs that PlantCV prunes, pixels; about that of its examples."""

Masks = tuple[list[np.ndarray], list[tuple[float, ...]]]
"""Packed masks, and for each: seed, stalk, height, width, mm per pixel, our width and the true one in mm, lean in degrees."""


def plot_masks(options: argparse.Namespace, seed: int) -> tuple[int, Masks]:
    """Render a plot; return its seed, and the masks that are measured at 12 inches with our width and the truth."""
    import dataclasses

    from jaxrl_vis.stalks.phenotyping.detector.finder import Finder
    from jaxrl_vis.stalks.phenotyping.detector.weights import SHIPPED, read_weights
    from jaxrl_vis.stalks.phenotyping.evaluation.perfect import perfect_detections
    from jaxrl_vis.stalks.phenotyping.evaluation.scoring import match_detections, true_diameter
    from jaxrl_vis.stalks.phenotyping.track.pairing import view_pair
    from jaxrl_vis_envs.plants import FAMILIES, draw
    from jaxrl_vis_envs.plants.pairs import Sequence
    from jaxrl_vis_envs.plants.truth import HEIGHTS, stalks_in_view

    family = FAMILIES[options.family].at_width(options.width)
    family = dataclasses.replace(family, rig=dataclasses.replace(family.rig, frames=options.frames))
    params, settings, _ = read_weights(SHIPPED)
    finder = Finder(params, settings)
    packed: list[np.ndarray] = []
    rows: list[tuple[float, ...]] = []
    sequence = Sequence.of(draw(family, seed))
    stated, true = sequence.drive.stated, sequence.drive.true
    for pair in sequence:
        left, right, instance = np.asarray(pair.left), np.asarray(pair.right), np.asarray(pair.instance)
        views = stalks_in_view(sequence.plot, pair.pose, true, instance, np.asarray(pair.depth))
        ideal = perfect_detections(map(dataclasses.asdict, views), instance)
        view = view_pair(
            (lambda image, pixels_per_metre, band, ideal=ideal: ideal) if options.truth else finder, left, right, stated
        )
        owners, _ = match_detections(view.detections, views)
        for find, sighting, owner in zip(view.detections, view.sightings, owners):
            at = sighting.height_m
            if owner is None or sighting.diameter_mm is None or at is None or abs(at - HEIGHTS[0]) > 0.0127:
                continue
            mask = np.asarray(find.mask, np.float32) >= 0.5
            packed.append(np.packbits(mask))
            scale = sighting.diameter_mm / (sighting.width_px or np.nan)
            truth = true_diameter(sequence.plot.stalks[owner])
            rows.append((seed, owner, *mask.shape, scale, sighting.diameter_mm, truth, sighting.lean_deg or 0.0))
    return seed, (packed, rows)


def keep_masks(options: argparse.Namespace) -> None:
    """Render plots, and write their masks, widths and true widths to ``options.file`` (.npz) for `compare`."""
    from jaxrl_vis.host.worker_pool import map_unordered, share_accelerator

    if options.workers > 1:
        share_accelerator()
    plots: list[tuple[int, Masks]] = []
    seeds = range(options.seed, options.seed + options.plots)
    for seed, masks in map_unordered(functools.partial(plot_masks, options), seeds, options.workers):
        plots.append((seed, masks))
        print(f"plot {seed}: {len(masks[1])} masks", flush=True)
    plots.sort(key=lambda plot: plot[0])
    packed = [mask for _, (masks, _) in plots for mask in masks]
    rows = [row for _, (_, about) in plots for row in about]
    ends = np.cumsum([len(mask) for mask in packed])
    drawn = f"{options.plots} synthetic plots of family {options.family}"
    about = f"{drawn}, {options.frames} pairs each, {options.width} pixels wide"
    masks = np.concatenate(packed) if packed else np.zeros(0, np.uint8)
    np.savez_compressed(options.file, masks=masks, ends=ends, rows=np.array(rows), about=f"{about}, {_masks_are(options)}")
    print(f"{options.file}: {len(rows)} masks, {options.file.stat().st_size / 1e6:.1f} MB")


def _masks_are(options: argparse.Namespace) -> str:
    return "true masks" if options.truth else "masks of the networks"


def plantcv_width(pcv: Any, mask: np.ndarray) -> float:
    """Return PlantCV's mean width of a mask [H, W] bool, in pixels; NaN if it finds none."""
    padded = np.pad(mask.astype(np.uint8) * 255, 3)
    skeleton = pcv.morphology.skeletonize(mask=padded)
    skeleton, segmented, _ = pcv.morphology.prune(skel_img=skeleton, size=PRUNED)
    pcv.outputs.clear()
    labels = (padded > 0).astype(np.int32)
    pcv.morphology.segment_width(segmented_img=segmented, skel_img=skeleton, labeled_mask=labels, n_labels=1, label="stalk")
    (width,) = pcv.outputs.observations["stalk"]["mean_segment_width"]["value"]
    return float(width) if width else float("nan")


def compare(file: Path) -> None:
    """Print the width errors of PlantCV and of this project on the stored masks, mm; exit with one line if PlantCV is missing.

    Args:
        file: The .npz file with masks, true widths and this project's widths.
    """
    try:
        from plantcv import plantcv as pcv  # pyright: ignore[reportMissingImports]
    except ImportError:
        sys.exit("PlantCV is not here: `pip install plantcv` in an environment of its own, and run this again there")
    pcv.params.debug, pcv.params.verbose = None, False
    stored = np.load(file)
    rows, starts = stored["rows"], np.concatenate([[0], stored["ends"][:-1]])
    theirs = []
    for row, start, end in zip(rows, starts, stored["ends"]):
        shape = int(row[2]), int(row[3])
        mask = np.unpackbits(stored["masks"][start:end], count=shape[0] * shape[1]).reshape(shape).astype(bool)
        theirs.append(plantcv_width(pcv, mask) * row[4])
    theirs = np.array(theirs)
    both = np.isfinite(theirs)
    print(f"{stored['about']}; {both.sum()} masks, {(~both).sum()} without a width by PlantCV; errors in mm")
    print("| | PlantCV: mean absolute | bias | ours: mean absolute | bias | n |\n|---|---|---|---|---|---|")
    ours, truth, lean = rows[both, 5], rows[both, 6], np.abs(rows[both, 7])
    theirs, stalks = theirs[both], rows[both][:, :2]
    for name, some in (
        ("each mask", lean >= 0),
        ("that leans by less than 4 degrees", lean < 4),
        ("by 4 to 8", (lean >= 4) & (lean < 8)),
        ("by more than 8", lean >= 8),
    ):
        _print(name, theirs[some], ours[some], truth[some])
    names, which = np.unique(stalks, axis=0, return_inverse=True)
    groups = [which.ravel() == index for index in range(len(names))]
    medians = [np.array([np.median(widths[group]) for group in groups]) for widths in (theirs, ours, truth)]
    _print("each stalk, median over its pairs", *medians)


def _print(name: str, theirs: np.ndarray, ours: np.ndarray, truth: np.ndarray) -> None:
    if len(truth):
        cells = [f"{np.abs(widths - truth).mean():.2f} | {(widths - truth).mean():+.2f}" for widths in (theirs, ours)]
        print(f"| {name} | {cells[0]} | {cells[1]} | {len(truth)} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Widths of the same masks by PlantCV and by ours.")
    parser.add_argument("file", type=Path, help="of masks, .npz; written with --plots, read without")
    parser.add_argument("--plots", type=int, default=0, help="number of plots to render, whose masks are kept")
    parser.add_argument("--seed", type=int, default=0, help="of the first plot")
    parser.add_argument("--family", default="shifted", choices=("training", "shifted"))
    parser.add_argument("--workers", type=int, default=1, help="processes that draw plots side by side")
    parser.add_argument("--frames", type=int, default=34, help="pairs of a plot")
    parser.add_argument("--width", type=int, default=3376, help="of an image, pixels")
    parser.add_argument("--truth", action="store_true", help="true masks instead of the networks'")
    arguments = parser.parse_args()
    if arguments.plots:
        keep_masks(arguments)
    else:
        compare(arguments.file)
