"""``jaxrl-vis envs``."""

import dataclasses
from pathlib import Path

from jaxrl_vis.cli.checks import check_counts, check_env


@dataclasses.dataclass(frozen=True)
class Envs:
    """List the environments.

    chance is the share of episodes that random actions end in success, difficulty the mean distance from start to goal in
    thresholds.
    """

    env: tuple[str, ...] = ()
    """Only these environments; all if not given."""
    gallery: Path | None = None
    """Also draw the environments that show images, to this file: start and goals as colours, depth and geoms."""
    image_size: int = 128
    """Height and width of the gallery's images, in pixels."""
    goals: int = 4
    """Goals of each environment in the gallery."""


def run(options: Envs) -> int:
    """Prints the table of environments, and draws the gallery."""
    for name in options.env:
        check_env(name)
    check_counts(goals=options.goals, image_size=options.image_size)
    from jaxrl_vis.report import gallery

    names = options.env or None
    if options.gallery is not None:
        gallery.check_gallery(options.gallery, names)
    gallery.print_table(names)
    if options.gallery is not None:
        gallery.draw(options.gallery, names, options.image_size, options.goals)
        print(options.gallery)
    return 0
