"""Training examples: resized images with true stalks, and full-resolution stalk crops with masks."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.detect import Settings
from jaxrl_vis.stalks.phenotyping.detector.finder import resize, upper_segment
from jaxrl_vis.stalks.phenotyping.detector.sections import NOTHING, STALK, STEP, UNCLEAR
from jaxrl_vis.stalks.phenotyping.detector.stalk_crops import crop_shape, cut_crops
from jaxrl_vis.stalks.phenotyping.training.edges import Edges, boxes_around_edges, cut_edges, synthetic_edges
from jaxrl_vis_envs.plants import Calibration, Family, draw
from jaxrl_vis_envs.plants.cameras import Pose
from jaxrl_vis_envs.plants.field import Plot
from jaxrl_vis_envs.plants.pairs import Sequence
from jaxrl_vis_envs.plants.truth import BAND, outline, stalks_in_view

MIN_VISIBLE = 0.3
"""Minimum visible fraction of a stalk's part in the band to count it as a `STALK`."""
MaskFunction = Callable[[np.ndarray, np.ndarray, tuple[int, int]], np.ndarray]
"""Function that returns the masks [N, h, w] bool of the crops of stalks with indices [N], given their positions (boxes and
axes) [N or more, 6] and the (height, width) of crops."""
MAX_STALKS = 56
"""Maximum number of stalks per training image; further ones are dropped."""
_BARELY = 0.02  # visible fraction below which a stalk is ignored
_THIN = 4
_AT_STALKS = 0.8  # fraction of the random image crops that are placed around a stalk
_SCALES = (-0.5, 0.6)  # range of the log scale factor of daylight images
# The same with sections: at the scale of the finder, stalks of photographs are 15 to 45 pixels wide, and those of daylight
# images at the resolution of the training cameras 3 to 15 (medians of images).
_SECTION_SCALES = (-1.6, 0.2)
_HIGHER = 0.3  # fraction of the stalks with an additional crop around the upper height


@dataclasses.dataclass(frozen=True)
class Example:
    """Training example from one image.

    Attributes:
        image: Resized image [h, w, 3] uint8.
        stalks: [T, 6] float32, boxes, and x coordinates of the axis at the top and bottom of the box, pixels of the resized
            image; padded to T = `MAX_STALKS`.
        kinds: [T] int32: `sections.NOTHING` (padding), ``UNCLEAR`` or ``STALK``.
        crops: Stalk crops [S, H, W, 3] uint8 at full resolution; S is not padded.
        masks: Masks [S, H, W] bool of the crops.
        edges: Edges [E, R, 3] float32 of E stalks in the resized image and their kinds [E] int32, not padded; None for networks
            without sections.
    """

    image: np.ndarray
    stalks: np.ndarray
    kinds: np.ndarray
    crops: np.ndarray
    masks: np.ndarray
    edges: Edges | None = None


def synthetic_examples(family: Family, settings: Settings, seed: int, frames: int = 4) -> list[Example]:
    """Render the training examples of one synthetic plot.

    Images of a daylight family are resized by random factors and cropped at random to the size in ``settings``.

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
    is_daytime, crop_scale = settled.scene.share > 0, 1.0
    if is_daytime:  # the scale of third-party images is not known exactly
        factor = float(np.exp(rng.uniform(*_SCALES)))
        if settings.section:  # stalk crops keep the scale at which stalks fit into them
            wider = float(np.exp(rng.uniform(*_SECTION_SCALES)))
            crop_scale, factor = factor / wider, wider
        pixels_per_metre *= factor
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
        how = (mask_function, settings, rng, _HIGHER, crop_scale)
        example = make_example(image, pixels_per_metre, stalks, kinds, *how)
        if settings.section:
            scale = image.shape[0] / example.image.shape[0], image.shape[1] / example.image.shape[1]
            pose, instances = sequence.drive.poses[frame], np.asarray(instance)
            edges = synthetic_edges(sequence.plot, pose, true, instances, example.image.shape[:2], scale)
            example = dataclasses.replace(example, edges=edges)
        if is_daytime:
            # Lenses and scales differ between plots, and each shape of crops would need a compilation.
            shape = crop_shape((settings.crop_height, settings.crop_width), family.rig.width / settings.full_width)
            example = resize_crops(crop_randomly(example, (settings.height, settings.width), rng), shape)
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
        Example with clipped stalks; those that are hardly left in the image become ``NOTHING``.
    """
    size = example.image.shape[:2]
    rows, columns = (min(length, limit) for length, limit in zip(size, max_size))
    low, high = np.zeros(2, int), np.array([size[0] - rows, size[1] - columns])
    boxes = example.stalks if example.edges is None else boxes_around_edges(example.edges[0])
    there = np.flatnonzero((example.kinds if example.edges is None else example.edges[1]) == STALK)
    if len(there) and rng.random() < _AT_STALKS:
        box = boxes[rng.choice(there)]
        middle = np.array([box[1] + box[3], box[0] + box[2]]) / 2
        low, high = (
            np.clip(middle - 0.9 * np.array([rows, columns]), 0, high),
            np.clip(middle - [0.1 * rows, 0.1 * columns], 0, high),
        )
    top, left = (int(rng.integers(int(first), int(last) + 1)) for first, last in zip(low, high))
    if example.edges is not None:
        top = top // STEP * STEP  # edges are those of every eighth row
    stalks = example.stalks - np.array([left, top, left, top, left, left], np.float32)
    inside = np.array([[rows, columns]]) > np.maximum(stalks[:, [1, 0]], 0.0)
    shown = (np.minimum(stalks[:, [3, 2]], [rows, columns]) - np.maximum(stalks[:, [1, 0]], 0.0) > [16.0, 3.0]) & inside
    there = shown.all(axis=1) & (example.kinds != NOTHING)
    kinds = np.where(there, example.kinds, NOTHING)
    image = example.image[top : top + rows, left : left + columns]
    return dataclasses.replace(
        example,
        image=np.ascontiguousarray(image),
        stalks=_clip_stalks(stalks, rows, columns),
        kinds=kinds,
        edges=None if example.edges is None else cut_edges(example.edges, top, left, rows),
    )


def _clip_stalks(stalks: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Clip the boxes of stalks [T, 6] to an image of ``rows`` x ``columns`` pixels, and their axes to the clipped boxes."""
    left, top, right, bottom, above, below = stalks.T
    slope = (below - above) / np.maximum(bottom - top, 1e-3)
    first, last = np.clip(top, 0, rows), np.clip(bottom, 0, rows)
    axis = above + slope * (first - top), below + slope * (last - bottom)
    return np.stack([np.clip(left, 0, columns), first, np.clip(right, 0, columns), last, *axis], axis=1).astype(np.float32)


def _instance_masks(
    instance: jax.Array, indices: np.ndarray, selected: np.ndarray, stalks: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """Cut the masks of stalk crops out of an instance segmentation. With the first two arguments bound, a `MaskFunction`.

    Args:
        instance: [H, W] int, index of the stalk at each pixel, -1 or less where there is none.
        indices: [T] int, index in ``instance`` of each stalk that has a box, see `true_boxes`.
        selected: [N] int, positions in ``indices`` of the stalks whose crops are cut.
        stalks: [N or more, 6] float32, boxes and axes of these stalks; further rows are padding and are dropped.
        shape: Height h and width w of a crop, pixels.

    Returns:
        [N, h, w] bool, False outside the image.
    """
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


def make_example(
    image: Any,
    pixels_per_metre: float | None,
    stalks: np.ndarray,
    kinds: np.ndarray,
    mask_function: MaskFunction,
    settings: Settings,
    rng: Any,
    higher: float = 0.0,
    crop_scale: float = 1.0,
) -> Example:
    """Build the example of an image, without edges.

    Args:
        image: [H, W, 3] uint8.
        pixels_per_metre: Resolution of the image at the row of plants; None if unknown.
        stalks: Boxes and axes [N, 6] in continuous coordinates of the image; those beyond `MAX_STALKS` get crops only.
        kinds: [N] int32; only those of kind ``STALK`` get a crop.
        mask_function: Function that returns the masks of the crops.
        settings: Settings of the networks.
        rng: NumPy generator of the jitter of crops.
        higher: Fraction of the stalks that also get a crop around the upper height.
        crop_scale: Factor on ``pixels_per_metre``, if known, at which the size of crops is computed.
    """
    full_image = np.asarray(image)
    reduced, scale = resize(full_image, settings, pixels_per_metre)
    for_crops = pixels_per_metre * crop_scale if pixels_per_metre else None
    relative_scale = settings.width / settings.full_width / settings.scale_for(full_image.shape[1], for_crops)
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
