"""Depth of the row of plants next to the cameras: by day they also see the rows behind, often with more stalks in view."""

from collections.abc import Sequence

import numpy as np

MIN_STALKS = 3
"""Minimum number of stalks to estimate the depth of a row."""
_MAX_RATIO = 1.3  # of the depths of a row's stalks
_MIN_SHARE = 0.15  # of all measured stalks


def near_row_depth(depths: Sequence[float]) -> float:
    """Return the median depth of the stalks in the nearest row, m.

    Args:
        depths: Depths of one or more stalks, m; fewer than three at one depth are no row, if there are more at another.
    """
    ordered = np.sort(np.asarray(depths, float))
    in_row = np.searchsorted(ordered, ordered * _MAX_RATIO, side="right") - np.arange(len(ordered))
    enough = min(max(MIN_STALKS, _MIN_SHARE * len(ordered)), in_row.max())
    first = int(np.argmax(in_row >= enough))
    return float(np.median(ordered[first : first + in_row[first]]))
