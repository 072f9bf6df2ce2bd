"""Training examples: reduced images with the stalks in them, and crops at full resolution with their masks."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.detector.detect import Settings
from jaxrl_vis.stalks.phenotyping.detector.finder import higher_up, resize, resize_factor
from jaxrl_vis.stalks.phenotyping.detector.losses import NOTHING, STALK, UNCLEAR
from jaxrl_vis.stalks.phenotyping.detector.stalk_crops import cut, snip_shape
from jaxrl_vis.stalks.phenotyping.io.annotations import read_annotations
from jaxrl_vis.stalks.phenotyping.io.calibration import check_size, find_calibration, read_calibration
from jaxrl_vis.stalks.phenotyping.io.images import image_size, read_image, rgb8
from jaxrl_vis.stalks.phenotyping.io.masks import decode_mask, outlined_mask
from jaxrl_vis.stalks.phenotyping.track.sightings import USUAL_DISTANCE
from jaxrl_vis_envs.plants import Calibration, Family, draw
from jaxrl_vis_envs.plants.cameras import Pose
from jaxrl_vis_envs.plants.field import Plot
from jaxrl_vis_envs.plants.pairs import Sequence
from jaxrl_vis_envs.plants.truth import BAND, outline, stalks_in_view

MIN_VISIBLE = 0.3
"""Share of a stalk in the band that must be seen for it to count."""
_MasksOf = Callable[[np.ndarray, np.ndarray, tuple[int, int]], np.ndarray]
"""Masks [N, h, w] bool of the snips of stalks with indices [N], from their places [N or more, 6] and the snips' shape."""
MAX_STALKS = 56
"""Stalks of an image that networks learn from."""
_BARELY = 0.02  # what is seen less is not there
_THIN = 4
_AT_STALKS = 0.8  # of images that are cut: the share that is cut around a stalk
_SCALES = (-0.5, 0.6)  # logarithms of the factors by which the scale of images by day varies
_HIGHER = 0.3  # share of the stalks of which the networks also learn the piece around the upper height


@dataclasses.dataclass(frozen=True)
class Example:
    """One image.

    Attributes:
        image: [h, w, 3] uint8, reduced.
        stalks: [T, 6] float32, box and columns of the axis at its top and bottom, pixels of the reduced image; padded.
        kinds: [T] int32: `losses.NOTHING`, ``UNCLEAR`` or ``STALK``.
        snips: [S, H, W, 3] uint8, at full resolution; not padded.
        masks: [S, H, W] bool.
    """

    image: np.ndarray
    stalks: np.ndarray
    kinds: np.ndarray
    snips: np.ndarray
    masks: np.ndarray


def synthetic_examples(family: Family, settings: Settings, seed: int, frames: int = 4) -> list[Example]:
    """Examples of one plot of a family.

    Args:
        family: Family that the plot is drawn from.
        settings: Settings of the networks.
        seed: Seed of the plot.
        frames: Number of images of it, spread over it.
    """
    sequence = Sequence.of(draw(family, seed))
    settled = sequence.plot.family
    density = sequence.drive.true.focal / settled.rig.distance
    rng = np.random.default_rng([seed, 17])
    by_day = settled.scene.share > 0
    if by_day:  # nobody knows the scale of other people's images exactly
        density *= float(np.exp(rng.uniform(*_SCALES)))
    length = len(sequence)
    chosen = sorted({min(int((part + rng.random()) * length / frames), length - 1) for part in range(frames)})
    examples = []
    for frame in chosen:
        image, instance, depth = sequence.left(frame)
        # What shows, and how much of it, is as well counted in every fourth pixel.
        true = sequence.drive.true
        thinned = np.asarray(instance[::_THIN, ::_THIN]), np.asarray(depth[::_THIN, ::_THIN])
        stalks, kinds, indices = true_boxes(sequence.plot, sequence.drive.poses[frame], true, *thinned)
        masks_of = functools.partial(_instance_masks, instance, indices)
        example = _example(image, density, stalks, kinds, masks_of, settings, rng, _HIGHER)
        if by_day:
            # Lenses and scales differ from plot to plot, and each shape of snips would be a program of its own.
            shape = snip_shape((settings.snip_lines, settings.snip_columns), family.rig.width / settings.full_width)
            example = resized_snips(cut_out(example, (settings.lines, settings.width), rng), shape)
        examples.append(example)
    return examples


def resized_snips(example: Example, shape: tuple[int, int]) -> Example:
    """Return an example whose snips, and their masks, have so many lines and columns."""
    if not len(example.snips) or example.snips.shape[1:3] == shape:
        return example
    size = (shape[1], shape[0])
    snips = np.stack([cv2.resize(snip, size, interpolation=cv2.INTER_LINEAR) for snip in example.snips])
    masks = [cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0 for mask in example.masks]
    return dataclasses.replace(example, snips=snips, masks=np.stack(masks))


def cut_out(example: Example, most: tuple[int, int], rng: np.random.Generator) -> Example:
    """Return an example with a part of its image of at most so many lines and columns, mostly around a stalk.

    Args:
        example: The example; its snips stay as they are.
        most: Most lines and columns.
        rng: For the place.
    """
    size = example.image.shape[:2]
    lines, columns = (min(length, limit) for length, limit in zip(size, most))
    low, high = np.zeros(2, int), np.array([size[0] - lines, size[1] - columns])
    there = np.flatnonzero(example.kinds == STALK)
    if len(there) and rng.random() < _AT_STALKS:
        box = example.stalks[rng.choice(there)]
        middle = np.array([box[1] + box[3], box[0] + box[2]]) / 2
        low, high = (
            np.clip(middle - 0.9 * np.array([lines, columns]), 0, high),
            np.clip(middle - [0.1 * lines, 0.1 * columns], 0, high),
        )
    top, left = (int(rng.integers(int(first), int(last) + 1)) for first, last in zip(low, high))
    stalks = example.stalks - np.array([left, top, left, top, left, left], np.float32)
    inside = np.array([[lines, columns]]) > np.maximum(stalks[:, [1, 0]], 0.0)
    shown = (np.minimum(stalks[:, [3, 2]], [lines, columns]) - np.maximum(stalks[:, [1, 0]], 0.0) > [16.0, 3.0]) & inside
    there = shown.all(axis=1) & (example.kinds != NOTHING)
    kinds = np.where(there, example.kinds, NOTHING)
    image = example.image[top : top + lines, left : left + columns]
    return dataclasses.replace(example, image=np.ascontiguousarray(image), stalks=_clipped(stalks, lines, columns), kinds=kinds)


def _clipped(stalks: np.ndarray, lines: int, columns: int) -> np.ndarray:
    """Return stalks [T, 6] with boxes cut off where an image ends, and the axis where the box does."""
    left, top, right, bottom, above, below = stalks.T
    slope = (below - above) / np.maximum(bottom - top, 1e-3)
    first, last = np.clip(top, 0, lines), np.clip(bottom, 0, lines)
    axis = above + slope * (first - top), below + slope * (last - bottom)
    return np.stack([np.clip(left, 0, columns), first, np.clip(right, 0, columns), last, *axis], axis=1).astype(np.float32)


def _instance_masks(
    instance: jax.Array, indices: np.ndarray, parts: np.ndarray, places: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """Masks of the snips of some stalks, cut out of what each pixel shows."""
    cut_out = np.asarray(cut(instance + 1, places, shape))[: len(parts)]  # 0 is beyond the image
    return cut_out == indices[parts][:, None, None] + 1


def true_boxes(
    plot: Plot, pose: Pose, camera: Calibration, instance: np.ndarray, depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The stalks of the near row whose part in the band one image shows, in continuous coordinates of the image.

    Args:
        plot: The plants.
        pose: Pose of the left camera.
        camera: As it is.
        instance, depth: [h, w], of each first of `_THIN` pixels in both directions.

    Returns:
        [N, 6] float32 boxes that may reach beyond the image, and axes; [N] int32 kinds; [N] int32 indices of the stalks.
    """
    centre = (camera.centre[0] / _THIN, camera.centre[1] / _THIN)
    small = Calibration(instance.shape[1], instance.shape[0], camera.focal / _THIN, centre, camera.baseline)
    stalks, kinds, indices = [], [], []
    for visible in stalks_in_view(plot, pose, small, instance, depth):
        if visible.band_box is None or visible.band_visible < _BARELY:
            continue
        edges = outline(plot.stalks[visible.stalk], pose, camera, np.linspace(BAND[1], BAND[0], 21)) + 0.5  # from the top
        middle = edges.mean(axis=1)
        (left, top), (right, bottom) = edges.min(axis=(0, 1)), edges.max(axis=(0, 1))
        axis = np.interp([top, bottom], middle[:, 1], middle[:, 0])
        stalks.append([left, top, right, bottom, *axis])
        kinds.append(STALK if visible.band_visible >= MIN_VISIBLE else UNCLEAR)
        indices.append(visible.stalk)
    return np.array(stalks, np.float32).reshape(-1, 6), np.array(kinds, np.int32), np.array(indices, np.int32)


def _example(
    image: Any,
    density: float | None,
    stalks: np.ndarray,
    kinds: np.ndarray,
    masks_of: _MasksOf,
    settings: Settings,
    rng: Any,
    higher: float = 0.0,
) -> Example:
    """An example of a whole image [H, W, 3]; of a share of its stalks, there are snips around the upper height, too."""
    whole = np.asarray(image)
    reduced, scale = resize(whole, settings, density)
    share = settings.width / settings.full_width / settings.resizing(whole.shape[1], density)
    shape = snip_shape((settings.snip_lines, settings.snip_columns), share)
    clear = np.flatnonzero(kinds == STALK)
    # A find is not exactly where the stalk is.
    moved = stalks[clear].copy()
    wide = 0.015 * (stalks[clear, 3] - stalks[clear, 1])[:, None]
    moved[:, 4:] += wide * rng.normal(size=(len(clear), 2))
    moved[:, 1::2][:, :2] += 2.0 * wide * rng.normal(size=(len(clear), 1))
    drawn = rng.random(len(clear)) < higher
    above = np.array([higher_up(stalk) for stalk in moved[drawn]], np.float32).reshape(-1, 6)
    shown = above[:, 1] > 0
    clear, moved = np.concatenate([clear, clear[drawn][shown]]), np.concatenate([moved, above[shown]])
    on_device, places = jnp.asarray(image), moved
    snips, masks = np.zeros((0, *shape, 3), np.uint8), np.zeros((0, *shape), bool)
    if len(clear):
        filled = -(-len(clear) // 16) * 16  # few shapes, few programs
        places = np.pad(places, ((0, filled - len(clear)), (0, 0)), mode="edge")
        snips = np.asarray(cut(on_device, places, shape))[: len(clear)]
        masks = masks_of(clear, places, shape)
    divisor = np.array([scale[1], scale[0], scale[1], scale[0], scale[1], scale[1]], np.float32)
    count = min(len(stalks), MAX_STALKS)
    padded, padded_kinds = np.zeros((MAX_STALKS, 6), np.float32), np.full(MAX_STALKS, NOTHING, np.int32)
    padded[:count], padded_kinds[:count] = (stalks / divisor)[:count], kinds[:count]
    return Example(np.asarray(reduced), padded, padded_kinds, snips, masks)


def annotated_examples(folder: Path, settings: Settings, labels: tuple[str, ...] = ()) -> Iterator[Example]:
    """Examples of a folder of annotated images; see `read_annotations`. Its calibration, if it has one, gives their scale.

    Raises:
        RequestError: There are no annotations, or one is wrong; or an image is missing, or of another size than they say.
    """
    data = read_annotations(folder, labels)
    density_of = _densities(folder, data["images"])
    of_image: dict[int, list[dict[str, Any]]] = {}
    for annotation in data["annotations"]:
        of_image.setdefault(annotation["image_id"], []).append(annotation)
    for number, about in enumerate(data["images"]):
        size, path = (about["height"], about["width"]), folder / about["file_name"]
        try:
            there = image_size(path)
            image = rgb8(read_image(path)) if there == size else None
        except OSError as error:
            raise RequestError(f"the annotations in {folder} name an image that cannot be read: {error}") from error
        if image is None or image.shape[:2] != size:
            # Where it is larger or smaller than what was annotated, boxes lie where no stalk is.
            raise RequestError(
                f"{path} has {there[1]} x {there[0]} pixels, but {about['source']} is for "
                f"{size[1]} x {size[0]}: save the image at the size at which it was annotated"
            )
        every = of_image.get(about["id"], [])
        annotations = [annotation for annotation in every if not annotation.get("iscrowd")]
        stalks = np.array([_annotated_stalk(annotation, size) for annotation in annotations], np.float32).reshape(-1, 6)
        strips = _strips([annotation for annotation in every if annotation.get("iscrowd")], stalks)
        kinds = np.array([STALK] * len(stalks) + [UNCLEAR] * len(strips), np.int32)
        stalks = np.concatenate([stalks, strips])
        rng = np.random.default_rng([number, 18])
        yield _example(
            image, density_of[about["id"]], stalks, kinds, functools.partial(_own_masks, annotations, size), settings, rng
        )


def _strips(crowds: list[dict[str, Any]], stalks: np.ndarray) -> np.ndarray:
    """Strips [N, 6] float32, as wide as the image's stalks, that cover regions of stalks that nobody told apart.

    Boxes are compared with strips, so that one of a region as a whole would keep no box in it from counting as a mistake.
    """
    strips = []
    for crowd in crowds:
        left, top, wide, tall = crowd["bbox"]
        typical = float(np.median(stalks[:, 2] - stalks[:, 0])) if len(stalks) else tall / 8
        count = int(np.clip(round(2 * wide / max(typical, 1.0)) - 1, 1, MAX_STALKS // 2))
        narrow = 2 * wide / (count + 1)  # each overlaps the next by half
        begins = left + np.arange(count) * narrow / 2
        strips += [[begin, top, begin + narrow, top + tall, begin + narrow / 2, begin + narrow / 2] for begin in begins]
    return np.array(strips, np.float32).reshape(-1, 6)


def _own_masks(
    annotations: list[dict[str, Any]],
    size: tuple[int, int],
    parts: np.ndarray,
    places: np.ndarray,
    shape: tuple[int, int],
) -> np.ndarray:
    """Masks of the snips of some stalks, cut out of the mask of each: they may overlap, and together fill the memory."""
    snips = [
        np.asarray(cut(jnp.asarray(_annotated_mask(annotations[part], size)), places[place : place + 1], shape))
        for place, part in enumerate(parts)
    ]
    return np.concatenate(snips)


def _densities(folder: Path, images: list[dict[str, Any]]) -> dict[int, float | None]:
    """Pixels per metre at the row of each image by its id; None for all where the folder has no calibration.

    Raises:
        RequestError: The calibration cannot be read, or is for images of another size.
    """
    path = find_calibration(folder)
    if path is None:
        return dict.fromkeys((image["id"] for image in images), None)
    calibration = read_calibration(path, image=folder / images[0]["file_name"])
    for image in images:
        check_size(calibration, image["width"], image["height"], str(folder / image["file_name"]))
    return dict.fromkeys((image["id"] for image in images), calibration.focal / USUAL_DISTANCE)


_MOST_ENLARGED = 3.0
_WIDEST_SNIP = 512  # pixels
_WIDEST = 2048  # pixels of an image that was resized so that its boxes have the size that networks know


def settings_for(folder: Path, settings: Settings, labels: tuple[str, ...] = ()) -> Settings:
    """Settings whose anchors are as large as the boxes of a folder's annotations.

    Images of unknown cameras are resized so that boxes are as tall as the band; what was learned from them is looked for in
    images that are resized likewise. Snips grow and shrink with them, as they show the stalk of a box.

    Raises:
        RequestError: The annotations or the calibration of the folder cannot be read.
    """
    data = read_annotations(folder, labels)
    densities = _densities(folder, data["images"])
    known = all(densities.values())
    widths = {image["id"]: image["width"] for image in data["images"]}
    boxes = [annotation for annotation in data["annotations"] if not annotation.get("iscrowd")]
    if not known:
        tall = float(np.median([annotation["bbox"][3] / widths[annotation["image_id"]] for annotation in boxes]))
        width = round(min(settings.band_lines / tall, _WIDEST, _MOST_ENLARGED * max(widths.values())))
        ratio = settings.full_width / settings.width
        settings = dataclasses.replace(settings, density=0.0, width=max(width, 32), full_width=max(round(ratio * width), 32))
    factors = {number: resize_factor(width, settings, densities[number]) for number, width in widths.items()}
    sizes = np.array([np.array(annotation["bbox"][2:], float) * factors[annotation["image_id"]] for annotation in boxes])
    # A snip is at least twice as wide as the boxes: trunks are thicker than stalks.
    columns = 8 * math.ceil(2.0 * settings.full_width / settings.width * float(np.median(sizes[:, 0])) / 8)
    return dataclasses.replace(
        settings,
        snip_columns=min(max(settings.snip_columns, columns), _WIDEST_SNIP),
        band_lines=round(float(np.median(sizes[:, 1])), 1),
        anchor_widths=tuple(round(float(width), 1) for width in np.quantile(sizes[:, 0], (0.2, 0.6, 0.95))),
    )


def any_outlined(folder: Path, labels: tuple[str, ...] = ()) -> bool:
    """Return True if any stalk that a folder annotates has more than a box."""
    annotations = read_annotations(folder, labels)["annotations"]
    return any(annotation["segmentation"] and not annotation.get("iscrowd") for annotation in annotations)


def _annotated_mask(annotation: dict[str, Any], size: tuple[int, int]) -> np.ndarray:
    """The mask [H, W] bool of one annotation; all of the box where there is none."""
    segmentation = annotation["segmentation"]
    if isinstance(segmentation, dict):
        return decode_mask(segmentation)
    left, top, wide, tall = annotation["bbox"]
    right, bottom = left + wide, top + tall
    return outlined_mask(segmentation or [[left, top, right, top, right, bottom, left, bottom]], size)


def _annotated_stalk(annotation: dict[str, Any], size: tuple[int, int]) -> list[float]:
    """Box and axis [6] of one annotation."""
    left, top, wide, tall = annotation["bbox"]
    right, bottom = left + wide, top + tall
    line, column = np.nonzero(_annotated_mask(annotation, size))
    axis = [left + wide / 2] * 2
    if line.size > 50 and np.ptp(line) > 8:
        slope, offset = np.polyfit(line + 0.5, column + 0.5, 1)
        axis = [float(np.clip(offset + slope * edge, left, right)) for edge in (top, bottom)]
    return [left, top, right, bottom, *axis]
