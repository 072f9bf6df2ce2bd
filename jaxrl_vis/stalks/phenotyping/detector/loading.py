"""Loading of the detector from a weights file, by default the one shipped with the package."""

import functools
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.digests import file_digest
from jaxrl_vis.stalks.phenotyping.detector.band import Band
from jaxrl_vis.stalks.phenotyping.detector.finder import Detection, Finder
from jaxrl_vis.stalks.phenotyping.detector.gate import read_gate
from jaxrl_vis.stalks.phenotyping.detector.weights import PHOTOGRAPHS, SHIPPED, read_weights


def resolve_weights(weights: Path | None) -> Path:
    """Return the path of the weights: ``weights``, or the shipped file if None.

    Raises:
        RequestError: There is no such file.
    """
    path = SHIPPED if weights is None else weights
    if not path.is_file():
        raise RequestError(f"cannot read the weights {path}: no such file")
    return path


def detector_name(weights: Path) -> str:
    """Return a name of the networks that is derived from the contents of the weights file, or of both that ship."""
    files = (SHIPPED, PHOTOGRAPHS) if weights == SHIPPED else (weights,)
    return f"networks {'+'.join(map(file_digest, files))}"


@functools.cache
def _load(weights: Path, digest: str, min_score: float) -> Finder:
    params, settings, _ = read_weights(weights)
    substitute = load_finder(PHOTOGRAPHS, min_score) if weights == SHIPPED else None
    return Finder(params, settings, min_score, read_gate(weights), substitute)


def load_finder(weights: Path, min_score: float) -> Finder:
    """Load the networks; cached by the path and contents of the file within a process.

    With `SHIPPED`, images of unknown cameras, and those that its gate doubts, are read by the networks in `PHOTOGRAPHS`.

    Args:
        weights: Weights file.
        min_score: Minimum score of a detection, 0 to 1.

    Raises:
        RequestError: The weights cannot be read.
    """
    return _load(weights, file_digest(weights), min_score)


@functools.cache
def _cached_finder(weights: Path, min_score: float) -> Finder:
    return load_finder(weights, min_score)


def find_stalks(
    weights: Path,
    min_score: float,
    image: np.ndarray,
    pixels_per_metre: float | None,
    band: Band | None,
    plot: Any,
    pair: Any,
) -> list[Detection]:
    """Detect the stalks of an image in any process: a `functools.partial` of this function can be pickled.

    Args:
        weights: Weights file, which must not change during the lifetime of the process.
        min_score: Minimum score of a detection, 0 to 1.
        image: Left image [H, W, 3] uint8.
        pixels_per_metre: Resolution of the image at the row of plants; None if the camera is unknown.
        band: Rows of the band; None if the camera is unknown.
        plot, pair: Folder and files of the image; unused.

    Returns:
        The detections, a `Detections`, sorted from left to right.

    Raises:
        RequestError: The weights cannot be read.
    """
    return _cached_finder(weights, min_score)(image, pixels_per_metre, band)
