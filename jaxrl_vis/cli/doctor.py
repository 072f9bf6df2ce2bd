"""``jaxrl-vis doctor``."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Doctor:
    """Say whether this installation works: versions, devices, one physics step, one image."""


def run(_: Doctor) -> int:
    """Checks the installation; 1 where something fails."""
    from jaxrl_vis import doctor

    return doctor.main()
