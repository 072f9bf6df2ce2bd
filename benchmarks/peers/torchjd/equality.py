"""Differences between the results of both libraries, and how well each solves the problem that a method's paper states.

Jacobians are [K, P] float64 for K losses and P parameters, weights [K] float64.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.peers.torchjd.ours import CAGRAD_RADIUS, FAIR_ALPHA, SOLVED

TOLERANCE = 1e-5
"""Maximum relative difference of closed forms, and of random methods with given random numbers."""
_TINY = 1e-12
_ROUNDING = 1e-6
"""Norm of a step, relative to the largest gradient norm, below which it counts as 0."""


def relative(one: np.ndarray, other: np.ndarray, floor: np.ndarray | float = _TINY) -> np.ndarray:
    """Return the distance between rows [n], relative to the norm of the second one, or to ``floor`` if the norm is smaller."""
    axes = tuple(range(1, one.ndim))
    length = np.sqrt((other**2).sum(axis=axes))
    return np.sqrt(((one - other) ** 2).sum(axis=axes)) / np.maximum(length, floor)


def gap(jacobian: np.ndarray, weights: np.ndarray) -> float:
    """Return MGDA's duality gap, relative to the largest squared gradient norm: 0 at the minimum-norm vector.

    Args:
        jacobian: [K, P], gradients of the losses; as for all functions of `RESIDUALS`.
        weights: [K], weights of the losses.
    """
    step = weights @ jacobian
    return float((step @ step - (jacobian @ step).min()) / _longest(jacobian) ** 2)


def cagrad_loss(jacobian: np.ndarray, weights: np.ndarray) -> float:
    """Return the shortfall of the worst slope from the dual bound, relative to the mean gradient's squared norm.

    The dual is evaluated at the weights within the convex hull. An excess of the step over CAGrad's radius, relative to the
    radius, is added. The result is 0 for weights of 0, which stand for a stationary point, and for weights that sum to 1, which
    do not determine the dual's.
    """
    mean = jacobian.mean(axis=0)
    radius, step = CAGRAD_RADIUS * np.linalg.norm(mean), weights @ jacobian
    inside = weights - 1 / len(weights)
    total = inside.sum()
    if np.abs(weights).max() == 0.0 or abs(total) < _TINY:
        return 0.0
    hull = inside / total @ jacobian
    outside = max(0.0, np.linalg.norm(step - mean) / radius - 1.0)
    bound = hull @ mean + radius * np.linalg.norm(hull)
    return float((bound - (jacobian @ step).min()) / (mean @ mean) + outside)


def cone_residual(jacobian: np.ndarray, weights: np.ndarray) -> float:
    """Return the largest conflict of the step with a gradient: minus their cosine similarity, at least 0.

    Args:
        jacobian: [K, P], gradients of the losses.
        weights: [K], weights of the losses.
    """
    step = weights @ jacobian
    lengths = np.linalg.norm(jacobian, axis=1) * max(np.linalg.norm(step), _ROUNDING * _longest(jacobian))
    return float(max(0.0, -(jacobian @ step / lengths).min()))


def dual_residual(jacobian: np.ndarray, weights: np.ndarray) -> float:
    """Return the largest violation of the optimality conditions of DualProj: no conflicts, and complementary slackness.

    Args:
        jacobian: [K, P], gradients of the losses.
        weights: [K], weights of the losses.
    """
    step, mean = weights @ jacobian, jacobian.mean(axis=0)
    slack = abs((weights - 1 / len(weights)) @ (jacobian @ step)) / max(mean @ mean, (_ROUNDING * _longest(jacobian)) ** 2)
    return max(cone_residual(jacobian, weights), float(slack))


def fair_residual(jacobian: np.ndarray, weights: np.ndarray) -> float:
    """Return the largest relative error of FairGrad's condition G w = w^(-1 / alpha), for alpha = `FAIR_ALPHA`.

    Args:
        jacobian: [K, P], gradients J of the losses, with the Gramian G = J J^T.
        weights: [K], weights w of the losses.
    """
    return float(np.abs(jacobian @ (weights @ jacobian) * weights ** (1 / FAIR_ALPHA) - 1.0).max())


def nash_residual(jacobian: np.ndarray, weights: np.ndarray) -> float:
    """Return the largest relative error of Nash-MTL's condition G w = c / w.

    The constant c is the mean of w G w, because TorchJD scales the Gramian.

    Args:
        jacobian: [K, P], gradients J of the losses, with the Gramian G = J J^T.
        weights: [K], weights w of the losses.
    """
    products = jacobian @ (weights @ jacobian) * weights
    return float(np.abs(products / products.mean() - 1.0).max())


def _longest(jacobian: np.ndarray) -> float:
    return float(np.linalg.norm(jacobian, axis=1).max())


RESIDUALS: dict[str, Callable[[np.ndarray, np.ndarray], float]] = {
    "mgda": gap,
    "cagrad": cagrad_loss,
    "fairgrad": fair_residual,
    "upgrad": cone_residual,
    "dualproj": dual_residual,
    "nash_mtl": nash_residual,
}
_FULL_RANK = ("fairgrad", "nash_mtl")  # linearly dependent gradients may have no solution
_NO_LINE = ("gradvac",)  # at rank 1, a gradient is reduced to 0, and its next cosine is rounding error


def compare(arrays: dict[str, np.ndarray], ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """Compare all methods, with one row for each.

    Returns:
        Rows of method, kind (closed form or solver), number of cases, maximum and median relative difference of directions (of
        weights, for methods that read only losses), and for solvers the maximum and median residual of both sides.
    """
    counts = sorted({int(name.split("/")[0]) for name in arrays})
    rows = []
    for method in dict.fromkeys(name.split("/")[1] for name in ours):
        differences, residuals = [], {"ours": [], "theirs": []}
        for count in counts:
            jacobians, ranks = arrays[f"{count}/jacobians"], arrays[f"{count}/ranks"]
            chosen = ranks > (count - 1 if method in _FULL_RANK else 1 if method in _NO_LINE else 0)
            jacobians, one, other = (
                part[chosen] for part in (jacobians, ours[f"{count}/{method}"], theirs[f"{count}/{method}"])
            )
            if method in SOLVED:
                for side, weights in (("ours", one), ("theirs", other)):
                    residuals[side] += [RESIDUALS[method](*pair) for pair in zip(jacobians, weights, strict=True)]
                one, other = (np.einsum("nk,nkp->np", weights, jacobians) for weights in (one, other))
                if method == "nash_mtl":
                    one, other = (step / np.linalg.norm(step, axis=1, keepdims=True) for step in (one, other))
                # Differences of nearly vanishing steps are relative to the gradients.
                scale = np.linalg.norm(jacobians, axis=2).max(axis=1) if method != "nash_mtl" else 1.0
                length = np.maximum(np.linalg.norm(other, axis=1), 1e-2 * scale)
                differences += list(np.linalg.norm(one - other, axis=1) / length)
            elif one.shape[1:] == jacobians.shape[2:]:
                floor = _ROUNDING * np.linalg.norm(jacobians, axis=2).max(axis=1)
                one, other = (np.where(np.linalg.norm(step, axis=1) < floor, 0.0, step.T).T for step in (one, other))
                differences += list(relative(one, other, floor))
            else:
                differences += list(relative(one, other))
        row = {"method": method, "kind": "solver" if method in SOLVED else "closed form", "cases": len(differences)}
        row |= {"difference_max": max(differences), "difference_median": float(np.median(differences))}
        for side, values in residuals.items():
            if values:
                row |= {f"residual_max_{side}": max(values), f"residual_median_{side}": float(np.median(values))}
        rows.append({name: float(value) if isinstance(value, np.floating) else value for name, value in row.items()})
    return rows


def failures(rows: list[dict[str, Any]]) -> list[str]:
    """List the failing methods: closed forms must be within `TOLERANCE`, residuals no greater than TorchJD's."""
    wrong = [row["method"] for row in rows if row["kind"] == "closed form" and not row["difference_max"] <= TOLERANCE]
    solved = [row for row in rows if row["kind"] == "solver"]
    return wrong + [row["method"] for row in solved if not row["residual_max_ours"] <= max(row["residual_max_theirs"], 1e-9)]
