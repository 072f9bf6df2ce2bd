"""A gate that says of an image how likely the networks read it wrongly: what they do not know, and what they are not sure of.

Three numbers of an image decide: how far the pooled features of the backbone lie from those of images that were read rightly
(Mahalanobis' distance along their principal axes, and what is left beside these axes), and the share of the scores that says
neither yes nor no. A logistic regression weighs them; all of it is fitted on synthetic images (`benchmarks.stalks.gate`).
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.weights_file import read_parameters, write_parameters
from jaxrl_vis.stalks.digests import file_digest

MEASURES = 3
"""Numbers of an image that decide."""
_COMMAND = "python -m benchmarks.stalks.gate"
_PARTS = 5
_UNSURE = 0.1  # scores below are of what is no stalk


@dataclasses.dataclass(frozen=True)
class Gate:
    """Statistics of images that were read rightly, and what follows from them.

    Attributes:
        mean: [D] float32, of pooled features; D is twice the number of the backbone's channels.
        scale: [D] float32, standard deviation of each.
        axes: [D, K] float32, principal axes, divided by the standard deviation along each.
        beside: Standard deviation of what is left beside these axes.
        weights: [1 + MEASURES] float32, offset and weights of the measures.
        threshold: Doubt above which an image is told to be unlike those that the networks know.
    """

    mean: np.ndarray
    scale: np.ndarray
    axes: np.ndarray
    beside: float
    weights: np.ndarray
    threshold: float

    def measures(self, pooled: np.ndarray, scores: np.ndarray) -> np.ndarray:
        """Return the measures [MEASURES] of an image.

        Args:
            pooled: [D] float32, see `detect.Found`.
            scores: [N] of all that may be stalks.
        """
        offset = (np.asarray(pooled, np.float64) - self.mean) / self.scale
        along = offset @ self.axes
        # Axes are orthogonal but for their lengths.
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
        """Return how likely an image is read wrongly, 0 to 1, as far as synthetic images tell; see `measures`."""
        logit = self.weights[0] + self.weights[1:] @ self.measures(pooled, scores)
        return float(1.0 / (1.0 + np.exp(-np.clip(logit, -30.0, 30.0))))


def gate_path(weights: Path) -> Path:
    """Return the file of the gate of a file of weights, which lies beside it."""
    return weights.with_suffix(".gate.safetensors")


def write_gate(weights: Path, gate: Gate, about: dict[str, Any]) -> None:
    """Write the gate of a file of weights.

    Args:
        weights: The file, which the gate is for alone.
        gate: The gate.
        about: Where it comes from; anything that JSON holds.

    Raises:
        OSError: It cannot be written.
    """
    arrays = {name: np.asarray(value, np.float32) for name, value in dataclasses.asdict(gate).items()}
    sizes = {"size": len(gate.mean), "axes": gate.axes.shape[1]}
    write_parameters(gate_path(weights), arrays, {"weights": file_digest(weights), **sizes, **about}, bits=32)


def read_gate(weights: Path) -> Gate | None:
    """Read the gate of a file of weights; None where there is none, or it is for other weights.

    Raises:
        RequestError: The file of the gate cannot be read.
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


def fit_gate(
    pooled: np.ndarray, scores: list[np.ndarray], wrong: np.ndarray, plots: np.ndarray, axes: int, most_flagged: float
) -> Gate:
    """Fit a gate.

    Images lie nearer to statistics that they are part of. So weights and threshold come from measures by the statistics of
    other plots: of five parts, each is measured by the four others.

    Args:
        pooled: [N, D] of synthetic images.
        scores: Scores of each.
        wrong: [N] bool, True for those that were read wrongly.
        plots: [N] int, the plot of each.
        axes: Number of principal axes.
        most_flagged: Greatest share of the images that were read rightly and are told to be unlike what the networks know.

    Raises:
        ValueError: There are too few images of a kind.
    """
    if (~wrong).sum() < 3 * axes or not wrong.any():
        raise ValueError(f"a gate needs {3 * axes} images that are read rightly, and one that is not")
    parts = np.unique(plots, return_inverse=True)[1] % _PARTS
    measures = np.zeros((len(wrong), MEASURES))
    for part in range(_PARTS):
        here = np.flatnonzero(parts == part)
        of_others = _statistics(pooled[~wrong & (parts != part)], axes)
        measures[here] = [of_others.measures(pooled[place], scores[place]) for place in here]
    weights = logistic(measures, wrong)
    doubts = 1.0 / (1.0 + np.exp(-np.clip(weights[0] + measures @ weights[1:], -30.0, 30.0)))
    threshold = float(np.quantile(doubts[~wrong], 1.0 - most_flagged))
    return dataclasses.replace(_statistics(pooled[~wrong], axes), weights=weights, threshold=threshold)


def _statistics(right: np.ndarray, axes: int) -> Gate:
    """Return a gate with the statistics of pooled features [N, D], and no weights yet."""
    mean, scale = right.mean(axis=0), right.std(axis=0)
    scale = scale + 0.1 * scale.mean() + 1e-6  # what hardly varies among a few images may vary more among others
    offset = (right - mean) / scale
    _, lengths, directions = np.linalg.svd(offset, full_matrices=False)
    spread = lengths[:axes] / np.sqrt(len(right))
    principal = (directions[:axes] / spread[:, None]).T
    left = offset - (offset @ directions[:axes].T) @ directions[:axes]
    return Gate(mean, scale, principal, float(np.sqrt(np.mean(left**2))), np.zeros(1 + MEASURES), 0.5)


def logistic(measures: np.ndarray, wrong: np.ndarray) -> np.ndarray:
    """Fit a logistic regression by Newton's method, a little shrunk; both classes count alike: [1 + M]."""
    inputs = np.concatenate([np.ones((len(measures), 1)), measures], axis=1)
    share = np.where(wrong, 0.5 / wrong.sum(), 0.5 / (~wrong).sum())
    shrink = np.diag([0.0, *[1e-3] * measures.shape[1]])
    weights = np.zeros(inputs.shape[1])
    for _ in range(50):
        chance = 1.0 / (1.0 + np.exp(-np.clip(inputs @ weights, -30.0, 30.0)))
        slope = inputs.T @ (share * (chance - wrong)) + shrink @ weights
        bend = (inputs.T * (share * chance * (1.0 - chance))) @ inputs + shrink + 1e-9 * np.eye(len(weights))
        weights = weights - np.linalg.solve(bend, slope)
    return weights
