"""``jaxrl-vis play``."""

import dataclasses
from pathlib import Path
from typing import Annotated

from jaxrl_vis.cli.checks import check_counts, check_run
from jaxrl_vis.cli.parsing import ByPlaceToo


@dataclasses.dataclass(frozen=True)
class Play:
    """Make a video of a trained run: each observation beside the goal."""

    run_dir: Annotated[Path, ByPlaceToo()]
    """The run folder."""
    out: Path | None = None
    """A .gif, .mp4 or .html file; play.gif (play.html with --html) in the run folder if not given."""
    html: bool = False
    """Show the robot and its goal in three dimensions, on a page with brax's viewer (needs brax, and the page a network)."""
    episodes: int = 6
    """Episodes to show."""


def run(options: Play) -> int:
    """Draws a run's episodes."""
    check_run(options.run_dir)
    check_counts(episodes=options.episodes)
    out = options.out or options.run_dir / ("play.html" if options.html else "play.gif")
    from jaxrl_vis.run.trained import play_run

    play_run(options.run_dir, out, episodes=options.episodes, three_dimensional=options.html)
    print(out)
    return 0
