"""Fit the gate of a weights file, and measure it: `python -m benchmarks.stalks.gate FOLDER --weights WEIGHTS`.

That of the weights that ship for unknown cameras, `PHOTOGRAPHS`, is fitted on the same images as if their cameras were unknown.

Images of several families are rendered into FOLDER unless they exist. The gate and its threshold are fitted on the images of
the first seeds, and written beside the weights; the printed metrics come from other seeds. A control uses only mean brightness
and sharpness of an image. Real images are never fitted on: `--photographs MODULE:FUNCTION` names a function that yields (image,
number of stalks, function from boxes [N, 4] to the number of stalks that they detect), and these are only evaluated.
"""

import argparse
import dataclasses
import functools
import importlib
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from benchmarks.stalks.gate_fit import fit_gate, fit_logistic_regression, write_gate
from jaxrl_vis.host.devices import enable_compilation_cache
from jaxrl_vis.host.worker_pool import evaluate_all, share_accelerator
from jaxrl_vis.stalks.phenotyping.detector.band import Band, in_frame
from jaxrl_vis.stalks.phenotyping.detector.finder import Finder
from jaxrl_vis.stalks.phenotyping.detector.gate import Gate, gate_path
from jaxrl_vis.stalks.phenotyping.detector.loading import detector_name, load_finder
from jaxrl_vis.stalks.phenotyping.detector.sections import STALK, UNCLEAR
from jaxrl_vis.stalks.phenotyping.detector.weights import PHOTOGRAPHS, SHIPPED
from jaxrl_vis.stalks.phenotyping.measure.borders import fill_borders, find_frame
from jaxrl_vis.stalks.phenotyping.training.examples import true_boxes
from jaxrl_vis.stalks.phenotyping.training.held_out import MIN_SCORE, match_to_annotations
from jaxrl_vis_envs import plants
from jaxrl_vis_envs.plants import Calibration, Plot, Pose
from jaxrl_vis_envs.plants.pairs import Sequence
from jaxrl_vis_envs.plants.truth import outline

FAMILIES = Path(__file__).with_name("families")
SPECS = ("daylight_all", "daylight_near", "maize_by_day", "thin_wet")
PLOTS = {"training": 28, "shifted": 28, "daylight_all": 36, "daylight_near": 20, "maize_by_day": 8, "thin_wet": 8}
"""Number of plots of each family for fitting, and for testing."""
FIRST_SEEDS = {"fit": 20_000, "test": 30_000}
WIDTH, FRAMES = 844, 2
MIN_F1 = 0.8
"""Minimum F1 of the detections of an image that counts as correct."""
MAX_FLAGGED = 0.03
"""Fraction of the correctly read images flagged in cross-validation; more are flagged among other images."""
AXES = 8
Photograph = tuple[np.ndarray, int, Callable[[np.ndarray], int]]


@dataclasses.dataclass(frozen=True)
class ImageStatistics:
    """Statistics of the detector on one image.

    Attributes:
        family: Name of the plot's family, or ``photographs``; "" before it is known.
        pooled: [C] float32, pooled features of the network.
        scores: [N] float32, scores of the detections.
        f1: F1 of the detections with a score of at least `MIN_SCORE`.
        plain: Mean brightness and sharpness of the image (`brightness_and_sharpness`).
    """

    family: str
    pooled: np.ndarray
    scores: np.ndarray
    f1: float
    plain: tuple[float, float]


def render_plot(folder: Path, purpose: str, family: str, number: int) -> Path:
    """Render `FRAMES` random images of one plot and their true boxes into a .npz file, unless it exists; return its path.

    Args:
        folder: Folder of the file; created if it does not exist.
        purpose: ``fit`` or ``test``, which selects the range of seeds.
        family: Name of a file of `SPECS`, or of a family of `jaxrl_vis_envs.plants`.
        number: Number of the plot, added to the first seed.
    """
    path = folder / f"{purpose}_{family}_{number}.npz"
    if path.exists():
        return path
    drawn_from = plants.read(FAMILIES / f"{family}.toml") if family in SPECS else plants.FAMILIES[family]
    seed = FIRST_SEEDS[purpose] + number
    sequence = Sequence.of(plants.draw(drawn_from.at_width(WIDTH), seed))
    true, arrays = sequence.drive.true, {}
    for index, frame in enumerate(np.random.default_rng(seed).choice(len(sequence), FRAMES, replace=False)):
        image, instance, depth = sequence.left(int(frame))
        thinned = np.asarray(instance[::4, ::4]), np.asarray(depth[::4, ::4])
        pose = sequence.drive.poses[frame]
        stalks, kinds, _ = true_boxes(sequence.plot, pose, true, *thinned)
        behind = boxes_behind(sequence.plot, pose, true, rows_of_boxes(stalks))
        arrays |= {f"image_{index}": np.asarray(image), f"stalks_{index}": stalks, f"kinds_{index}": kinds}
        arrays[f"behind_{index}"] = behind
    pixels_per_metre = sequence.drive.stated.focal / sequence.plot.family.rig.distance
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(path, pixels_per_metre=pixels_per_metre, **arrays)
    return path


def brightness_and_sharpness(image: np.ndarray) -> tuple[float, float]:
    """Return mean brightness, and sharpness (logarithm of the Laplacian's variance), of an image [H, W, 3] uint8."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64)
    return float(grey.mean()), float(np.log(cv2.Laplacian(grey, cv2.CV_64F).var() + 1e-3))


def rows_of_boxes(stalks: np.ndarray) -> Band | None:
    """Return the rows of the band in each column of an image, interpolated between true boxes [N, 6]; None without boxes."""
    if not len(stalks):
        return None
    order = np.argsort(stalks[:, [0, 2]].mean(axis=1))
    columns, tops, bottoms = stalks[order][:, [0, 2]].mean(axis=1), stalks[order, 1], stalks[order, 3]
    return lambda column: (float(np.interp(column, columns, tops)), float(np.interp(column, columns, bottoms)), True)


def boxes_behind(plot: Plot, pose: Pose, camera: Calibration, band: Band | None) -> np.ndarray:
    """Return the boxes of the stalks of the rows behind, which training ignores by day, within the band of the near row.

    Args:
        plot: Plot with its plants.
        pose: Pose of the left camera.
        camera: True calibration of the camera.
        band: Rows of the near row's band; None if it has no stalks in view.

    Returns:
        Boxes and axes [N, 6] float32 in continuous image coordinates; empty at night, when these stalks are dark.
    """
    boxes = []
    for stalk in plot.stalks:
        if band is None or plot.family.scene.share == 0 or stalk.row <= 0:
            continue
        edges = outline(stalk, pose, camera, np.linspace(stalk.points[:, 2].max(), 0.0, 40)) + 0.5  # from the top
        rows = edges[:, :, 1].mean(axis=1)
        top, bottom, _ = band(float(edges[:, :, 0].mean()))
        inside = np.linspace(max(top, rows[0]), min(bottom, rows[-1]), 20)
        if inside[0] >= inside[-1]:
            continue
        left, right = (np.interp(inside, rows, edges[:, side, 0]) for side in (0, 1))
        axis = (left + right)[[0, -1]] / 2
        boxes.append([left.min(), inside[0], right.max(), inside[-1], *axis])
    return np.array(boxes, np.float32).reshape(-1, 6)


def detect_stalks(
    finder: Finder, image: np.ndarray, pixels_per_metre: float | None, band: Band | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Detect stalks in an image whose borders are filled.

    Args:
        finder: The detector.
        image: [H, W, 3] uint8.
        pixels_per_metre: Pixels per metre at the plants; None if unknown.
        band: Rows to which networks that detect sections cut stalks; None if unknown.

    Returns:
        Detections [N, 6] in pixels of ``image``, their scores [N], and the pooled features [C].
    """
    frame = find_frame(image)
    over, down = frame.columns[0], frame.rows[0]
    inside = None if band is None else in_frame(band, frame)
    stalks, scores, pooled = finder.detect_boxes(fill_borders(image, frame), pixels_per_metre, inside)
    return stalks + np.array([over, down, over, down, over, over], np.float32), scores, pooled


def f1_score(hits: int, detections: int, stalks: int) -> float:
    """Return the F1 score for the numbers of correct detections, of detections and of stalks; 1 if the last two are 0."""
    return 2.0 * hits / (detections + stalks) if detections + stalks else 1.0


def image_statistics(path: Path, finder: Finder, name: str, is_known: bool) -> list[ImageStatistics]:
    """Return the statistics of each image in a file of `render_plot`, from the cache beside it, which is written if missing.

    Args:
        path: The file.
        finder: The detector.
        name: Name of the detector, whose last word identifies the cache.
        is_known: False to detect as if the camera were unknown.
    """
    with np.load(path) as data:
        if "behind_0" not in data:
            raise SystemExit(f"{path} was rendered by an earlier version: choose a new folder")
    cached = path.with_suffix(f".{name.split()[-1]}.npz")
    if not cached.exists():
        arrays = {}
        for index, seen in enumerate(_detect_images(path, finder, is_known)):
            values = {"pooled": seen.pooled, "scores": seen.scores, "f1": seen.f1, "plain": seen.plain}
            arrays |= {f"{key}_{index}": value for key, value in values.items()}
        np.savez(cached, **arrays)
    family = path.stem.split("_", 1)[1].rpartition("_")[0]
    with np.load(cached) as data:
        columns = [[data[f"{key}_{index}"] for index in range(FRAMES)] for key in ("pooled", "scores", "f1", "plain")]
    return [
        ImageStatistics(family, pooled, scores, float(f1), (float(plain[0]), float(plain[1])))
        for pooled, scores, f1, plain in zip(*columns)
    ]


def _detect_images(path: Path, finder: Finder, is_known: bool) -> Iterator[ImageStatistics]:
    with np.load(path) as data:
        for index in range(FRAMES):
            image, truth, kinds, behind = (data[f"{name}_{index}"] for name in ("image", "stalks", "kinds", "behind"))
            pixels_per_metre = float(data["pixels_per_metre"]) if is_known else None
            stalks, scores, pooled = detect_stalks(finder, image, pixels_per_metre, rows_of_boxes(truth))
            all_kinds = np.concatenate([kinds, np.full(len(behind), UNCLEAR, kinds.dtype)])
            right, ignored = match_to_annotations(stalks, scores, np.concatenate([truth, behind]), all_kinds)
            counted = (scores >= MIN_SCORE) & ~ignored
            f1 = f1_score(int((right & counted).sum()), int(counted.sum()), int((kinds == STALK).sum()))
            yield ImageStatistics("", pooled, scores, f1, brightness_and_sharpness(image))


def photograph_statistics(photographs: Iterator[Photograph], finder: Finder) -> Iterator[ImageStatistics]:
    """Yield the statistics of each photograph, detected without a known resolution, because the cameras are unknown."""
    for image, count, find_boxes in photographs:
        stalks, scores, pooled = detect_stalks(finder, image, None)
        boxes = stalks[scores >= MIN_SCORE][:, :4]
        yield ImageStatistics(
            "photographs", pooled, scores, f1_score(find_boxes(boxes), len(boxes), count), brightness_and_sharpness(image)
        )


def area_under_roc(values: np.ndarray, misread: np.ndarray) -> float:
    """Return the area under the ROC curve: the probability that a misread image has a higher value than another.

    Args:
        values: [N] float, one for each image.
        misread: [N] bool, True if the image was misread.

    Returns:
        The area, in which ties count one half; NaN if all images or none were misread.
    """
    above = values[misread][:, None] - values[~misread][None, :]
    return float(np.mean((above > 0) + 0.5 * (above == 0))) if above.size else float("nan")


def control_logits(fitted: list[ImageStatistics], tested: list[ImageStatistics]) -> np.ndarray:
    """Return the logits [N] of a logistic regression on brightness and sharpness, their squares and product.

    Args:
        fitted: Images on which the regression is fitted.
        tested: The N images for which the logits of being misread are returned.
    """

    def inputs(images: list[ImageStatistics]) -> np.ndarray:
        plain = (np.array([image.plain for image in images]) - [100.0, 6.0]) / [50.0, 2.0]
        return np.concatenate([plain, plain**2, plain[:, :1] * plain[:, 1:]], axis=1)

    weights = fit_logistic_regression(inputs(fitted), np.array([image.f1 < MIN_F1 for image in fitted]))
    return weights[0] + inputs(tested) @ weights[1:]


def report(name: str, images: list[ImageStatistics], gate: Gate, control_doubts: np.ndarray) -> None:
    """Print a line: number of misread images, area under the ROC curve of gate and control, and shares flagged by the gate.

    Args:
        name: Label of the line.
        images: Statistics of N images.
        gate: The gate.
        control_doubts: [N] logits of `control_logits`.
    """
    wrong = np.array([image.f1 < MIN_F1 for image in images])
    doubts = np.array([gate.doubt(image.pooled, image.scores) for image in images])
    flagged = doubts > gate.threshold
    parts = [f"{wrong.sum()} of {len(images)} read wrongly"]
    if wrong.any() and not wrong.all():
        roc = area_under_roc(doubts, wrong), area_under_roc(control_doubts, wrong)
        parts.append(f"area under ROC {roc[0]:.3f}, control {roc[1]:.3f}")
    if wrong.any():
        parts.append(f"{flagged[wrong].mean():.0%} of these flagged")
    if not wrong.all():
        parts.append(f"{flagged[~wrong].mean():.1%} of the others")
    print(f"{name:14} " + "; ".join(parts), flush=True)


def _render_task(folder: Path, tasks: list[tuple[str, str, int]], index: int) -> dict[str, str]:
    return {"path": str(render_plot(folder, *tasks[index]))}


def main() -> None:
    """Render the images, fit the gate, write it beside the weights, and print its metrics on the images for testing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--weights", type=Path, default=SHIPPED)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--photographs", help="module:function")
    parser.add_argument("--drawn", action="store_true", help="use the images that are there, and draw none")
    options = parser.parse_args()
    # Ordered by number first, so that an interrupted rendering covers all families.
    tasks = [
        (part, family, number)
        for number in range(max(PLOTS.values()))
        for part in FIRST_SEEDS
        for family, plots in PLOTS.items()
        if number < plots
    ]
    if not options.drawn:
        if options.workers > 1:
            share_accelerator()
        done = functools.partial(_render_task, options.folder, tasks)
        evaluate_all(done, range(len(tasks)), options.workers, lambda place, made: print(made["path"], flush=True))
    enable_compilation_cache()
    finder = load_finder(options.weights, MIN_SCORE)
    seen: dict[str, list[ImageStatistics]] = {part: [] for part in FIRST_SEEDS}
    for part, family, number in tasks:
        path = options.folder / f"{part}_{family}_{number}.npz"
        if path.exists():
            is_known = options.weights.resolve() != PHOTOGRAPHS
            seen[part] += image_statistics(path, finder, detector_name(options.weights), is_known)
    fitted, tried = seen["fit"], seen["test"]
    wrong = np.array([image.f1 < MIN_F1 for image in fitted])
    pooled, plots = np.array([image.pooled for image in fitted]), np.arange(len(fitted)) // FRAMES
    gate = fit_gate(pooled, [image.scores for image in fitted], wrong, plots, AXES, MAX_FLAGGED)
    about = {"images": len(fitted), "families": list(PLOTS), "origin": "synthetic images alone"}
    write_gate(options.weights, gate, about)
    if options.photographs:
        module, _, name = options.photographs.partition(":")
        tried += photograph_statistics(getattr(importlib.import_module(module), name)(), finder)
    doubts = control_logits(fitted, tried)
    print(f"{detector_name(options.weights)}: {len(fitted)} images to fit on, {len(tried)} to try; right is F1 >= {MIN_F1:g}")
    report("all", tried, gate, doubts)
    for family in dict.fromkeys(image.family for image in tried):
        chosen = [place for place, image in enumerate(tried) if image.family == family]
        report(family, [tried[place] for place in chosen], gate, doubts[chosen])
    path = gate_path(options.weights)
    print(f"{path}: threshold {gate.threshold:.3f}, {path.stat().st_size / 1e3:.1f} kB")


if __name__ == "__main__":
    main()
