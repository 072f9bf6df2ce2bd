"""Training examples: resized images with true stalks, and full-resolution stalk crops with masks."""

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
from jaxrl_vis.stalks.phenotyping.detector.finder import resize, resize_factor, upper_segment
from jaxrl_vis.stalks.phenotyping.detector.losses import NOTHING, STALK, UNCLEAR
from jaxrl_vis.stalks.phenotyping.detector.stalk_crops import crop_shape, cut_crops
from jaxrl_vis.stalks.phenotyping.io.annotations import read_annotations
from jaxrl_vis.stalks.phenotyping.io.calibration import check_size, find_calibration, read_calibration
from jaxrl_vis.stalks.phenotyping.io.images import image_size, read_image, to_rgb8
from jaxrl_vis.stalks.phenotyping.io.masks import decode_mask, rasterise_polygons
from jaxrl_vis.stalks.phenotyping.track.sightings import USUAL_DISTANCE
from jaxrl_vis_envs.plants import Calibration, Family, draw
from jaxrl_vis_envs.plants.cameras import Pose
from jaxrl_vis_envs.plants.field import Plot
from jaxrl_vis_envs.plants.pairs import Sequence
from jaxrl_vis_envs.plants.truth import BAND, outline, stalks_in_view

MIN_VISIBLE = 0.3
"""Minimum visible fraction of a stalk's part in the band to count it as a `STALK`."""
_MaskFunction = Callable[[np.ndarray, np.ndarray, tuple[int, int]], np.ndarray]
"""Function that returns the masks [N, h, w] bool of the crops of stalks with indices [N], given their positions (boxes and
axes) [N or more, 6] and the (height, width) of crops."""
MAX_STALKS = 56
"""Maximum number of stalks per training image; further ones are dropped."""
_BARELY = 0.02  # visible fraction below which a stalk is ignored
_THIN = 4
_AT_STALKS = 0.8  # fraction of the random image crops that are placed around a stalk
_SCALES = (-0.5, 0.6)  # range of the log scale factor of daylight images
_HIGHER = 0.3  # fraction of the stalks with an additional crop around the upper height


@dataclasses.dataclass(frozen=True)
class Example:
    """Training example from one image.

    Attributes:
        image: Resized image [h, w, 3] uint8.
        stalks: [T, 6] float32, boxes, and x coordinates of the axis at the top and bottom of the box, pixels of the resized
            image; padded to T = `MAX_STALKS`.
        kinds: [T] int32: `losses.NOTHING` (padding), ``UNCLEAR`` or ``STALK``.
        crops: Stalk crops [S, H, W, 3] uint8 at full resolution; S is not padded.
        masks: Masks [S, H, W] bool of the crops.
    """

    image: np.ndarray
    stalks: np.ndarray
    kinds: np.ndarray
    crops: np.ndarray
    masks: np.ndarray


def synthetic_examples(family: Family, settings: Settings, seed: int, frames: int = 4) -> list[Example]:
    """Render the training examples of one synthetic plot.

    Images of a daylight family are rendered at random scales and cropped at random to the size in ``settings``.

    Args:
        family: Family from which the plot is sampled.
        settings: Settings of the networks.
        seed: Seed of the plot.
        frames: Maximum number of images, spread over the plot.
    """
    sequence = Sequence.of(draw(family, seed))
    settled = sequence.plot.family
    pixels_per_metre = sequence.drive.true.focal / settled.rig.distance
    rng = np.random.default_rng([seed, 17])
    by_day = settled.scene.share > 0
    if by_day:  # the scale of third-party images is not known exactly
        pixels_per_metre *= float(np.exp(rng.uniform(*_SCALES)))
    length = len(sequence)
    chosen = sorted({min(int((part + rng.random()) * length / frames), length - 1) for part in range(frames)})
    examples = []
    for frame in chosen:
        image, instance, depth = sequence.left(frame)
        # Every fourth pixel suffices to estimate visibility.
        true = sequence.drive.true
        thinned = np.asarray(instance[::_THIN, ::_THIN]), np.asarray(depth[::_THIN, ::_THIN])
        stalks, kinds, indices = true_boxes(sequence.plot, sequence.drive.poses[frame], true, *thinned)
        mask_function = functools.partial(_instance_masks, instance, indices)
        example = _make_example(image, pixels_per_metre, stalks, kinds, mask_function, settings, rng, _HIGHER)
        if by_day:
            # Lenses and scales differ between plots, and each shape of crops would need a compilation.
            shape = crop_shape((settings.crop_height, settings.crop_width), family.rig.width / settings.full_width)
            example = resize_crops(crop_randomly(example, (settings.lines, settings.width), rng), shape)
        examples.append(example)
    return examples


def resize_crops(example: Example, shape: tuple[int, int]) -> Example:
    """Resize the stalk crops and masks of an example to ``shape`` (height, width).

    Return the example itself if they have that size, or if there are none.
    """
    if not len(example.crops) or example.crops.shape[1:3] == shape:
        return example
    size = (shape[1], shape[0])
    crops = np.stack([cv2.resize(crop, size, interpolation=cv2.INTER_LINEAR) for crop in example.crops])
    masks = [cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0 for mask in example.masks]
    return dataclasses.replace(example, crops=crops, masks=np.stack(masks))


def crop_randomly(example: Example, max_size: tuple[int, int], rng: np.random.Generator) -> Example:
    """Crop the image of an example at random, mostly around a stalk.

    Args:
        example: Example to crop; its stalk crops are unchanged.
        max_size: Maximum height and width.
        rng: Generator of the position.

    Returns:
        Example with clipped stalks, of which those that are hardly left in the image are ``NOTHING``.
    """
    size = example.image.shape[:2]
    lines, columns = (min(length, limit) for length, limit in zip(size, max_size))
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
    return dataclasses.replace(
        example, image=np.ascontiguousarray(image), stalks=_clip_stalks(stalks, lines, columns), kinds=kinds
    )


def _clip_stalks(stalks: np.ndarray, lines: int, columns: int) -> np.ndarray:
    """Clip the boxes of stalks [T, 6] to an image of ``lines`` x ``columns`` pixels, and their axes to the clipped boxes."""
    left, top, right, bottom, above, below = stalks.T
    slope = (below - above) / np.maximum(bottom - top, 1e-3)
    first, last = np.clip(top, 0, lines), np.clip(bottom, 0, lines)
    axis = above + slope * (first - top), below + slope * (last - bottom)
    return np.stack([np.clip(left, 0, columns), first, np.clip(right, 0, columns), last, *axis], axis=1).astype(np.float32)


def _instance_masks(
    instance: jax.Array, indices: np.ndarray, selected: np.ndarray, stalks: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """Cut the masks of stalk crops out of an instance segmentation; see `_MaskFunction`."""
    cut_out = np.asarray(cut_crops(instance + 1, stalks, shape))[: len(selected)]  # 0 is outside the image
    return cut_out == indices[selected][:, None, None] + 1


def true_boxes(
    plot: Plot, pose: Pose, camera: Calibration, instance: np.ndarray, depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the true boxes of the stalks of the near row whose part in the band is visible in an image.

    Args:
        plot: Plot with its plants.
        pose: Pose of the left camera.
        camera: True calibration of the camera.
        instance, depth: Instance and depth images [h, w], subsampled by `_THIN` in both directions.

    Returns:
        Boxes and axes [N, 6] float32 in continuous image coordinates, which may extend beyond the image; kinds [N] int32; and
        indices of the stalks [N] int32.
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


def _make_example(
    image: Any,
    pixels_per_metre: float | None,
    stalks: np.ndarray,
    kinds: np.ndarray,
    mask_function: _MaskFunction,
    settings: Settings,
    rng: Any,
    higher: float = 0.0,
) -> Example:
    """Build the example of an image [H, W, 3]; a fraction ``higher`` of its stalks also gets a crop around the upper height."""
    full_image = np.asarray(image)
    reduced, scale = resize(full_image, settings, pixels_per_metre)
    relative_scale = settings.width / settings.full_width / settings.scale_for(full_image.shape[1], pixels_per_metre)
    shape = crop_shape((settings.crop_height, settings.crop_width), relative_scale)
    clear = np.flatnonzero(kinds == STALK)
    # Jitter the positions, as detections are not exact.
    moved = stalks[clear].copy()
    wide = 0.015 * (stalks[clear, 3] - stalks[clear, 1])[:, None]
    moved[:, 4:] += wide * rng.normal(size=(len(clear), 2))
    moved[:, 1::2][:, :2] += 2.0 * wide * rng.normal(size=(len(clear), 1))
    drawn = rng.random(len(clear)) < higher
    above = np.array([upper_segment(stalk) for stalk in moved[drawn]], np.float32).reshape(-1, 6)
    shown = above[:, 1] > 0
    clear, moved = np.concatenate([clear, clear[drawn][shown]]), np.concatenate([moved, above[shown]])
    on_device, places = jnp.asarray(image), moved
    crops, masks = np.zeros((0, *shape, 3), np.uint8), np.zeros((0, *shape), bool)
    if len(clear):
        filled = -(-len(clear) // 16) * 16  # few shapes, few compilations
        places = np.pad(places, ((0, filled - len(clear)), (0, 0)), mode="edge")
        crops = np.asarray(cut_crops(on_device, places, shape))[: len(clear)]
        masks = mask_function(clear, places, shape)
    divisor = np.array([scale[1], scale[0], scale[1], scale[0], scale[1], scale[1]], np.float32)
    count = min(len(stalks), MAX_STALKS)
    padded, padded_kinds = np.zeros((MAX_STALKS, 6), np.float32), np.full(MAX_STALKS, NOTHING, np.int32)
    padded[:count], padded_kinds[:count] = (stalks / divisor)[:count], kinds[:count]
    return Example(np.asarray(reduced), padded, padded_kinds, crops, masks)


def annotated_examples(folder: Path, settings: Settings, labels: tuple[str, ...] = ()) -> Iterator[Example]:
    """Yield the examples of a folder of annotated images; see `read_annotations`.

    The scale of the images is taken from the calibration in the folder, if there is one.

    Raises:
        RequestError: Annotations are missing or invalid, the calibration is invalid or for images of another size, or an image
            is missing or differs in size from its annotations.
    """
    data = read_annotations(folder, labels)
    resolution_of = _resolutions(folder, data["images"])
    of_image: dict[int, list[dict[str, Any]]] = {}
    for annotation in data["annotations"]:
        of_image.setdefault(annotation["image_id"], []).append(annotation)
    for number, about in enumerate(data["images"]):
        size, path = (about["height"], about["width"]), folder / about["file_name"]
        try:
            there = image_size(path)
            image = to_rgb8(read_image(path)) if there == size else None
        except OSError as error:
            raise RequestError(f"the annotations in {folder} name an image that cannot be read: {error}") from error
        if image is None or image.shape[:2] != size:
            # In an image of another size than the annotated one, boxes would be misplaced.
            raise RequestError(
                f"{path} has {there[1]} x {there[0]} pixels, but {about['source']} is for "
                f"{size[1]} x {size[0]}: save the image at the size at which it was annotated"
            )
        every = of_image.get(about["id"], [])
        annotations = [annotation for annotation in every if not annotation.get("iscrowd")]
        stalks = np.array([_annotated_stalk(annotation, size) for annotation in annotations], np.float32).reshape(-1, 6)
        strips = _cover_crowds([annotation for annotation in every if annotation.get("iscrowd")], stalks)
        kinds = np.array([STALK] * len(stalks) + [UNCLEAR] * len(strips), np.int32)
        stalks = np.concatenate([stalks, strips])
        rng = np.random.default_rng([number, 18])
        yield _make_example(
            image, resolution_of[about["id"]], stalks, kinds, functools.partial(_own_masks, annotations, size), settings, rng
        )


def _cover_crowds(crowds: list[dict[str, Any]], stalks: np.ndarray) -> np.ndarray:
    """Cover crowd regions (stalks annotated together) with overlapping strips [N, 6] float32 as wide as the image's stalks.

    Detections are ignored by their overlap with unclear stalks, and would hardly overlap the box of a whole region.
    """
    strips = []
    for crowd in crowds:
        left, top, wide, tall = crowd["bbox"]
        typical = float(np.median(stalks[:, 2] - stalks[:, 0])) if len(stalks) else tall / 8
        count = int(np.clip(round(2 * wide / max(typical, 1.0)) - 1, 1, MAX_STALKS // 2))
        narrow = 2 * wide / (count + 1)  # width, as each overlaps the next by half
        begins = left + np.arange(count) * narrow / 2
        strips += [[begin, top, begin + narrow, top + tall, begin + narrow / 2, begin + narrow / 2] for begin in begins]
    return np.array(strips, np.float32).reshape(-1, 6)


def _own_masks(
    annotations: list[dict[str, Any]],
    size: tuple[int, int],
    selected: np.ndarray,
    stalks: np.ndarray,
    shape: tuple[int, int],
) -> np.ndarray:
    """Cut the masks of stalk crops out of annotations; see `_MaskFunction`.

    One at a time: masks may overlap, and all of an image together could exceed the memory.
    """
    crops = [
        np.asarray(cut_crops(jnp.asarray(_annotated_mask(annotations[part], size)), stalks[index : index + 1], shape))
        for index, part in enumerate(selected)
    ]
    return np.concatenate(crops)


def _resolutions(folder: Path, images: list[dict[str, Any]]) -> dict[int, float | None]:
    """Return the pixels per metre at the row of each image by its id; all None if the folder has no calibration.

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


_MAX_ENLARGED = 3.0
_MAX_CROP_WIDTH = 512  # pixels
_MAX_WIDTH = 2048  # pixels: maximum width of a resized image


def fit_settings(folder: Path, settings: Settings, labels: tuple[str, ...] = ()) -> Settings:
    """Return settings with anchors adapted to the boxes of a folder's annotations.

    If the folder has no calibration, images are resized so that boxes are as tall as the band; detection with networks trained
    on them uses the same resizing. Stalk crops are scaled accordingly.

    Raises:
        RequestError: The annotations or the calibration of the folder cannot be read.
    """
    data = read_annotations(folder, labels)
    densities = _resolutions(folder, data["images"])
    known = all(densities.values())
    widths = {image["id"]: image["width"] for image in data["images"]}
    boxes = [annotation for annotation in data["annotations"] if not annotation.get("iscrowd")]
    if not known:
        tall = float(np.median([annotation["bbox"][3] / widths[annotation["image_id"]] for annotation in boxes]))
        width = round(min(settings.band_height / tall, _MAX_WIDTH, _MAX_ENLARGED * max(widths.values())))
        ratio = settings.full_width / settings.width
        settings = dataclasses.replace(
            settings, pixels_per_metre=0.0, width=max(width, 32), full_width=max(round(ratio * width), 32)
        )
    factors = {number: resize_factor(width, settings, densities[number]) for number, width in widths.items()}
    sizes = np.array([np.array(annotation["bbox"][2:], float) * factors[annotation["image_id"]] for annotation in boxes])
    # A stalk crop is at least twice as wide as the median box: trunks are thicker than stalks.
    columns = 8 * math.ceil(2.0 * settings.full_width / settings.width * float(np.median(sizes[:, 0])) / 8)
    return dataclasses.replace(
        settings,
        crop_width=min(max(settings.crop_width, columns), _MAX_CROP_WIDTH),
        band_height=round(float(np.median(sizes[:, 1])), 1),
        anchor_widths=tuple(round(float(width), 1) for width in np.quantile(sizes[:, 0], (0.2, 0.6, 0.95))),
    )


def has_outlines(folder: Path, labels: tuple[str, ...] = ()) -> bool:
    """Return True if any annotated stalk of a folder has a segmentation besides its box.

    Raises:
        RequestError: The annotations of the folder cannot be read.
    """
    annotations = read_annotations(folder, labels)["annotations"]
    return any(annotation["segmentation"] and not annotation.get("iscrowd") for annotation in annotations)


def _annotated_mask(annotation: dict[str, Any], size: tuple[int, int]) -> np.ndarray:
    """Return the mask [H, W] bool of one annotation; its box if it has no segmentation."""
    segmentation = annotation["segmentation"]
    if isinstance(segmentation, dict):
        return decode_mask(segmentation)
    left, top, wide, tall = annotation["bbox"]
    right, bottom = left + wide, top + tall
    return rasterise_polygons(segmentation or [[left, top, right, top, right, bottom, left, bottom]], size)


def _annotated_stalk(annotation: dict[str, Any], size: tuple[int, int]) -> list[float]:
    """Return the box and axis [6] of one annotation; the axis is fitted to its mask, and vertical if that is small."""
    left, top, wide, tall = annotation["bbox"]
    right, bottom = left + wide, top + tall
    line, column = np.nonzero(_annotated_mask(annotation, size))
    axis = [left + wide / 2] * 2
    if line.size > 50 and np.ptp(line) > 8:
        slope, offset = np.polyfit(line + 0.5, column + 0.5, 1)
        axis = [float(np.clip(offset + slope * edge, left, right)) for edge in (top, bottom)]
    return [left, top, right, bottom, *axis]
