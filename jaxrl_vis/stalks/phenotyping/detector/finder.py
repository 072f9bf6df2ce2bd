"""Stalks of an image with their masks: what the rest of phenotyping asks for."""

import dataclasses
import functools
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.detect import Settings, detect, pad
from jaxrl_vis.stalks.phenotyping.detector.detector_networks import Segmenter
from jaxrl_vis.stalks.phenotyping.detector.doubles import without_duplicates
from jaxrl_vis.stalks.phenotyping.detector.stalk_crops import cut, put_back, smoothed, snip_shape
from jaxrl_vis.stalks.phenotyping.measure.width import Strip, strip_width
from jaxrl_vis_envs.plants.truth import BAND, HEIGHTS

_BATCH, _BATCH_ON_ACCELERATOR = 8, 32  # snips that go through the network together


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


def reduce(image: np.ndarray, width: int) -> tuple[np.ndarray, tuple[float, float]]:
    """An image [H, W, 3] uint8 as stalks are looked for in it, and by how much its lines and columns are fewer."""
    height, across = image.shape[:2]
    if across <= width:
        return image, (1.0, 1.0)
    lines = max(round(height * width / across), 1)
    return cv2.resize(image, (width, lines), interpolation=cv2.INTER_AREA), (height / lines, across / width)


def in_image(stalks: np.ndarray, scale: tuple[float, float]) -> np.ndarray:
    """Stalks [N, 6] of a reduced image in the coordinates of the whole one."""
    return stalks * np.array([scale[1], scale[0], scale[1], scale[0], scale[1], scale[1]], np.float32)


@functools.partial(jax.jit, static_argnums=(2, 3, 4))
def _segment(params: Any, snips: jax.Array, settings: Settings, dtype: Any, full: tuple[int, int]) -> jax.Array:
    """Chances [N, h, w] float32 that pixels of snips [N, h, w, 3] uint8 show the stalk in the middle.

    Snips of smaller images are enlarged to the ``full`` size: the network knows stalks that are as many pixels wide as there.
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

    Attributes:
        dtype: In which convolutions are computed.
    """

    def __init__(self, params: Any, settings: Settings, least_score: float = 0.5) -> None:
        self._params, self._settings, self._least = params, settings, least_score
        accelerated = jax.default_backend() in ("gpu", "tpu")
        self.dtype = jnp.bfloat16 if accelerated else jnp.float32
        self._batch = _BATCH_ON_ACCELERATOR if accelerated else _BATCH

    def __call__(self, image: np.ndarray) -> list[Detection]:
        """Stalks of an image [H, W, 3] uint8, from left to right, each of them once."""
        settings = self._settings
        reduced, scale = reduce(image, settings.width)
        stalks_found = jax.device_get(detect(self._params["detector"], pad(reduced), settings, self.dtype))
        selected = np.flatnonzero(stalks_found.valid & (stalks_found.scores >= self._least))
        stalks, scores = in_image(stalks_found.stalks[selected], scale), stalks_found.scores[selected]
        on_device = jnp.asarray(image)
        pieces = self._pieces(on_device, stalks, self._settings.snip_lines)
        once = np.flatnonzero(without_duplicates(pieces, scores))
        stalks, scores, pieces = stalks[once], scores[once], [pieces[place] for place in once]
        strips = [strip_width(mask) if mask.size else None for mask, _ in pieces]
        higher = [_follow(stalk, strip, corner) for stalk, strip, (_, corner) in zip(stalks, strips, pieces)]
        shown = [place for place, upper in enumerate(higher) if upper is not None]
        some = np.array([higher[place] for place in shown], np.float32).reshape(-1, 6)
        upper = dict(zip(shown, self._pieces(on_device, some, self._settings.snip_lines // 2)))
        detections = []
        for place, (stalk, score, (mask, corner)) in enumerate(zip(stalks, scores, pieces)):
            if mask.size:
                left, top, right, bottom, above, below = (float(edge) - 0.5 for edge in stalk)
                box = (left, top, right, bottom)
                axis = (above, below)
                detections.append(Detection(box, axis, float(score), mask, corner, upper.get(place), strips[place]))
        return sorted(detections, key=lambda detection: sum(detection.axis))

    def _pieces(self, image: jax.Array, stalks: np.ndarray, lines: int) -> list[tuple[np.ndarray, tuple[int, int]]]:
        """Masks and their corners of the snips of stalks [N, 6], which have ``lines`` lines in an image of full width."""
        snips = self._segment(image, stalks, lines)
        return [put_back(snip, stalk, (image.shape[0], image.shape[1])) for snip, stalk in zip(snips, stalks)]

    def _segment(self, on_device: jax.Array, stalks: np.ndarray, lines: int) -> np.ndarray:
        """Masks [N, h, w] float32 of the snips of stalks [N, 6]."""
        settings = self._settings
        full = (lines, settings.snip_columns)
        shape = snip_shape(on_device.shape[1], full, settings.full_width)
        if not len(stalks):
            return np.zeros((0, *shape), np.float32)
        masks = []
        for start in range(0, len(stalks), self._batch):
            part = stalks[start : start + self._batch]
            filled = np.pad(part, ((0, self._batch - len(part)), (0, 0)), mode="edge")
            snips = cut(on_device, filled, shape)
            masks.append(_segment(self._params["segmenter"], snips, settings, self.dtype, full))
        return np.concatenate(jax.device_get(masks))[: len(stalks)]


def _follow(stalk: np.ndarray, strip: Strip | None, corner: tuple[int, int]) -> np.ndarray | None:
    """Return a stalk's upper piece [6], by the edges of its mask in the band; None if it is not in the image."""
    if strip is None:
        return None
    # Half a pixel: stalks are in continuous coordinates.
    axis = [0.5 * sum(strip.edges(line - 0.5 - corner[0])) + corner[1] + 0.5 for line in (stalk[1], stalk[3])]
    upper = higher_up(np.array([*stalk[:4], *axis], np.float32))
    return upper if upper[1] > 0 else None
