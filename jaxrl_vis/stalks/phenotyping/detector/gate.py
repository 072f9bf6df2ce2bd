"""Gate: estimated probability that the networks misread an image, from novelty and uncertainty.

Three measures of an image enter: the distance of the backbone's pooled features from those of images that were read correctly
(Mahalanobis distance within the principal subspace, and the residual outside it), and the fraction of uncertain scores. A
logistic regression combines them; everything is fitted on synthetic images (`benchmarks.stalks.gate`).
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.weights_file import read_parameters
from jaxrl_vis.stalks.digests import file_digest

MEASURES = 3
"""Number of measures of an image."""
_COMMAND = "python -m benchmarks.stalks.gate"
_UNSURE = 0.1  # lower scores are those of background


@dataclasses.dataclass(frozen=True)
class Gate:
    """Statistics of correctly read images, and the logistic regression on the measures.

    Attributes:
        mean: [D] float32, mean of the pooled features; D is twice the number of backbone channels.
        scale: [D] float32, standard deviation of each feature, regularised.
        axes: [D, K] float32, principal axes of the standardised features, divided by the standard deviation along each.
        beside: Root mean square of the residual outside the principal subspace.
        weights: [1 + MEASURES] float32, intercept and weights of the regression.
        threshold: Doubt above which an image is reported as unfamiliar.
    """

    mean: np.ndarray
    scale: np.ndarray
    axes: np.ndarray
    beside: float
    weights: np.ndarray
    threshold: float

    def measures(self, pooled: np.ndarray, scores: np.ndarray) -> np.ndarray:
        """Compute the measures [MEASURES] of an image: log distance, log residual, and uncertain fraction of the scores.

        Args:
            pooled: [D] float32, see `detect.DetectorOutput`.
            scores: [N] of all detections, including those with low scores.
        """
        offset = (np.asarray(pooled, np.float64) - self.mean) / self.scale
        along = offset @ self.axes
        # Axes are orthogonal, but not of unit norm.
        lengths = np.linalg.norm(self.axes, axis=0)
        left = offset - (self.axes / lengths) @ (along / lengths)
        unsure = np.minimum(scores, 1.0 - scores)[scores >= _UNSURE].sum()
        sure = scores[scores >= 0.5].sum()
        return np.array(
            [
                np.log(np.sqrt(np.mean(along**2)) + 1e-3),
                np.log(np.sqrt(np.mean(left**2)) / self.beside + 1e-3),
                (unsure + 0.1) / (sure + unsure + 0.2),
            ]
        )

    def doubt(self, pooled: np.ndarray, scores: np.ndarray) -> float:
        """Estimate the probability, 0 to 1, that an image is misread, as fitted on synthetic images; see `measures`."""
        logit = self.weights[0] + self.weights[1:] @ self.measures(pooled, scores)
        return float(1.0 / (1.0 + np.exp(-np.clip(logit, -30.0, 30.0))))


def gate_path(weights: Path) -> Path:
    """Return the path of the gate file that belongs to a weights file, in the same folder."""
    return weights.with_suffix(".gate.safetensors")


def read_gate(weights: Path) -> Gate | None:
    """Read the gate of a weights file; return None if there is none, or it belongs to other weights.

    Raises:
        RequestError: The gate file cannot be read.
    """
    path = gate_path(weights)
    if not path.is_file():
        return None

    def declare(about: dict[str, Any]) -> tuple[str, Any]:
        size, count = int(about["size"]), int(about["axes"])
        if not (0 < size <= 4096 and 0 < count <= size):
            raise RequestError(f"{path} holds no gate: make it again with `{_COMMAND}`")
        shapes = {"mean": (size,), "scale": (size,), "axes": (size, count), "weights": (1 + MEASURES,)}
        shapes |= {"beside": (), "threshold": ()}
        return str(about["weights"]), {name: jax.ShapeDtypeStruct(shape, np.float32) for name, shape in shapes.items()}

    arrays, digest, _ = read_parameters(path, _COMMAND, declare)
    if digest != file_digest(weights):
        return None
    mean, scale, axes, linear = (np.asarray(arrays[name]) for name in ("mean", "scale", "axes", "weights"))
    return Gate(mean, scale, axes, float(arrays["beside"]), linear, float(arrays["threshold"]))
