"""Families of synthetic plants, as the options of a command name them."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol

from jaxrl_vis.errors import RequestError

if TYPE_CHECKING:
    from jaxrl_vis_envs.plants import Family


class FamilyOptions(Protocol):
    """The options of a command that say what plants are drawn from."""

    @property
    def family(self) -> str | None:
        """Name of a family."""
        ...

    @property
    def shift(self) -> tuple[str, ...]:
        """Factors of the family that are shifted."""
        ...

    @property
    def spec(self) -> Path | None:
        """File with a family of its own."""
        ...

    @property
    def frames(self) -> int | None:
        """Pairs of a plot."""
        ...

    @property
    def width(self) -> int | None:
        """Width of an image, pixels."""
        ...


def family_of(options: FamilyOptions, purpose: Literal["phenotyping", "grasping"], default: str = "training") -> Family:
    """The family that the options ask for.

    Args:
        options: Of a command.
        purpose: Whose families ``--family`` names.
        default: The one that is meant where neither ``--family`` nor ``--spec`` is given.

    Raises:
        RequestError: They contradict each other, or the file of a family does not make sense.
    """
    from jaxrl_vis_envs.plants import FAMILIES, read, shift
    from jaxrl_vis_envs.plants.grasping import GRASPING_FAMILIES

    families = FAMILIES if purpose == "phenotyping" else GRASPING_FAMILIES
    if options.spec is not None and (options.shift or options.family not in (None, "training")):
        raise RequestError("--spec describes the whole family: leave out --family and --shift")
    try:
        family = families[options.family or default] if options.spec is None else read(options.spec, families)
        if options.shift:
            family = shift(family, *options.shift)
        if options.width is not None:
            family = family.at_width(options.width)
        if options.frames is not None:
            family = dataclasses.replace(family, rig=dataclasses.replace(family.rig, frames=options.frames))
    except ValueError as error:
        raise RequestError(str(error)) from error
    return family
