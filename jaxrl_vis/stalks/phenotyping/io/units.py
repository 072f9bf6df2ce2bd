"""Unit of a stereo baseline: that of the calibration chessboard, or the side of one of its squares."""

import re
from pathlib import Path

from jaxrl_vis.errors import RequestError

METRES: dict[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_BASELINES = (0.008, 2.0)  # m: plausible for stereo cameras that look at plants from a robot
_TYPICAL_BASELINES = (0.03, 0.6)  # m: typical
_SQUARES = re.compile(r"(\d{1,6}(?:\.\d{1,6})?) ?(m|cm|mm)")
_OPTION = "--calibration-unit"


def metres_per_unit(unit: str) -> float:
    """Return the length of a unit in metres: m, cm or mm, or the side of a chessboard square, such as 24mm.

    Raises:
        RequestError: The unit is none of these.
    """
    if unit in METRES:
        return METRES[unit]
    side = _SQUARES.fullmatch(unit)
    if side is None or not float(side[1]) > 0:
        raise RequestError(
            f"{_OPTION} must be m, cm or mm, or the side of a square of the chessboard, as 24mm, not {unit[:40]!r}"
        )
    return float(side[1]) * METRES[side[2]]


def baseline_in_metres(path: Path, length: float, unit: str) -> float:
    """Convert a baseline to metres.

    Args:
        path: File of the calibration, for messages.
        length: Baseline, in ``unit``.
        unit: Unit, see `metres_per_unit`.

    Raises:
        RequestError: The baseline is implausible for a stereo pair; the message asks for the unit.
    """
    baseline = length * metres_per_unit(unit)
    if _BASELINES[0] <= baseline <= _BASELINES[1]:
        return baseline
    lengths = {name: length * metres for name, metres in METRES.items()}
    fitting = [name for name in lengths if _TYPICAL_BASELINES[0] <= lengths[name] <= _TYPICAL_BASELINES[1]]
    fitting = fitting or [name for name in lengths if _BASELINES[0] <= lengths[name] <= _BASELINES[1]]
    units = [f"{_OPTION} {name} if the chessboard was measured in {name} ({lengths[name]:.3g} m)" for name in fitting]
    squares = f"{_OPTION} 24mm if it was counted in squares with sides of 24 mm"
    counted = f"{length:g} {unit}" if unit in METRES else f"{length:g} squares of {unit}"
    raise RequestError(f"{path} has a baseline of {counted}, not that of a stereo pair: say {', or '.join([*units, squares])}")
