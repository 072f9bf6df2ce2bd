"""Error of every width estimator on ideal strips: `python -m benchmarks.stalks.strip_widths`.

A strip is a tilted rectangle of known width, rasterised at many sub-pixel positions: as the pixels whose centre it covers
(hard), or as the covered fraction of each pixel (soft). The result is the mean error over positions, at the width where it is
largest.
"""

import argparse
import math

import cv2
import numpy as np

from jaxrl_vis.stalks.phenotyping.measure.width import fit_strip

RATIOS = (1.5, 3.0, 6.0, 12.0)
LEANS = (0.0, 2.0, 8.0, 14.0, 20.0)
ELLIPSE_FITS = ("pixels", "pixels_direct", "contour", "contour_direct", "contour_ams", "moments")
"""Methods of fitting an ellipse to a mask. ``pixels``, least squares over all its pixels, is the method of the thesis."""


def ideal_strip(width: float, ratio: float, lean: float, position: tuple[float, float], soft: bool) -> np.ndarray:
    """Rasterise the mask of a strip [H, W]: covered fraction of each pixel, float32, or bool.

    Args:
        width: Width across the axis, pixels.
        ratio: Ratio of length to width.
        lean: Tilt, degrees.
        position: Offset (x, y) of its centre from a pixel's centre, pixels.
        soft: Return fractions instead of bool.
    """
    fine = 8 if soft else 1
    half = int(0.5 * width * np.hypot(ratio, 1.0)) + 4
    ticks = (np.arange((2 * half + 1) * fine) + 0.5) / fine - half - 0.5
    x, y = ticks[None, :] - position[0], ticks[:, None] - position[1]
    angle = np.radians(lean)
    across, along = x * np.cos(angle) + y * np.sin(angle), -x * np.sin(angle) + y * np.cos(angle)
    inside = (np.abs(across) < width / 2) & (np.abs(along) < width * ratio / 2)
    if not soft:
        return inside
    size = 2 * half + 1
    return inside.reshape(size, fine, size, fine).mean(axis=(1, 3)).astype(np.float32)


def mean_errors(estimate, ratio: float, lean: float, soft: bool, positions: int, widths: tuple[float, ...]) -> np.ndarray:
    """Return the mean relative error [len(widths)] of a width estimator; NaN where it returned None for a strip.

    Args:
        estimate: Function from a mask [H, W] to its width, pixels, or None.
        ratio: Ratio of length to width.
        lean: Tilt, degrees.
        soft: Rasterise covered fractions instead of bool.
        positions: Number of random sub-pixel positions per width.
        widths: True widths, pixels.
    """
    rng = np.random.default_rng(0)
    errors = []
    for width in widths:
        estimates = [
            estimate(ideal_strip(width, ratio, lean, tuple(rng.uniform(-0.5, 0.5, 2)), soft)) for _ in range(positions)
        ]
        errors.append(np.mean([np.nan if estimated is None else estimated / width - 1.0 for estimated in estimates]))
    return np.array(errors)


def width_by_strip(mask: np.ndarray) -> float | None:
    """Return the width by `fit_strip`; None if it finds none."""
    strip = fit_strip(mask)
    return None if strip is None else strip.width()


def ellipse_width(mask: np.ndarray, fit: str) -> float | None:
    """Return the minor axis of the ellipse fitted to a mask [H, W] bool by one of `ELLIPSE_FITS`; None without 5 points."""
    row, column = np.nonzero(mask)
    points = np.stack([column, row], axis=1).astype(np.float32)
    if fit == "moments":
        return 4.0 * math.sqrt(max(float(np.linalg.eigvalsh(np.cov(points.T))[0]), 0.0))
    if fit.startswith("contour"):
        contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        points = max(contours, key=len).reshape(-1, 2).astype(np.float32)
    if len(points) < 5:
        return None
    fitter = {"direct": cv2.fitEllipseDirect, "ams": cv2.fitEllipseAMS}.get(fit.partition("_")[2], cv2.fitEllipse)
    return float(min(fitter(points)[1]))


def table(positions: int = 12, widths: tuple[float, ...] = (20.0, 27.5, 38.9)) -> list[str]:
    """Return the lines of a Markdown table: for each estimator, mask, tilt and ratio, the mean error at the worst width.

    Args:
        positions: Number of random sub-pixel positions per width.
        widths: True widths, pixels.
    """
    estimators = {"strip": width_by_strip} | {
        f"ellipse, {fit}": lambda mask, fit=fit: ellipse_width(mask, fit) for fit in ELLIPSE_FITS
    }
    lines = [
        "| estimator | mask | lean | " + " | ".join(f"L/W {ratio:g}" for ratio in RATIOS) + " |",
        "|---|---|---" + "|---" * len(RATIOS) + "|",
    ]
    for name, estimate in estimators.items():
        for soft in (True, False) if name == "strip" else (False,):
            for lean in LEANS if name == "strip" else (0.0, 20.0):
                errors = [mean_errors(estimate, ratio, lean, soft, positions, widths) for ratio in RATIOS]
                worst = [row[np.nanargmax(np.abs(row))] if np.isfinite(row).any() else np.nan for row in errors]
                cells = " | ".join(f"{100 * error:+.2f} %" for error in worst)
                lines.append(f"| {name} | {'soft' if soft else 'hard'} | {lean:g} | {cells} |")
    return lines


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Error of every estimator of width on ideal strips.")
    parser.add_argument("--places", type=int, default=12, help="sub-pixel places of each strip")
    print("\n".join(table(parser.parse_args().places)))
