"""``jaxrl-vis figure``."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxrl_vis.devices import check_devices
from jaxrl_vis.errors import RequestError
from jaxrl_vis.report.outputs import check_writable

FigureName = Literal["quadratic"]
SUFFIXES = (".png", ".pdf", ".svg")


@dataclasses.dataclass(frozen=True)
class Figure:
    """Draw a figure: compute what it shows, and write it to a file.

    quadratic: adaptive weights of auxiliary losses on three losses of a point in the plane.
    """

    figure: Annotated[FigureName, tyro.conf.Positional]
    """Which figure."""
    out: Path | None = None
    """A .png, .pdf or .svg file; FIGURE.png in the current folder if not given."""


def run(options: Figure) -> int:
    """Draws one figure."""
    out = options.out or Path(f"{options.figure}.png")
    if out.suffix.lower() not in SUFFIXES:
        raise RequestError(f"--out {out}: a figure is a file that ends in {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
    check_writable(out, "--out")
    from jaxrl_vis.studies import quadratic

    check_devices()
    quadratic.draw(out)
    print(out)
    return 0
