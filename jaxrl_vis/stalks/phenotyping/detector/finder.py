"""Stalks of an image with their masks: what the rest of phenotyping asks for."""

import dataclasses
import functools
from collections.abc import Iterable
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.detect import Settings, detect, pad
from jaxrl_vis.stalks.phenotyping.detector.detector_networks import Segmenter
from jaxrl_vis.stalks.phenotyping.detector.doubles import without_duplicates
from jaxrl_vis.stalks.phenotyping.detector.gate import Gate
from jaxrl_vis.stalks.phenotyping.detector.stalk_crops import cut, put_back, smoothed, snip_shape
from jaxrl_vis.stalks.phenotyping.measure.borders import Frame, fill_borders, find_frame
from jaxrl_vis.stalks.phenotyping.measure.width import Strip, strip_width
from jaxrl_vis_envs.plants.truth import BAND, HEIGHTS

_BATCH, _BATCH_ON_ACCELERATOR = 8, 32  # snips that go through the network together
_SHOWN = 0.5  # of a stalk's axis that must not lie on a border of the image
_MAX_ENLARGED = 3.0  # beyond that, a stalk is three pixels wide and nothing tells it from others
_STRETCH = 1.12  # by which images were stretched in training: so much taller or lower ones are nothing new to the networks


@dataclasses.dataclass(frozen=True)
class Detection:
    """A stalk in the band.

    Attributes:
        box: Left, top, right, bottom of its part in the band, pixels of the whole image; (0, 0) is the middle of the first one.
        axis: Columns of its middle at the box's top and bottom.
        score: 0 to 1.
        mask: [h, w] float32 from 0 to 1, or bool: what shows it, in a part of the image.
        corner: Line and column of the mask's first pixel.
        upper: Mask and corner of a piece of it around 24 inches above the ground; None where the image does not show that.
        strip: The edges of the mask; None where they are not known yet.
    """

    box: tuple[float, float, float, float]
    axis: tuple[float, float]
    score: float
    mask: np.ndarray
    corner: tuple[int, int]
    upper: tuple[np.ndarray, tuple[int, int]] | None = None
    strip: Strip | None = None


class Detections(list[Detection]):
    """The stalks of an image.

    Args:
        detections: The stalks.
        doubt: See `Gate.doubt`; None where nobody knows.
    """

    def __init__(self, detections: Iterable[Detection] = (), doubt: float | None = None) -> None:
        super().__init__(detections)
        self.doubt = doubt


UPPER = (HEIGHTS[1] - HEIGHTS[0]) / (BAND[1] - BAND[0])
"""Distance of the upper height above the middle of the band, in heights of the band."""


def higher_up(stalk: np.ndarray) -> np.ndarray:
    """Box and axis [6] of a stalk's piece around the upper height, half as tall as its band [6], where the axis goes on."""
    left, top, right, bottom, above, below = stalk
    tall = bottom - top
    middle = 0.5 * (top + bottom) - UPPER * tall
    slope = (below - above) / max(tall, 1.0)
    first, last = middle - 0.25 * tall, middle + 0.25 * tall
    ends = [above + slope * (line - top) for line in (first, last)]
    half = 0.5 * max(right - left - abs(below - above), 2.0)
    return np.array([min(ends) - half, first, max(ends) + half, last, *ends], np.float32)


def resize_factor(width: int, settings: Settings, density: float | None) -> float:
    """Factor by which `resize` resizes an image ``width`` pixels wide.

    It is enlarged only where its density is known, or where the networks learned from images that were.
    """
    return min(settings.resizing(width, density), _MAX_ENLARGED if density or not settings.density else 1.0)


def resize(image: np.ndarray, settings: Settings, density: float | None) -> tuple[np.ndarray, tuple[float, float]]:
    """Resize an image [H, W, 3] uint8 as stalks are looked for in it; also return its lines and columns for each new one.

    Args:
        image: The image.
        settings: Settings of the networks.
        density: Pixels per metre at the row; None if unknown.
    """
    height, across = image.shape[:2]
    factor = resize_factor(across, settings, density)
    lines, columns = max(round(height * factor), 1), max(round(across * factor), 1)
    if (lines, columns) == (height, across):
        return image, (1.0, 1.0)
    how = cv2.INTER_AREA if factor < 1.0 else cv2.INTER_LINEAR
    return cv2.resize(image, (columns, lines), interpolation=how), (height / lines, across / columns)


def usual_lines(image: np.ndarray, settings: Settings) -> tuple[np.ndarray, int]:
    """Cut or fill an image to the lines that the networks know; also return the number of lines added above, negative if cut.

    Where stalks are looked for, they know the band by its place in the image, too. Through a lens of another field of view the
    middle of the image is what the cameras of `Settings.width` show, so lines go or come above and below in equal parts.

    Args:
        image: [H, W, 3] uint8 with the pixels per metre of the settings.
        settings: Settings of the networks.
    """
    beyond = settings.lines - image.shape[0]
    if 1.0 / _STRETCH <= image.shape[0] / settings.lines <= _STRETCH:
        return image, 0
    above = beyond // 2
    if beyond < 0:
        return image[-above : settings.lines - above], above
    return np.pad(image, ((above, beyond - above), (0, 0), (0, 0))), above


def in_image(stalks: np.ndarray, scale: tuple[float, float]) -> np.ndarray:
    """Stalks [N, 6] of a reduced image in the coordinates of the whole one."""
    return stalks * np.array([scale[1], scale[0], scale[1], scale[0], scale[1], scale[1]], np.float32)


@functools.partial(jax.jit, static_argnums=(2, 3, 4))
def segment(params: Any, snips: jax.Array, settings: Settings, dtype: Any, full: tuple[int, int]) -> jax.Array:
    """Chances [N, h, w] float32 that pixels of snips [N, h, w, 3] uint8 show the stalk in the middle.

    Snips of another resolution are resized to the ``full`` size: the network knows stalks that are as many pixels wide there.
    """
    count, *shape = snips.shape[:3]
    enlarged = jax.image.resize(snips.astype(jnp.float32), (count, *full, 3), "linear")
    logits = Segmenter(settings.segmenter, dtype).apply(params, smoothed(enlarged))
    assert isinstance(logits, jax.Array)
    return jax.image.resize(jax.nn.sigmoid(logits), (count, *shape), "linear")


class Finder:
    """Finds stalks with trained networks; compiled once for each size of image.

    Args:
        params: With ``detector`` and ``segmenter``.
        settings: Beside the weights.
        least_score: Lowest score of a detection; 0.5 balances misses against false detections.
        gate: Gate that says of each image how likely it is read wrongly; None where there is none for these weights.

    Attributes:
        dtype: In which convolutions are computed.
        gate: As given.
    """

    def __init__(self, params: Any, settings: Settings, least_score: float = 0.5, gate: Gate | None = None) -> None:
        self._params, self._settings, self._least, self.gate = params, settings, least_score, gate
        accelerated = jax.default_backend() in ("gpu", "tpu")
        self.dtype = jnp.bfloat16 if accelerated else jnp.float32
        self._batch = _BATCH_ON_ACCELERATOR if accelerated else _BATCH

    def __call__(self, image: np.ndarray, density: float | None = None) -> Detections:
        """Stalks of an image, from left to right, each of them once.

        Args:
            image: [H, W, 3] uint8.
            density: Pixels per metre at the row; None if nothing is known of the camera.
        """
        frame = find_frame(image)
        detections = self._find(fill_borders(image, frame), density, frame)
        ordered = sorted(detections, key=lambda detection: sum(detection.axis))
        return Detections((_moved(detection, frame) for detection in ordered), doubt=detections.doubt)

    def look(self, image: np.ndarray, density: float | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Look for stalks without outlining them: boxes and axes [N, 6] of all that have any score, scores [N], and the pooled
        features [2 C] of the backbone.

        Args:
            image: [h, w, 3] uint8, without borders.
            density: Pixels per metre at the row; None if nothing is known of the camera.
        """
        settings = self._settings
        reduced, scale = resize(image, settings, density)
        added = 0
        if density and settings.density:
            reduced, added = usual_lines(reduced, settings)
        found = jax.device_get(detect(self._params["detector"], pad(reduced), settings, self.dtype))
        assert found.pooled is not None
        moved = found.stalks[found.valid] - np.array([0, added, 0, added, 0, 0], np.float32)
        return in_image(moved, scale), found.scores[found.valid], np.asarray(found.pooled)

    def _find(self, image: np.ndarray, density: float | None, frame: Frame) -> Detections:
        """Stalks of an image [h, w, 3] uint8, in which a frame shows a scene."""
        settings = self._settings
        share = settings.width / settings.full_width / settings.resizing(image.shape[1], density)
        stalks, scores, pooled = self.look(image, density)
        doubt = None if self.gate is None else self.gate.doubt(pooled, scores)
        selected = scores >= self._least
        stalks, scores = stalks[selected], scores[selected]
        inside = np.array([_is_shown(stalk, frame) for stalk in stalks], bool)
        stalks, scores = stalks[inside], scores[inside]
        on_device = jnp.asarray(image)
        pieces = self._pieces(on_device, stalks, settings.snip_lines, share)
        pieces = [(_without_border(mask, corner, frame), corner) for mask, corner in pieces]
        once = np.flatnonzero(without_duplicates(pieces, scores))
        stalks, scores, pieces = stalks[once], scores[once], [pieces[place] for place in once]
        strips = [strip_width(mask) if mask.size else None for mask, _ in pieces]
        higher = [_follow(stalk, strip, corner) for stalk, strip, (_, corner) in zip(stalks, strips, pieces)]
        shown = [place for place, upper in enumerate(higher) if upper is not None]
        some = np.array([higher[place] for place in shown], np.float32).reshape(-1, 6)
        above = self._pieces(on_device, some, settings.snip_lines // 2, share)
        upper = {place: (_without_border(mask, corner, frame), corner) for place, (mask, corner) in zip(shown, above)}
        detections = Detections(doubt=doubt)
        for place, (stalk, score, (mask, corner)) in enumerate(zip(stalks, scores, pieces)):
            if mask.size:
                left, top, right, bottom, above, below = (float(edge) - 0.5 for edge in stalk)
                box = (left, top, right, bottom)
                axis = (above, below)
                detections.append(Detection(box, axis, float(score), mask, corner, upper.get(place), strips[place]))
        return detections

    def _pieces(
        self, image: jax.Array, stalks: np.ndarray, lines: int, share: float
    ) -> list[tuple[np.ndarray, tuple[int, int]]]:
        """Masks and their corners of the snips of stalks [N, 6], which have ``lines`` lines at full resolution."""
        snips = self._segment(image, stalks, lines, share)
        return [put_back(snip, stalk, (image.shape[0], image.shape[1])) for snip, stalk in zip(snips, stalks)]

    def _segment(self, on_device: jax.Array, stalks: np.ndarray, lines: int, share: float) -> np.ndarray:
        """Masks [N, h, w] float32 of the snips of stalks [N, 6] in an image of a ``share`` of full resolution."""
        settings = self._settings
        full = (lines, settings.snip_columns)
        shape = snip_shape(full, share)
        if not len(stalks):
            return np.zeros((0, *shape), np.float32)
        masks = []
        for start in range(0, len(stalks), self._batch):
            part = stalks[start : start + self._batch]
            filled = np.pad(part, ((0, self._batch - len(part)), (0, 0)), mode="edge")
            snips = cut(on_device, filled, shape)
            masks.append(segment(self._params["segmenter"], snips, settings, self.dtype, full))
        return np.concatenate(jax.device_get(masks))[: len(stalks)]


def _is_shown(stalk: np.ndarray, frame: Frame) -> bool:
    """Return True unless most of a stalk's axis [6] lies on a border."""
    if frame.shown is None:
        return True
    shown = frame.shown[slice(*frame.lines), slice(*frame.columns)]
    line, column = (np.linspace(begin, end, 21).astype(int) for begin, end in (stalk[1:4:2], stalk[4:]))
    there = (line >= 0) & (line < shown.shape[0]) & (column >= 0) & (column < shown.shape[1])
    return bool(np.mean(shown[line[there], column[there]]) > _SHOWN) if there.any() else False


def _without_border(mask: np.ndarray, corner: tuple[int, int], frame: Frame) -> np.ndarray:
    """Return a mask without the lines in which it reaches a border: the stalk may go on there."""
    if frame.shown is None or not mask.size:
        return mask
    shown = frame.shown[slice(*frame.lines), slice(*frame.columns)]
    here = shown[corner[0] : corner[0] + mask.shape[0], corner[1] : corner[1] + mask.shape[1]]
    visible = mask.copy()
    visible[((mask >= 0.5) & ~here).any(axis=1)] = 0
    return visible


def _moved(detection: Detection, frame: Frame) -> Detection:
    """Return a detection in a frame at its place in the whole image."""
    down, over = frame.lines[0], frame.columns[0]
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


def _follow(stalk: np.ndarray, strip: Strip | None, corner: tuple[int, int]) -> np.ndarray | None:
    """Return a stalk's upper piece [6], by the edges of its mask in the band; None if it is not in the image."""
    if strip is None:
        return None
    # Half a pixel: stalks are in continuous coordinates.
    axis = [0.5 * sum(strip.edges(line - 0.5 - corner[0])) + corner[1] + 0.5 for line in (stalk[1], stalk[3])]
    upper = higher_up(np.array([*stalk[:4], *axis], np.float32))
    return upper if upper[1] > 0 else None
