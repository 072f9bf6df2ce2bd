"""Loading of the detector that a command names by a file of weights, or by none."""

import functools
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.digests import file_digest
from jaxrl_vis.stalks.phenotyping.detector.finder import Detection, Finder
from jaxrl_vis.stalks.phenotyping.detector.gate import read_gate
from jaxrl_vis.stalks.phenotyping.detector.weights import SHIPPED, read_weights


def resolve_weights(weights: Path | None) -> Path:
    """Return the file of the networks' weights: ``weights``, or the shipped one if that is None.

    Raises:
        RequestError: There is no such file.
    """
    if weights is None and not SHIPPED.exists():
        raise RequestError(
            "no weights come with this version: make some with `jaxrl-vis phenotype train`, and name them with --weights"
        )
    if weights is not None and not weights.is_file():
        raise RequestError(f"cannot read the weights {weights}: no such file")
    return SHIPPED if weights is None else weights


def detector_name(weights: Path) -> str:
    """Return a name of the networks with these weights, which changes with the contents of the file."""
    return f"networks {file_digest(weights)}"


@functools.cache
def _load(weights: Path, digest: str, least_score: float) -> Finder:
    params, settings, _ = read_weights(weights)
    return Finder(params, settings, least_score, read_gate(weights))


def load_finder(weights: Path, least_score: float) -> Finder:
    """Return the networks with these weights; a process reads the same file once.

    Args:
        weights: File of the weights.
        least_score: Lowest score of a detection, 0 to 1.

    Raises:
        RequestError: The weights cannot be read.
    """
    return _load(weights, file_digest(weights), least_score)


@functools.cache
def _shared_finder(weights: Path, least_score: float) -> Finder:
    return load_finder(weights, least_score)


def find_stalks(
    weights: Path, least_score: float, image: np.ndarray, density: float | None, plot: Any, pair: Any
) -> list[Detection]:
    """Find the stalks of an image [H, W, 3] uint8 in any process: `functools.partial` of this can be pickled.

    Args:
        weights: File of the weights, which must stay the same while the process lives.
        least_score: Lowest score of a detection, 0 to 1.
        image: Left image.
        density: Pixels per metre at the row; None if nothing is known of the camera.
        plot, pair: Folder and files of the image, which networks do not need.
    """
    return _shared_finder(weights, least_score)(image, density)
