"""Times in names of files, as robots write them, and pairs of images whose times differ a little."""

import re
import statistics
from collections.abc import Mapping

_WHOLE = re.compile(r"(?:^|[^\d.])(\d{10}|\d{13}|\d{16}|\d{19})$")  # s, ms, us, ns since 1970
_PARTS = re.compile(r"(?:^|[^\d.])(\d{1,10}\.\d{2,9})$")
_SPLIT = re.compile(r"(?:^|[^\d.])(\d{10})[_-](\d{9})$")  # seconds and nanoseconds, as rosbag's tools part them
_DIGITS = {10: 1.0, 13: 1e-3, 16: 1e-6, 19: 1e-9}


def seconds_in(stem: str) -> float | None:
    """Seconds that the stem of a file's name ends with; None where it does not say a time.

    Of seconds since 1970, a float64 keeps 0.2 microseconds.
    """
    split = _SPLIT.search(stem)
    if split is not None:
        return int(split[1]) + int(split[2]) * 1e-9
    parts = _PARTS.search(stem)
    if parts is not None:
        return float(parts[1])
    whole = _WHOLE.search(stem)
    return None if whole is None else int(whole[1]) * _DIGITS[len(whole[1])]


def nearest(left: Mapping[str, float], right: Mapping[str, float]) -> dict[str, str]:
    """Names on the left with those on the right whose time is nearest, where each is the other's nearest.

    Args:
        left, right: Times by name, s. What is further apart than half of the usual interval on either side has no partner.
    """
    if not left or not right:
        return {}
    reach = min(_interval(list(times.values())) for times in (left, right)) / 2
    there = _nearest_of(left, right)
    back = _nearest_of(right, left)
    return {name: other for name, other in there.items() if back[other] == name and abs(left[name] - right[other]) <= reach}


def _nearest_of(names: Mapping[str, float], others: Mapping[str, float]) -> dict[str, str]:
    ordered = sorted(others.items(), key=lambda item: item[1])
    found, place = {}, 0
    for name, time in sorted(names.items(), key=lambda item: item[1]):
        while place + 1 < len(ordered) and abs(ordered[place + 1][1] - time) <= abs(ordered[place][1] - time):
            place += 1
        found[name] = ordered[place][0]
    return found


def _interval(times: list[float]) -> float:
    """The usual time between two images, s; a tenth of a second where there is but one."""
    ordered = sorted(times)
    return statistics.median(b - a for a, b in zip(ordered, ordered[1:])) if len(ordered) > 1 else 0.1
