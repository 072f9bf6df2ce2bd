"""Detections from the ground truth that `phenotype synth` writes beside its images."""

import functools
from pathlib import Path

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.detector.band import Band
from jaxrl_vis.stalks.phenotyping.detector.finder import Detection
from jaxrl_vis.stalks.phenotyping.evaluation.perfect import perfect_detections
from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles, PlotFolder
from jaxrl_vis.stalks.phenotyping.io.images import image_size, read_image
from jaxrl_vis_envs.documents import read_json

_MAX_COORDINATE = 1e6  # pixels


def find_truth(
    image: np.ndarray, pixels_per_metre: float | None, band: Band | None, plot: PlotFolder, pair: PairFiles
) -> list[Detection]:
    """Return the ground-truth detections in the left image of a pair of a synthetic plot, with a detector's signature.

    Args:
        image: The image, of which only the size is used.
        pixels_per_metre, band: Ignored.
        plot: The plot.
        pair: The pair.

    Raises:
        RequestError: The plot is not synthetic, or was written without masks.
    """
    try:
        stalks = _stalks_by_pair(plot.folder).get(int(pair.name), [])
        truth = plot.folder / "truth" / f"instance_{pair.name}.png"
        if image_size(truth) != image.shape[:2]:
            raise ValueError("masks of another image")
        return perfect_detections(stalks, read_image(truth).astype(np.int64) - 1)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError) as error:
        raise RequestError(
            f"{plot.folder} holds no true masks: write it with `jaxrl-vis phenotype synth --truth all`, or use --masks network"
        ) from error


@functools.lru_cache(maxsize=4)
def _stalks_by_pair(folder: Path) -> dict[int, list[dict]]:
    """Read the stalks in view of each pair, by the pair's number, from plot.json.

    Raises:
        OSError, ValueError, KeyError, TypeError: The file is missing or malformed.
    """
    of_pair: dict[int, list[dict]] = {}
    for stalk in read_json(folder / "plot.json")["seen"]:
        box = stalk["band_box"]
        if box is not None and (len(box) != 4 or not all(abs(float(edge)) < _MAX_COORDINATE for edge in box)):
            raise ValueError("a box is none")
        of_pair.setdefault(stalk["pair"], []).append(
            {**stalk, "band_box": None if box is None else [float(edge) for edge in box]}
        )
    return of_pair
