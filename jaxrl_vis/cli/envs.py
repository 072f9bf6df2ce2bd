"""Command ``jaxrl-vis envs``: list the tasks, or draw a gallery of them."""

import dataclasses
from pathlib import Path
from typing import Annotated

from jaxrl_vis.cli.checks import check_counts, check_env
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.host.devices import check_devices


@dataclasses.dataclass(frozen=True)
class Envs:
    """List the environments.

    chance is the success rate of random actions, difficulty the mean distance from start to goal in
    thresholds.
    """

    env: Annotated[tuple[str, ...], AlsoPositional()] = ()
    """Only these environments: built in, of an installed package, or module:Name; all of the first two if not given."""
    gallery: Path | None = None
    """Also write a gallery of the environments with images to this file: start and goals as colours, depth and geoms."""
    image_size: int = 128
    """Height and width of the gallery's images, in pixels."""
    goals: int = 4
    """Number of goals per environment in the gallery."""


def run(options: Envs) -> int:
    """Print the table of environments, and draw the gallery."""
    for name in options.env:
        check_env(name)
    check_counts(goals=options.goals, image_size=options.image_size)
    from jaxrl_vis.report import gallery

    check_devices()
    names = tuple(dict.fromkeys(options.env)) or None
    if options.gallery is not None:
        gallery.check_gallery(options.gallery, names)
    gallery.print_table(names)
    if options.gallery is not None:
        gallery.write_gallery(options.gallery, names, options.image_size, options.goals)
        print(options.gallery)
    return 0
