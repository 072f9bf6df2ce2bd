"""Overlays: images annotated with the detections and measurements in them."""

import math

import cv2
import numpy as np

from jaxrl_vis.stalks.phenotyping.io.names import readable
from jaxrl_vis.stalks.phenotyping.track.sightings import Sighting

COUNTED, REJECTED, MEASURED = (70, 235, 100), (255, 105, 75), (255, 225, 60)
"""RGB colours: outlines of counted and of rejected detections, and marks where widths were measured."""
_MAX_WIDTH = 1688
_BRIGHTENED = np.round(255.0 * (np.arange(256) / 255.0) ** 0.7).astype(np.uint8)
_LEGEND = (("counted", COUNTED), ("not counted", REJECTED), ("width was taken here", MEASURED))


def overlay_scale(width: int) -> float:
    """Return the scale factor of the overlay of an image ``width`` pixels wide; at most 1."""
    return min(_MAX_WIDTH / width, 1.0)


def draw_overlay(image: np.ndarray, sightings: list[Sighting], labels: list[str | None], title: str = "") -> np.ndarray:
    """Draw outlines and widths on a brightened copy of an image, at most 1688 pixels wide, RGB [h, w, 3] uint8.

    Args:
        image: Left image, RGB [H, W, 3] uint8.
        sightings: Sightings in the image.
        labels: Label of each sighting's stalk; empty to omit it, None for sightings that do not count.
        title: Title in the lower left corner.
    """
    scale = overlay_scale(image.shape[1])
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    canvas = cv2.LUT(small, _BRIGHTENED)
    thickness = max(round(size[0] / 800), 1)
    for sighting, label in zip(sightings, labels):
        _draw_outline(canvas, sighting, COUNTED if label is not None else REJECTED, scale, thickness)
    writer = _LabelWriter(canvas, max(size[0] / 2200, 0.3), thickness)
    writer.write_legend(readable(title))  # OpenCV does not survive a lone surrogate
    for sighting, label in sorted(zip(sightings, labels), key=lambda pair: pair[0].column):
        width = "" if sighting.diameter_mm is None else f"{sighting.diameter_mm:.1f} mm"
        text = " ".join(filter(None, (f"#{label}" if label else "", width))) or "no width"
        place = round((sighting.axis[0] + 0.5) * scale - 0.5), round((sighting.box[1] + 0.5) * scale - 0.5)
        writer.write_above(place, text, COUNTED if label is not None else REJECTED)
    return canvas


def _draw_outline(canvas: np.ndarray, sighting: Sighting, colour: tuple[int, int, int], scale: float, thickness: int) -> None:
    """Draw the two edges of a stalk in the band, and bars where its widths were measured."""

    def at(column: float, row: float) -> tuple[int, int]:
        return round((column + 0.5) * scale - 0.5), round((row + 0.5) * scale - 0.5)

    left, top, right, bottom = sighting.box
    lean = math.radians(sighting.lean_deg or 0.0)
    # The width is perpendicular to the axis; along a row, the edges are further apart.
    half = 0.5 * (
        sighting.width_px / math.cos(lean)
        if sighting.width_px
        else max(right - left - abs(sighting.axis[1] - sighting.axis[0]), 2.0)
    )
    slope = (sighting.axis[1] - sighting.axis[0]) / max(bottom - top, 1.0)
    # The outline passes through the measured centre.
    middle = [sighting.column + slope * (row - sighting.row) for row in (top, bottom)]
    for side in (-half, half):
        cv2.line(canvas, at(middle[0] + side, top), at(middle[1] + side, bottom), colour, thickness, cv2.LINE_AA)
    bars = [(sighting.column, sighting.row, sighting.width_px)] if sighting.diameter_mm is not None else []
    for column, row, width in [*bars, *([sighting.upper_place] if sighting.upper_place else [])]:
        reach = 0.5 * (width or 0.0)
        over, down = reach * math.cos(lean), reach * math.sin(lean)
        cv2.line(canvas, at(column - over, row - down), at(column + over, row + down), MEASURED, 2 * thickness, cv2.LINE_AA)


class _LabelWriter:
    """Writer of non-overlapping text on an image, in place.

    Args:
        canvas: Image [H, W, 3] uint8.
        font_scale: Font scale of OpenCV.
        thickness: Line thickness of the letters, pixels.
    """

    def __init__(self, canvas: np.ndarray, font_scale: float, thickness: int) -> None:
        self._canvas, self._letters, self._thick = canvas, font_scale, thickness
        self._taken: list[tuple[int, int, int, int]] = []

    def write_above(self, point: tuple[int, int], text: str, colour: tuple[int, int, int]) -> None:
        """Write text above a point (column, row), as close as there is free space, with a line down to the point."""
        wide, tall = self._size(text)
        left = min(max(point[0] - wide // 2, 0), max(self._canvas.shape[1] - wide, 0))
        bottom = min(max(point[1] - tall // 2, tall), self._canvas.shape[0])  # a box may reach beyond the image
        while bottom > 2 * tall and any(_do_overlap((left, bottom - tall, left + wide, bottom), box) for box in self._taken):
            bottom -= tall // 3
        cv2.line(self._canvas, (point[0], bottom), point, colour, 1, cv2.LINE_AA)
        self._write((left, bottom), text, colour)

    def write_legend(self, title: str) -> None:
        """Write a title and the meaning of the colours in the lower left corner."""
        left, bottom = self._size("0")[1] // 2, self._canvas.shape[0] - self._size("0")[1] // 2
        for text, colour in [*([(title, (255, 255, 255))] if title else []), *_LEGEND]:
            self._write((left, bottom), text, colour)
            left += self._size(text)[0] + self._size("0")[1] // 2

    def _size(self, text: str) -> tuple[int, int]:
        (wide, tall), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, self._letters, self._thick)
        return wide + base, tall + 2 * base

    def _write(self, corner: tuple[int, int], text: str, colour: tuple[int, int, int]) -> None:
        """Write text on a darkened box with the given lower left corner (column, row)."""
        left, bottom = corner
        wide, tall = self._size(text)
        part = self._canvas[max(bottom - tall, 0) : bottom, left : left + wide]
        part[...] = part // 4
        self._taken.append((left, bottom - tall, left + wide, bottom))
        base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, self._letters, self._thick)[1]
        place = (left + base // 2, bottom - base)
        cv2.putText(self._canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, self._letters, colour, self._thick, cv2.LINE_AA)


def _do_overlap(first: tuple[int, int, int, int], second: tuple[int, int, int, int]) -> bool:
    return first[0] < second[2] and second[0] < first[2] and first[1] < second[3] and second[1] < first[3]
