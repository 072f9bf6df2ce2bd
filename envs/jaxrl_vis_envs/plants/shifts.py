"""Families for evaluation under distribution shift: the training family with some or all factors changed. Imports no JAX."""

import dataclasses
from typing import Any

from jaxrl_vis_envs.names import nearest
from jaxrl_vis_envs.plants.family import TRAINING, Family, Textures

_UNSEEN = Textures(
    stalk_hue=(0.045, 0.085),
    leaf_hue=(0.155, 0.195),
    dry_hue=(0.035, 0.065),
    soil_hue=(0.085, 0.11),
    fibre_pitch=(1.6e-3, 2.8e-3),
    fibre_contrast=(0.28, 0.45),
    blotch_size=(0.025, 0.05),
    blotch_contrast=(0.46, 0.6),
    speckles=(0.35, 0.6),
    speckle_size=(1.8e-3, 3.0e-3),
    bands=(0.18, 0.35),
    band_pitch=(0.006, 0.015),
    bloom=(0.0, 0.08),
    gloss=(0.14, 0.25),
)

# Factor -> changes of the training family, by part.
SHIFTS: dict[str, dict[str, dict[str, Any]]] = {
    "flash": {"imaging": {"flash": (0.6, 1.6)}},
    "lean": {"stalks": {"lean_sd": (4.0, 8.0)}},
    "rig": {"rig": {"stated_spread": 0.05, "calibration_error": 0.005}},
    "noise": {"imaging": {"noise": 2.0}},
    "leaves": {"leaves": {"density": 1.3}},
    "textures": {"textures": {field.name: getattr(_UNSEEN, field.name) for field in dataclasses.fields(_UNSEEN)}},
}


def shift(family: Family, *factors: str, name: str = "", stream: int = 0) -> Family:
    """Return a family with some factors shifted.

    Args:
        family: Original family.
        factors: Names in `SHIFTS`.
        name: Name of the result; by default the factors' names.
        stream: Stream of the result; by default, one that depends on the factors and differs from that of ``family``.

    Raises:
        ValueError: There is no such factor.
    """
    for factor in factors:
        if not isinstance(factor, str) or factor not in SHIFTS:
            raise ValueError(f"there is no shift of {factor!r}{nearest(str(factor), SHIFTS)}")
        for part, changes in SHIFTS[factor].items():
            family = dataclasses.replace(family, **{part: dataclasses.replace(getattr(family, part), **changes)})
    factor_bits = sum(1 << list(SHIFTS).index(factor) for factor in set(factors))
    return dataclasses.replace(
        family, name=name or "+".join(factors), stream=stream or 100 + factor_bits + 1000 * family.stream
    )


SHIFTED = shift(TRAINING, *SHIFTS, name="shifted", stream=2)
FAMILIES = {family.name: family for family in (TRAINING, SHIFTED)}
