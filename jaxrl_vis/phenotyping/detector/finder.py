"""Stalks of an image with their masks: what the rest of phenotyping asks for."""

import dataclasses
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.phenotyping.detector.detect import Settings, detect, normalise, pad
from jaxrl_vis.phenotyping.detector.networks import Segmenter
from jaxrl_vis.phenotyping.detector.snips import cut, put_back, snip_shape

_BATCH = 8


@dataclasses.dataclass(frozen=True)
class Detection:
    """A stalk in the band.

    Attributes:
        box: Left, top, right, bottom of its part in the band, pixels of the whole image; (0, 0) is the middle of the first one.
        axis: Columns of its middle at the box's top and bottom.
        score: 0 to 1.
        mask: [h, w] float32 from 0 to 1, or bool: what shows it, in a part of the image.
        corner: Line and column of the mask's first pixel.
    """

    box: tuple[float, float, float, float]
    axis: tuple[float, float]
    score: float
    mask: np.ndarray
    corner: tuple[int, int]


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


def masks_of(params: Any, snips: jax.Array, settings: Settings, dtype: Any) -> jax.Array:
    """Chances [N, h, w] float32 that pixels of snips [N, h, w, 3] uint8 show the stalk in the middle."""
    logits = Segmenter(settings.segmenter, dtype).apply(params, normalise(snips))
    assert isinstance(logits, jax.Array)
    return jax.nn.sigmoid(logits)


_masks_of = jax.jit(masks_of, static_argnums=(2, 3))


class Finder:
    """Finds stalks with trained networks; compiled once for each size of image.

    Args:
        params: With ``detector`` and ``segmenter``.
        settings: Beside the weights.
        least_score: What is no find; 0.5 balances what is missed against what is made up.
    """

    def __init__(self, params: Any, settings: Settings, least_score: float = 0.5) -> None:
        self._params, self._settings, self._least = params, settings, least_score
        accelerated = jax.default_backend() in ("gpu", "tpu")
        self._dtype = jnp.bfloat16 if accelerated else jnp.float32

    def __call__(self, image: np.ndarray) -> list[Detection]:
        """Stalks of an image [H, W, 3] uint8, from left to right."""
        settings = self._settings
        reduced, scale = reduce(image, settings.width)
        found = jax.device_get(detect(self._params["detector"], pad(reduced), settings, self._dtype))
        kept = np.flatnonzero(found.valid & (found.scores >= self._least))
        stalks, scores = in_image(found.stalks[kept], scale), found.scores[kept]
        masks = self._segment(image, stalks)
        detections = []
        for stalk, score, snip in zip(stalks, scores, masks):
            mask, corner = put_back(snip, stalk, image.shape[:2])
            if mask.size:
                left, top, right, bottom, above, below = (float(each) - 0.5 for each in stalk)
                detections.append(Detection((left, top, right, bottom), (above, below), float(score), mask, corner))
        return sorted(detections, key=lambda each: sum(each.axis))

    def _segment(self, image: np.ndarray, stalks: np.ndarray) -> np.ndarray:
        """Masks [N, h, w] float32 of the snips of stalks [N, 6]."""
        settings = self._settings
        shape = snip_shape(image.shape[1], (settings.snip_lines, settings.snip_columns), settings.full_width)
        if not len(stalks):
            return np.zeros((0, *shape), np.float32)
        on_device, masks = jnp.asarray(image), []
        for start in range(0, len(stalks), _BATCH):
            part = stalks[start : start + _BATCH]
            filled = np.pad(part, ((0, _BATCH - len(part)), (0, 0)), mode="edge")
            snips = cut(on_device, filled, shape)
            masks.append(_masks_of(self._params["segmenter"], snips, settings, self._dtype))
        return np.concatenate(jax.device_get(masks))[: len(stalks)]
