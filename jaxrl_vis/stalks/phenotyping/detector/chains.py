"""Chains: sections linked upwards to stalks, their scores, and the part of a chain within given rows. NumPy only.

Sections of adjacent bands are linked where the axis of one continues that of the other and their widths are similar, best pairs
first and one to one; then, over gaps of one to three bands that leaves hide, those that are still free.

The score of a chain is 1 - sqrt(prod(1 - s)) over the scores s of its sections: several weak sections add up (five of 0.5 give
0.82), and a single one counts for less than its own score (one of 0.9 gives 0.68). The root allows for neighbours whose errors
are correlated.
"""

import dataclasses

import numpy as np

_MIN_SCORE = 0.1  # of sections that are linked
_SLOPE = 0.7  # maximum shift of the axis per height: stalks that lean by 35 degrees
_WIDTHS = 0.5  # maximum difference of the logarithms of the widths
_BESIDE = 0.4  # maximum distance of the axes where two sections meet, of the mean width
_REACH = 4  # bands from one section to the next: leaves hide up to three in between
_RANGE = 4  # sections of the part of a chain that stands for it where no band of heights is known


@dataclasses.dataclass(frozen=True)
class Chain:
    """Sections of one stalk.

    Attributes:
        sections: Boxes and axes [N, 6] float32, from the top down; bands may be missing between two.
        scores: [N] float32.
    """

    sections: np.ndarray
    scores: np.ndarray

    @property
    def score(self) -> float:
        """Score of the chain, 0 to 1."""
        return float(1.0 - np.sqrt(np.prod(1.0 - np.clip(self.scores.astype(np.float64), 0.0, 1.0))))

    @property
    def widths(self) -> np.ndarray:
        """Horizontal widths [N] of the sections, without the shift of their axes, pixels."""
        return _widths(self.sections)


def link(sections: np.ndarray, scores: np.ndarray, section: int) -> list[Chain]:
    """Link the sections of an image to chains.

    Args:
        sections: Boxes and axes [N, 6], whose tops are multiples of ``section``.
        scores: Scores [N]; sections below 0.1 are ignored.
        section: Height of a band, pixels.
    """
    used = scores >= _MIN_SCORE
    sections, scores = sections[used], scores[used]
    bands = np.round(sections[:, 1] / section).astype(int)
    above, below = np.full(len(sections), -1), np.full(len(sections), -1)  # neighbours of each section
    wide = _widths(sections)
    for reach in range(1, _REACH + 1):
        upper, lower = np.nonzero(bands[:, None] + reach == bands[None, :])
        apart = _distances(sections[upper], sections[lower], wide[upper], wide[lower], (reach - 1) * section)
        order = np.argsort(apart, kind="stable")
        for place in order[: np.count_nonzero(np.isfinite(apart))]:
            one, other = upper[place], lower[place]
            if below[one] < 0 and above[other] < 0:
                below[one], above[other] = other, one
    chains = []
    for first in np.flatnonzero(above < 0):
        places = [first]
        while below[places[-1]] >= 0:
            places.append(below[places[-1]])
        chains.append(Chain(sections[places], scores[places]))
    return chains


def _widths(sections: np.ndarray) -> np.ndarray:
    wide = sections[:, 2] - sections[:, 0]
    return np.maximum(wide - np.abs(sections[:, 5] - sections[:, 4]), 0.1 * wide)


def _distances(upper: np.ndarray, lower: np.ndarray, upper_wide: np.ndarray, lower_wide: np.ndarray, gap: float) -> np.ndarray:
    """Compute the cost [K] of linking pairs of sections [K, 6] with ``gap`` pixels in between; infinite if impossible.

    The cost is the distance of their extrapolated axes in mean widths, plus half the log ratio of the widths.
    """
    tall = upper[:, 3] - upper[:, 1]
    slopes = [(part[:, 5] - part[:, 4]) / tall for part in (upper, lower)]
    # Both axes are extrapolated to the middle between the sections.
    beside = np.abs(upper[:, 5] + 0.5 * gap * slopes[0] - lower[:, 4] + 0.5 * gap * slopes[1])
    beside = beside / np.maximum(0.5 * (upper_wide + lower_wide), 4.0)
    other = np.abs(np.log(np.maximum(upper_wide, 1e-3) / np.maximum(lower_wide, 1e-3)))
    over = np.abs(0.5 * (lower[:, 4:].sum(1) - upper[:, 4:].sum(1))) / (tall + gap)
    possible = (beside <= _BESIDE) & (other <= _WIDTHS) & (over <= _SLOPE)
    return np.where(possible, beside + 0.5 * other, np.inf)


def cut_chain(chain: Chain, top: float, bottom: float) -> np.ndarray:
    """Cut a chain to the rows from ``top`` to ``bottom``: box and axis [6] float32.

    The axis is interpolated, or extrapolated by the slope of the outermost sections.
    """
    sections = chain.sections.astype(np.float64)
    rows = np.stack([sections[:, 1], sections[:, 3]], axis=1).reshape(-1)
    columns = sections[:, 4:].reshape(-1)
    # Two sections that meet have two columns there: their mean.
    rows, places = np.unique(rows, return_inverse=True)
    columns = np.bincount(places, columns) / np.bincount(places)
    middle = 0.5 * (sections[:, 1] + sections[:, 3])
    inner = rows[(rows > top) & (rows < bottom)]
    at = np.concatenate([[top], inner, [bottom]])
    axis = np.interp(at, rows, columns)
    for place, end, other in ((0, 0, 1), (-1, -1, -2)):
        slope = (columns[end] - columns[other]) / (rows[end] - rows[other])
        beyond = at[place] < rows[0] if end == 0 else at[place] > rows[-1]
        axis[place] = columns[end] + slope * (at[place] - rows[end]) if beyond else axis[place]
    half = 0.5 * np.interp(at, middle, chain.widths)
    return np.array([(axis - half).min(), top, (axis + half).max(), bottom, axis[0], axis[-1]], np.float32)


def covered_fraction(chain: Chain, top: float, bottom: float) -> float:
    """Return the fraction of the rows from ``top`` to ``bottom`` that the sections of a chain cover."""
    low, high = np.maximum(chain.sections[:, 1], top), np.minimum(chain.sections[:, 3], bottom)
    return float(np.maximum(high - low, 0.0).sum() / max(bottom - top, 1e-6))


def best_rows(chain: Chain) -> tuple[float, float]:
    """Return top and bottom of the part of a chain, up to four sections, with the highest sum of scores."""
    count = min(_RANGE, len(chain.scores))
    sums = np.convolve(chain.scores, np.ones(count), "valid")
    first = int(np.argmax(sums))
    return float(chain.sections[first, 1]), float(chain.sections[first + count - 1, 3])
