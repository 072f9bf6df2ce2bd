"""``jaxrl-vis doctor``."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Doctor:
    """Check this installation: versions, devices, one physics step, one image."""


def run(_: Doctor) -> int:
    """Check the installation; return 1 if something fails."""
    from jaxrl_vis.host import doctor

    return doctor.main()
