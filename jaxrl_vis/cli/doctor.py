"""Command ``jaxrl-vis doctor``: check the installation and the machine."""

import dataclasses
from pathlib import Path


@dataclasses.dataclass(frozen=True)
class Doctor:
    """Check this installation: versions, devices, one physics step, one image."""

    report: Path | None = None
    """Also train the smallest preset, and write what ran on which machine into this .json file or existing folder."""


def run(options: Doctor) -> int:
    """Check the installation; return the exit status of `doctor.main`."""
    if options.report is None:
        from jaxrl_vis.host import doctor

        return doctor.main()
    from jaxrl_vis.host import platform_report
    from jaxrl_vis.report.outputs import check_writable

    check_writable(options.report, "--report", folder=options.report.is_dir())
    return platform_report.report(options.report)
