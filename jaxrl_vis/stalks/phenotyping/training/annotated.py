"""Training examples and settings of the networks from a folder of annotated images."""

import dataclasses
import functools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.detector.detect import Settings
from jaxrl_vis.stalks.phenotyping.detector.finder import resize_factor
from jaxrl_vis.stalks.phenotyping.detector.sections import STALK, UNCLEAR
from jaxrl_vis.stalks.phenotyping.detector.stalk_crops import cut_crops
from jaxrl_vis.stalks.phenotyping.io.annotations import read_annotations
from jaxrl_vis.stalks.phenotyping.io.calibration import check_size, find_calibration, read_calibration
from jaxrl_vis.stalks.phenotyping.io.images import image_size, read_image, to_rgb8
from jaxrl_vis.stalks.phenotyping.io.masks import decode_mask, rasterize_polygons
from jaxrl_vis.stalks.phenotyping.track.sightings import USUAL_DISTANCE
from jaxrl_vis.stalks.phenotyping.training.edges import annotated_edges
from jaxrl_vis.stalks.phenotyping.training.examples import MAX_STALKS, Example, make_example

_MAX_ENLARGED = 3.0
_MAX_CROP_WIDTH = 512  # pixels
_STALK_WIDTH = 18.0  # pixels: middle of the widths of training with sections
_MAX_WIDTH = 2048  # pixels: maximum width of a resized image


def annotated_examples(folder: Path, settings: Settings, labels: tuple[str, ...] = ()) -> Iterator[Example]:
    """Yield the examples of a folder of annotated images, one for each image; see `read_annotations`.

    The scale of the images is taken from the calibration in the folder, if there is one.

    Args:
        folder: Folder with images and annotations.
        settings: Settings of the networks.
        labels: Labels that count as stalks, see `labels.select_stalks`.

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
        example = make_example(
            image, resolution_of[about["id"]], stalks, kinds, functools.partial(_own_masks, annotations, size), settings, rng
        )
        if settings.section:
            shape = example.image.shape[:2]
            masks = [_annotated_mask(one, size) if one["segmentation"] else None for one in annotations]
            masks += [None] * len(strips)
            edges = annotated_edges(stalks, kinds, masks, shape, (size[0] / shape[0], size[1] / shape[1]))
            example = dataclasses.replace(example, edges=edges)
        yield example


def _cover_crowds(crowds: list[dict[str, Any]], stalks: np.ndarray) -> np.ndarray:
    """Cover crowd regions (stalks annotated together) with overlapping strips as wide as the image's median stalk.

    Strips are boxes and axes [N, 6] float32. In an image without single stalks, they are an eighth as wide as tall.

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
    """Cut the masks of stalk crops out of annotations. With the first two arguments bound, a `MaskFunction`.

    Masks are cut one at a time: they may overlap, and all masks of an image together could exceed the memory.
    """
    crops = [
        np.asarray(cut_crops(jnp.asarray(_annotated_mask(annotations[part], size)), stalks[index : index + 1], shape))
        for index, part in enumerate(selected)
    ]
    return np.concatenate(crops)


def _resolutions(folder: Path, images: list[dict[str, Any]]) -> dict[int, float | None]:
    """Return the resolution of each image by its id; all None if the folder has no calibration.

    Resolutions are in pixels per metre at `USUAL_DISTANCE`, the assumed distance of the plants.

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


def fit_settings(folder: Path, settings: Settings, labels: tuple[str, ...] = ()) -> Settings:
    """Return settings adapted to the boxes of a folder's annotations.

    Stalk crops become at least twice as wide as the median box, up to 512 pixels. Without sections, anchors become as tall as
    the median box, with widths at quantiles of those of the boxes.

    If the folder has no calibration, images are resized so that boxes are as tall as the band, or stalks as wide as those of
    training with sections; detection with networks trained on them uses the same resizing. Stalk crops are scaled accordingly.

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
        width = settings.band_height / tall
        if settings.section:
            heights = {image["id"]: image["height"] for image in data["images"]}
            wide = [_stalk_width(box, heights[box["image_id"]], widths[box["image_id"]]) for box in boxes]
            width = _STALK_WIDTH / float(np.median(wide))
        width = round(min(width, _MAX_WIDTH, _MAX_ENLARGED * max(widths.values())))
        ratio = settings.full_width / settings.width
        settings = dataclasses.replace(
            settings, pixels_per_metre=0.0, width=max(width, 32), full_width=max(round(ratio * width), 32)
        )
    factors = {number: resize_factor(width, settings, densities[number]) for number, width in widths.items()}
    sizes = np.array([np.array(annotation["bbox"][2:], float) * factors[annotation["image_id"]] for annotation in boxes])
    # A stalk crop is at least twice as wide as the median box: trunks are thicker than stalks.
    columns = 8 * math.ceil(2.0 * settings.full_width / settings.width * float(np.median(sizes[:, 0])) / 8)
    settings = dataclasses.replace(settings, crop_width=min(max(settings.crop_width, columns), _MAX_CROP_WIDTH))
    if settings.section:
        return settings
    return dataclasses.replace(
        settings,
        band_height=round(float(np.median(sizes[:, 1])), 1),
        anchor_widths=tuple(round(float(width), 1) for width in np.quantile(sizes[:, 0], (0.2, 0.6, 0.95))),
    )


def _stalk_width(annotation: dict[str, Any], height: int, width: int) -> float:
    """Return the mean horizontal width of an annotated stalk as a fraction of the image's width."""
    if not annotation["segmentation"]:
        return annotation["bbox"][2] / width
    mask = _annotated_mask(annotation, (height, width))
    return float(mask.sum() / max(mask.any(axis=1).sum(), 1)) / width


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
    return rasterize_polygons(segmentation or [[left, top, right, top, right, bottom, left, bottom]], size)


def _annotated_stalk(annotation: dict[str, Any], size: tuple[int, int]) -> list[float]:
    """Return the box and axis [6] of one annotation; the axis is fitted to its mask, and vertical if that is small."""
    left, top, wide, tall = annotation["bbox"]
    right, bottom = left + wide, top + tall
    row, column = np.nonzero(_annotated_mask(annotation, size))
    axis = [left + wide / 2] * 2
    if row.size > 50 and np.ptp(row) > 8:
        slope, offset = np.polyfit(row + 0.5, column + 0.5, 1)
        axis = [float(np.clip(offset + slope * edge, left, right)) for edge in (top, bottom)]
    return [left, top, right, bottom, *axis]
