"""An image with what was found in it: the picture behind every number."""

import cv2
import numpy as np

from jaxrl_vis.phenotyping.sightings import Sighting

_COUNTED, _REJECTED = (60, 230, 90), (235, 90, 60)
_WIDEST = 1688


def draw_overlay(image: np.ndarray, sightings: list[Sighting], labels: list[str | None]) -> np.ndarray:
    """The image [H, W, 3] uint8, at most 1688 pixels wide, brightened, with outlines and widths.

    Args:
        image: The left one.
        sightings: In it.
        labels: Of each: the number of its stalk; None for what does not count.
    """
    scale = min(_WIDEST / image.shape[1], 1.0)
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    canvas = np.round(255.0 * (small / 255.0) ** 0.7).astype(np.uint8)
    thick = max(round(size[0] / 800), 1)
    letters = max(size[0] / 2400, 0.3)

    def at(column: float, line: float) -> tuple[int, int]:
        return round((column + 0.5) * scale - 0.5), round((line + 0.5) * scale - 0.5)

    for place, (each, label) in enumerate(zip(sightings, labels)):
        colour = _REJECTED if label is None else _COUNTED
        left, top, right, bottom = each.box
        half = 0.5 * (each.width_px or max(right - left - abs(each.axis[1] - each.axis[0]), 2.0))
        for side in (-half, half):
            cv2.line(canvas, at(each.axis[0] + side, top), at(each.axis[1] + side, bottom), colour, thick, cv2.LINE_AA)
        cv2.line(
            canvas, at(each.column - half, each.line), at(each.column + half, each.line), (255, 220, 60), thick, cv2.LINE_AA
        )
        words = [label or "-"]
        words += [f"{each.diameter_mm:.1f} mm"] if each.diameter_mm is not None else []
        for number, word in enumerate(words):
            # Neighbours write at different heights.
            height = top - (14 + 60 * (place % 3) + 26 * (len(words) - 1 - number)) * letters / scale
            column, line = at(each.axis[0] - half, height)
            cv2.putText(canvas, word, (column, line), cv2.FONT_HERSHEY_SIMPLEX, letters, (0, 0, 0), 3 * thick, cv2.LINE_AA)
            cv2.putText(canvas, word, (column, line), cv2.FONT_HERSHEY_SIMPLEX, letters, colour, thick, cv2.LINE_AA)
    return canvas
