"""Fit of the gate's statistics and regression, and its file; used by `benchmarks.stalks.gate`, not by the package."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.host.weights_file import write_parameters
from jaxrl_vis.stalks.digests import file_digest
from jaxrl_vis.stalks.phenotyping.detector.gate import MEASURES, Gate, gate_path

_FOLDS = 5


def fit_gate(
    pooled: np.ndarray, scores: list[np.ndarray], misread: np.ndarray, plots: np.ndarray, axes: int, max_flagged: float
) -> Gate:
    """Fit a gate.

    Distances to statistics that include the image itself are biased low. So the regression and the threshold are fitted on
    measures from five-fold cross-validation by plot.

    Args:
        pooled: Pooled features [N, D] of synthetic images.
        scores: Scores of the detections in each image.
        misread: [N] bool, True for images that were misread.
        plots: [N] int, plot of each image.
        axes: Number of principal axes.
        max_flagged: Fraction of the correctly read images above the threshold (false positive rate).

    Raises:
        ValueError: There are too few correctly read images, or no misread ones.
    """
    if (~misread).sum() < 3 * axes or not misread.any():
        raise ValueError(f"a gate needs {3 * axes} images that are read rightly, and one that is not")
    parts = np.unique(plots, return_inverse=True)[1] % _FOLDS
    measures = np.zeros((len(misread), MEASURES))
    for part in range(_FOLDS):
        here = np.flatnonzero(parts == part)
        of_others = _fit_statistics(pooled[~misread & (parts != part)], axes)
        measures[here] = [of_others.measures(pooled[place], scores[place]) for place in here]
    weights = fit_logistic_regression(measures, misread)
    doubts = 1.0 / (1.0 + np.exp(-np.clip(weights[0] + measures @ weights[1:], -30.0, 30.0)))
    threshold = float(np.quantile(doubts[~misread], 1.0 - max_flagged))
    return dataclasses.replace(_fit_statistics(pooled[~misread], axes), weights=weights, threshold=threshold)


def _fit_statistics(pooled: np.ndarray, axes: int) -> Gate:
    """Return a gate with the statistics of pooled features [N, D] of correctly read images, and zero weights."""
    mean, scale = pooled.mean(axis=0), pooled.std(axis=0)
    scale = scale + 0.1 * scale.mean() + 1e-6  # regularised: few images may understate the variance
    offset = (pooled - mean) / scale
    _, lengths, directions = np.linalg.svd(offset, full_matrices=False)
    spread = lengths[:axes] / np.sqrt(len(pooled))
    principal = (directions[:axes] / spread[:, None]).T
    left = offset - (offset @ directions[:axes].T) @ directions[:axes]
    return Gate(mean, scale, principal, float(np.sqrt(np.mean(left**2))), np.zeros(1 + MEASURES), 0.5)


def fit_logistic_regression(measures: np.ndarray, misread: np.ndarray) -> np.ndarray:
    """Fit a class-balanced, L2-regularised logistic regression by Newton's method.

    Args:
        measures: [N, M] float64, inputs.
        misread: [N] bool, targets, with both values.

    Returns:
        Intercept and weights [1 + M].
    """
    inputs = np.concatenate([np.ones((len(measures), 1)), measures], axis=1)
    weight = np.where(misread, 0.5 / misread.sum(), 0.5 / (~misread).sum())
    shrink = np.diag([0.0, *[1e-3] * measures.shape[1]])
    weights = np.zeros(inputs.shape[1])
    for _ in range(50):
        probability = 1.0 / (1.0 + np.exp(-np.clip(inputs @ weights, -30.0, 30.0)))
        gradient = inputs.T @ (weight * (probability - misread)) + shrink @ weights
        hessian = (inputs.T * (weight * probability * (1.0 - probability))) @ inputs + shrink + 1e-9 * np.eye(len(weights))
        weights = weights - np.linalg.solve(hessian, gradient)
    return weights


def write_gate(weights: Path, gate: Gate, about: dict[str, Any]) -> None:
    """Write the gate of a weights file.

    Args:
        weights: Weights file, whose digest is stored: the gate is valid for these weights only.
        gate: Gate to write.
        about: JSON-serialisable metadata on its origin.

    Raises:
        OSError: The gate cannot be written.
    """
    arrays = {name: np.asarray(value, np.float32) for name, value in dataclasses.asdict(gate).items()}
    sizes = {"size": len(gate.mean), "axes": gate.axes.shape[1]}
    write_parameters(gate_path(weights), arrays, {"weights": file_digest(weights), **sizes, **about}, bits=32)
