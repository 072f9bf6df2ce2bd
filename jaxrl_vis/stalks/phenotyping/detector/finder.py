"""Detection and segmentation of the stalks of an image: the interface of the detector to the rest of phenotyping."""

import dataclasses
import functools
from collections.abc import Iterable
from typing import Any, Self

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.band import Band, cut_to_band, in_frame, move_to_band, to_image_coordinates
from jaxrl_vis.stalks.phenotyping.detector.chains import link
from jaxrl_vis.stalks.phenotyping.detector.detect import Settings, detect, pad_image
from jaxrl_vis.stalks.phenotyping.detector.detector_networks import Segmenter
from jaxrl_vis.stalks.phenotyping.detector.doubles import suppress_duplicates
from jaxrl_vis.stalks.phenotyping.detector.gate import Gate
from jaxrl_vis.stalks.phenotyping.detector.stalk_crops import crop_shape, cut_crops, paste_crop, preprocess_crops
from jaxrl_vis.stalks.phenotyping.measure.borders import Frame, fill_borders, find_frame
from jaxrl_vis.stalks.phenotyping.measure.width import Strip, fit_strip
from jaxrl_vis_envs.plants.truth import BAND, HEIGHTS

_BATCH, _BATCH_ON_ACCELERATOR = 2, 32  # stalk crops per batch; on a CPU, larger ones save nothing and are filled up more often
_MIN_VISIBLE = 0.5  # minimum fraction of a stalk's axis outside black borders
_MAX_ENLARGED = 3.0  # at more, a stalk is only three pixels wide and cannot be recognised
_SUBSTITUTE_DOUBT = 0.5  # fraction of the maximum doubt from which a substitute reads an image: at night it is hardly worse
_MAX_STRETCH = 1.12  # range of stretching in training: the networks accept image heights within this factor


@dataclasses.dataclass(frozen=True)
class Detection:
    """Stalk detected in the band.

    Attributes:
        box: Left, top, right and bottom of its part in the band, pixels of the whole image, within its columns; (0, 0) is the
            centre of the first pixel.
        axis: x coordinates of its centre line at the top and bottom of the box, pixels.
        score: Score of the detector, 0 to 1.
        mask: Mask [h, w] of its visible pixels in a part of the image, float32 from 0 to 1, or bool.
        corner: Image row and column of the first pixel of the mask.
        upper: Mask and corner of its segment around 24 inches above the ground; None if that is not in the image.
        strip: Straight edges fitted to the mask, in pixels of the mask; None if not fitted.
    """

    box: tuple[float, float, float, float]
    axis: tuple[float, float]
    score: float
    mask: np.ndarray
    corner: tuple[int, int]
    upper: tuple[np.ndarray, tuple[int, int]] | None = None
    strip: Strip | None = None


class Detections(list[Detection]):
    """Stalks detected in an image.

    Args:
        detections: Detected stalks.
        doubt: Estimated probability that the image is misread, see `Gate.doubt`; None if unknown.
        max_doubt: Doubt above which the image counts as unfamiliar; None if unknown.
    """

    def __init__(
        self, detections: Iterable[Detection] = (), doubt: float | None = None, max_doubt: float | None = None
    ) -> None:
        super().__init__(detections)
        self.doubt, self.max_doubt = doubt, max_doubt


UPPER_OFFSET = (HEIGHTS[1] - HEIGHTS[0]) / (BAND[1] - BAND[0])
"""Distance from the middle of the band up to the upper height, as a multiple of the height of the band."""


def upper_segment(stalk: np.ndarray) -> np.ndarray:
    """Extrapolate a stalk [6] in the band along its axis to the segment [6] float32 around the upper height, half as tall."""
    left, top, right, bottom, above, below = stalk
    tall = bottom - top
    middle = 0.5 * (top + bottom) - UPPER_OFFSET * tall
    slope = (below - above) / max(tall, 1.0)
    first, last = middle - 0.25 * tall, middle + 0.25 * tall
    ends = [above + slope * (row - top) for row in (first, last)]
    half = 0.5 * max(right - left - abs(below - above), 2.0)
    return np.array([min(ends) - half, first, max(ends) + half, last, *ends], np.float32)


def resize_factor(width: int, settings: Settings, pixels_per_metre: float | None) -> float:
    """Return the factor by which `resize` resizes an image ``width`` pixels wide, 3 at most.

    An image is enlarged only if its ``pixels_per_metre`` is known or the networks were trained on images of unknown cameras.
    """
    return min(
        settings.scale_for(width, pixels_per_metre), _MAX_ENLARGED if pixels_per_metre or not settings.pixels_per_metre else 1.0
    )


def resize(image: np.ndarray, settings: Settings, pixels_per_metre: float | None) -> tuple[np.ndarray, tuple[float, float]]:
    """Resize an image for detection.

    Args:
        image: [H, W, 3] uint8.
        settings: Settings of the networks.
        pixels_per_metre: Resolution of the image at the row of plants; None if unknown.

    Returns:
        Resized image (``image`` itself if its size does not change), and the vertical and horizontal scale factors from its
        coordinates to those of the original.
    """
    height, across = image.shape[:2]
    factor = resize_factor(across, settings, pixels_per_metre)
    rows, columns = max(round(height * factor), 1), max(round(across * factor), 1)
    if (rows, columns) == (height, across):
        return image, (1.0, 1.0)
    how = cv2.INTER_AREA if factor < 1.0 else cv2.INTER_LINEAR
    return cv2.resize(image, (columns, rows), interpolation=how), (height / rows, across / columns)


def pad_to_training_height(image: np.ndarray, settings: Settings) -> tuple[np.ndarray, int]:
    """Crop or pad an image to the height of the training images.

    The networks also recognise the band by its position in the image. With another field of view, the centre of the image is
    what the training cameras show, so rows are removed or added (as zeros) equally at the top and bottom. Images whose height
    is within the range of training are returned unchanged.

    Args:
        image: [H, W, 3] uint8 at the ``pixels_per_metre`` of the settings.
        settings: Settings of the networks.

    Returns:
        Image, and the number of rows added at the top, negative if cropped.
    """
    beyond = settings.height - image.shape[0]
    if 1.0 / _MAX_STRETCH <= image.shape[0] / settings.height <= _MAX_STRETCH:
        return image, 0
    above = beyond // 2
    if beyond < 0:
        return image[-above : settings.height - above], above
    return np.pad(image, ((above, beyond - above), (0, 0), (0, 0))), above


@functools.partial(jax.jit, static_argnums=(2, 3, 4))
def segment(params: Any, crops: jax.Array, settings: Settings, dtype: Any, full_shape: tuple[int, int]) -> jax.Array:
    """Compute probabilities [N, h, w] float32 that pixels of stalk crops [N, h, w, 3] uint8 show the stalk in the centre.

    Crops are resized to ``full_shape`` (height, width) for the network, and probabilities back to the size of the crops: the
    network was trained on stalks of that width in pixels.
    """
    count, *shape = crops.shape[:3]
    enlarged = jax.image.resize(crops.astype(jnp.float32), (count, *full_shape, 3), "linear")
    logits = Segmenter(settings.segmenter, dtype).apply(params, preprocess_crops(enlarged))
    assert isinstance(logits, jax.Array)
    return jax.image.resize(jax.nn.sigmoid(logits), (count, *shape), "linear")


class Finder:
    """Stalk detector with trained networks; compiled once per image size.

    Args:
        params: Parameters with keys ``detector`` and ``segmenter``.
        settings: Settings stored with the weights.
        min_score: Minimum score of a detection; 0.4 balances misses against false detections.
        gate: Gate that estimates how likely each image is misread; None if there is none for these weights.
        substitute: Detector for images of unknown cameras and those that the gate doubts; None for this one.

    Attributes:
        dtype: Compute dtype of the convolutions.
        gate: Gate as passed to the constructor.
    """

    def __init__(
        self,
        params: Any,
        settings: Settings,
        min_score: float = 0.4,
        gate: Gate | None = None,
        substitute: Self | None = None,
    ) -> None:
        self._params, self._settings, self._min_score, self.gate = params, settings, min_score, gate
        self._substitute = substitute
        accelerated = jax.default_backend() in ("gpu", "tpu")
        self.dtype = jnp.bfloat16 if accelerated else jnp.float32
        self._batch = _BATCH_ON_ACCELERATOR if accelerated else _BATCH

    def __call__(self, image: np.ndarray, pixels_per_metre: float | None = None, band: Band | None = None) -> Detections:
        """Detect and segment the stalks of an image, sorted from left to right, without duplicates.

        Args:
            image: [H, W, 3] uint8.
            pixels_per_metre: Resolution of the image at the row of plants; None if the camera is unknown.
            band: Rows of the band; None if the camera is unknown. Without it, networks that detect sections return the part of
                each stalk with the highest scores.
        """
        if pixels_per_metre is None and self._substitute is not None:
            return self._substitute(image, None, band)
        frame = find_frame(image)
        part = fill_borders(image, frame)
        detections = self._find(part, pixels_per_metre, frame, band)
        if self._substitute is not None and _is_doubtful(detections):
            # The doubt remains that of the first networks: how accurate their substitutes are there is not well known.
            others = self._substitute._find(part, pixels_per_metre, frame, band)
            detections = Detections(others, detections.doubt, detections.max_doubt)
        ordered = sorted(detections, key=lambda detection: sum(detection.axis))
        in_full_image = (_to_full_image(detection, frame) for detection in ordered)
        return Detections(in_full_image, detections.doubt, detections.max_doubt)

    def detect_boxes(
        self, image: np.ndarray, pixels_per_metre: float | None, band: Band | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Detect stalks without segmenting them.

        Args:
            image: [h, w, 3] uint8, without black borders.
            pixels_per_metre: Resolution of the image at the row of plants; None if the camera is unknown.
            band: Rows of the band in this image; None if the camera is unknown.

        Returns:
            Boxes and axes [N, 6] of all detections down to `Settings.min_score` (with sections, of all chains in the band, see
            `cut_to_band`), in continuous image coordinates, their scores [N], and the pooled features [2 C] of the backbone.
        """
        settings = self._settings
        reduced, scale = resize(image, settings, pixels_per_metre)
        added = 0
        if pixels_per_metre and settings.pixels_per_metre and not settings.section:
            reduced, added = pad_to_training_height(reduced, settings)
        detected = jax.device_get(detect(self._params["detector"], pad_image(reduced), settings, self.dtype))
        assert detected.pooled is not None
        if settings.section:
            chains = link(detected.stalks[detected.valid], detected.scores[detected.valid], settings.section)
            return *cut_to_band(chains, scale, band), np.asarray(detected.pooled)
        moved = detected.stalks[detected.valid] - np.array([0, added, 0, added, 0, 0], np.float32)
        stalks = to_image_coordinates(moved, scale)
        if band is not None:
            stalks = move_to_band(stalks, band)
        return stalks, detected.scores[detected.valid], np.asarray(detected.pooled)

    def _find(self, image: np.ndarray, pixels_per_metre: float | None, frame: Frame, band: Band | None) -> Detections:
        """Detect and segment the stalks of an image [h, w, 3] uint8 that is already cropped to a frame, in its coordinates.

        ``band`` has the rows of the band in the whole image. An image that a substitute reads is not segmented.
        """
        settings = self._settings
        relative_scale = settings.width / settings.full_width / settings.scale_for(image.shape[1], pixels_per_metre)
        stalks, scores, pooled = self.detect_boxes(image, pixels_per_metre, None if band is None else in_frame(band, frame))
        detections = Detections()
        if self.gate is not None:
            detections = Detections(doubt=self.gate.doubt(pooled, scores), max_doubt=self.gate.threshold)
        if self._substitute is not None and _is_doubtful(detections):
            return detections
        if settings.section and band is not None:
            # For rows by day, F1 of chains is highest from a score of 0.6; at night, that of boxes from one below 0.4.
            scores = 1.0 - np.sqrt(1.0 - scores)
        selected = scores >= self._min_score
        stalks, scores = stalks[selected], scores[selected]
        inside = np.array([_is_inside_frame(stalk, frame) for stalk in stalks], bool)
        stalks, scores = stalks[inside], scores[inside]
        on_device = jnp.asarray(image)
        pieces = self._placed_masks(on_device, stalks, settings.crop_height, relative_scale)
        pieces = [(_clear_border_rows(mask, corner, frame), corner) for mask, corner in pieces]
        once = np.flatnonzero(suppress_duplicates(pieces, scores))
        stalks, scores, pieces = stalks[once], scores[once], [pieces[place] for place in once]
        strips = [fit_strip(mask) if mask.size else None for mask, _ in pieces]
        higher = [_extrapolate_upward(stalk, strip, corner) for stalk, strip, (_, corner) in zip(stalks, strips, pieces)]
        shown = [place for place, upper in enumerate(higher) if upper is not None]
        some = np.array([higher[place] for place in shown], np.float32).reshape(-1, 6)
        above = self._placed_masks(on_device, some, settings.crop_height // 2, relative_scale)
        upper = {place: (_clear_border_rows(mask, corner, frame), corner) for place, (mask, corner) in zip(shown, above)}
        for place, (stalk, score, (mask, corner)) in enumerate(zip(stalks, scores, pieces)):
            if mask.size:
                left, top, right, bottom, above, below = (float(edge) - 0.5 for edge in stalk)
                last = image.shape[1] - 0.5
                box = (min(max(left, -0.5), last), top, min(max(right, -0.5), last), bottom)
                axis = (above, below)
                detections.append(Detection(box, axis, float(score), mask, corner, upper.get(place), strips[place]))
        return detections

    def _placed_masks(
        self, image: jax.Array, stalks: np.ndarray, height: int, relative_scale: float
    ) -> list[tuple[np.ndarray, tuple[int, int]]]:
        """Segment stalks [N, 6] in crops of ``height`` rows at full resolution; return masks and their corners in the image."""
        crops = self._segment(image, stalks, height, relative_scale)
        return [paste_crop(crop, stalk, (image.shape[0], image.shape[1])) for crop, stalk in zip(crops, stalks)]

    def _segment(self, on_device: jax.Array, stalks: np.ndarray, height: int, relative_scale: float) -> np.ndarray:
        """Compute masks [N, h, w] float32 of the crops of stalks [N, 6]; ``relative_scale``: see `crop_shape`."""
        settings = self._settings
        full = (height, settings.crop_width)
        shape = crop_shape(full, relative_scale)
        if not len(stalks):
            return np.zeros((0, *shape), np.float32)
        masks = []
        for start in range(0, len(stalks), self._batch):
            part = stalks[start : start + self._batch]
            filled = np.pad(part, ((0, self._batch - len(part)), (0, 0)), mode="edge")
            crops = cut_crops(on_device, filled, shape)
            masks.append(segment(self._params["segmenter"], crops, settings, self.dtype, full))
        return np.concatenate(jax.device_get(masks))[: len(stalks)]


def _is_doubtful(detections: Detections) -> bool:
    """Return True if a substitute should read the image of ``detections``."""
    return (detections.doubt or 0.0) > _SUBSTITUTE_DOUBT * (detections.max_doubt or 1.0)


def _is_inside_frame(stalk: np.ndarray, frame: Frame) -> bool:
    """Return True if more than half of a stalk's axis within the image, of ``stalk`` [6], lies outside the black borders."""
    if frame.shown is None:
        return True
    shown = frame.shown[slice(*frame.rows), slice(*frame.columns)]
    row, column = (np.linspace(begin, end, 21).astype(int) for begin, end in (stalk[1:4:2], stalk[4:]))
    there = (row >= 0) & (row < shown.shape[0]) & (column >= 0) & (column < shown.shape[1])
    return bool(np.mean(shown[row[there], column[there]]) > _MIN_VISIBLE) if there.any() else False


def _clear_border_rows(mask: np.ndarray, corner: tuple[int, int], frame: Frame) -> np.ndarray:
    """Return a mask, cleared in the rows in which it reaches a black border: the stalk may continue there."""
    if frame.shown is None or not mask.size:
        return mask
    shown = frame.shown[slice(*frame.rows), slice(*frame.columns)]
    here = shown[corner[0] : corner[0] + mask.shape[0], corner[1] : corner[1] + mask.shape[1]]
    visible = mask.copy()
    visible[((mask >= 0.5) & ~here).any(axis=1)] = 0
    return visible


def _to_full_image(detection: Detection, frame: Frame) -> Detection:
    """Convert a detection from the coordinates of a frame to those of the whole image."""
    down, over = frame.rows[0], frame.columns[0]
    if not down and not over:
        return detection
    left, top, right, bottom = detection.box
    upper = detection.upper
    return dataclasses.replace(
        detection,
        box=(left + over, top + down, right + over, bottom + down),
        axis=(detection.axis[0] + over, detection.axis[1] + over),
        corner=(detection.corner[0] + down, detection.corner[1] + over),
        upper=None if upper is None else (upper[0], (upper[1][0] + down, upper[1][1] + over)),
    )


def _extrapolate_upward(stalk: np.ndarray, strip: Strip | None, corner: tuple[int, int]) -> np.ndarray | None:
    """Extrapolate a stalk to its upper segment [6] by the edges of its mask; None if outside the image or without edges."""
    if strip is None:
        return None
    # Half a pixel from pixel centres to the continuous coordinates of stalks.
    axis = [0.5 * sum(strip.edges(row - 0.5 - corner[0])) + corner[1] + 0.5 for row in (stalk[1], stalk[3])]
    upper = upper_segment(np.array([*stalk[:4], *axis], np.float32))
    return upper if upper[1] > 0 else None
