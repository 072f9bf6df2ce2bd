"""Timestamps in file names, and pairing of images whose times differ slightly."""

import re
import statistics
from collections.abc import Mapping

_WHOLE = re.compile(r"(?:^|[^\d.])(\d{10}|\d{13}|\d{16}|\d{19})$")  # s, ms, us, ns since 1970
_PARTS = re.compile(r"(?:^|[^\d.])(\d{1,10}\.\d{2,9})$")
_SPLIT = re.compile(r"(?:^|[^\d.])(\d{10})[_-](\d{9})$")  # seconds and nanoseconds, as separated by rosbag's tools
_UNIT_BY_DIGITS = {10: 1.0, 13: 1e-3, 16: 1e-6, 19: 1e-9}


def parse_timestamp(stem: str) -> float | None:
    """Return the time in s at the end of a file name's stem; None if there is none.

    A float64 resolves 0.2 microseconds in a number of seconds since 1970.
    """
    split = _SPLIT.search(stem)
    if split is not None:
        return int(split[1]) + int(split[2]) * 1e-9
    parts = _PARTS.search(stem)
    if parts is not None:
        return float(parts[1])
    stamp = _WHOLE.search(stem)
    return None if stamp is None else int(stamp[1]) * _UNIT_BY_DIGITS[len(stamp[1])]


def match_nearest(left: Mapping[str, float], right: Mapping[str, float]) -> dict[str, str]:
    """Match left to right names by time: mutual nearest neighbours, at most half the median interval apart.

    Args:
        left, right: Times by name, s. The smaller of the median intervals of the two sides counts.

    Returns:
        Left name -> right name; names without a partner are missing.
    """
    if not left or not right:
        return {}
    reach = min(_median_interval(list(times.values())) for times in (left, right)) / 2
    there = _find_nearest(left, right)
    back = _find_nearest(right, left)
    return {name: other for name, other in there.items() if back[other] == name and abs(left[name] - right[other]) <= reach}


def _find_nearest(names: Mapping[str, float], others: Mapping[str, float]) -> dict[str, str]:
    ordered = sorted(others.items(), key=lambda item: item[1])
    matched, place = {}, 0
    for name, time in sorted(names.items(), key=lambda item: item[1]):
        while place + 1 < len(ordered) and abs(ordered[place + 1][1] - time) <= abs(ordered[place][1] - time):
            place += 1
        matched[name] = ordered[place][0]
    return matched


def _median_interval(times: list[float]) -> float:
    """Return the median interval between images, s; 0.1 s if there is only one."""
    ordered = sorted(times)
    return statistics.median(b - a for a, b in zip(ordered, ordered[1:])) if len(ordered) > 1 else 0.1
