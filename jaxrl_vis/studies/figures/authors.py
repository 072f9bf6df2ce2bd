"""Learning curves by the authors of OL-AUX, digitised from their figures as described in the header of the data file."""

import csv
import importlib.resources
from collections.abc import Sequence

import numpy as np

_FILE = "data/ol_aux_curves.csv"
_ENVIRONMENTS = {"VisualFinger": "VisualFingerTurn"}  # environments with another name in the file
_VARIANTS = {"NoAux": "none", "OL-AUX-5": "ol_aux_5"}


def released_curves() -> dict[tuple[str, str], list[tuple[int, float]]]:
    """Read the curves of (environment steps, success), ascending, by (environment, variant) in this project's names."""
    text = importlib.resources.files("jaxrl_vis.studies").joinpath(_FILE).read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    curves: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for row in csv.DictReader(lines):
        key = (_ENVIRONMENTS.get(row["env"], row["env"]), _VARIANTS[row["method"]])
        curves.setdefault(key, []).append((1000 * int(row["timesteps_thousand"]), float(row["success"])))
    return {key: sorted(points) for key, points in curves.items()}


def mean_difference(ours: Sequence[tuple[int, float]], theirs: Sequence[tuple[int, float]]) -> float | None:
    """Compute the mean absolute difference of two curves, at the points of the second one within the range of the first.

    Args:
        ours: (environment steps, success), ascending; interpolated linearly.
        theirs: (environment steps, success), ascending; not interpolated.

    Returns:
        The difference; None if there is no such point.
    """
    if not ours:
        return None
    steps, success = zip(*ours, strict=True)
    common = [(position, value) for position, value in theirs if steps[0] <= position <= steps[-1]]
    if not common:
        return None
    return float(np.mean([abs(np.interp(position, steps, success) - value) for position, value in common]))
