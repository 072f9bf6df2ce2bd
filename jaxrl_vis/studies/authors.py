"""Learning curves that the authors of OL-AUX released, read off their figures; the data's first lines say how."""

import csv
import importlib.resources
from collections.abc import Sequence

import numpy as np

_FILE = "data/ol_aux_curves.csv"
_ENVIRONMENTS = {"VisualFinger": "VisualFingerTurn"}  # where theirs has another name
_VARIANTS = {"NoAux": "none", "OL-AUX-5": "ol_aux_5"}


def released_curves() -> dict[tuple[str, str], list[tuple[int, float]]]:
    """(environment, variant) -> (environment steps, success), ascending; both named as here."""
    text = importlib.resources.files("jaxrl_vis.studies").joinpath(_FILE).read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    curves: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for row in csv.DictReader(lines):
        key = (_ENVIRONMENTS.get(row["env"], row["env"]), _VARIANTS[row["method"]])
        curves.setdefault(key, []).append((1000 * int(row["timesteps_thousand"]), float(row["success"])))
    return {key: sorted(points) for key, points in curves.items()}


def mean_difference(ours: Sequence[tuple[int, float]], theirs: Sequence[tuple[int, float]]) -> float | None:
    """Mean absolute difference of two curves over the points of the second that lie where both are known.

    Args:
        ours: (environment steps, success), ascending; read linearly between its points.
        theirs: The same.

    Returns:
        None where no such point is there.
    """
    if not ours:
        return None
    steps, success = zip(*ours, strict=True)
    common = [(at, value) for at, value in theirs if steps[0] <= at <= steps[-1]]
    if not common:
        return None
    return float(np.mean([abs(np.interp(at, steps, success) - value) for at, value in common]))
