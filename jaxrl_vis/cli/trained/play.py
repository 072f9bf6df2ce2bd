"""Command ``jaxrl-vis play``: show episodes of a policy as a video, or live."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from jaxrl_vis.cli.checks import check_counts, check_run, may_run_code, read_checkpoint
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.cli.trained.options import CheckpointOption, TrustOption
from jaxrl_vis.errors import RequestError
from jaxrl_vis.run.trained.shipped import output_folder


@dataclasses.dataclass(frozen=True)
class Play(TrustOption, CheckpointOption):
    """Make a video of a trained run, with each observation beside the goal."""

    run_dir: Annotated[Path, AlsoPositional()]
    """The run folder, or the name of a policy that comes with the package, such as fetch."""
    out: Path | None = None
    """A .gif, .mp4 or .html file, or a .png of some steps; play.gif (play.html with --html, play_aux.gif with --aux, live.gif
    with --live) in the run folder if not given (for a policy of the package, in NAME/ in the current folder)."""
    html: bool = False
    """Write a page with a three-dimensional view of robot and goal in brax's viewer (needs brax; the page needs a network)."""
    live: bool = False
    """Serve a local page that shows the policy live, with a draggable goal (needs the extra live). --out names recordings."""
    aux: bool = False
    """Also show the predictions of auxiliary tasks: reconstruction, true and predicted optical flow, rotated image."""
    episodes: int = 6
    """Number of episodes to show; unused with --live."""


def run(options: Play) -> int:
    """Write the video of a run's episodes, or serve the live page."""
    run_dir = check_run(options.run_dir)
    check_counts(episodes=options.episodes)
    checkpoint = read_checkpoint(options.checkpoint)
    if options.html and options.aux:
        raise RequestError("--html shows the robot, --aux its images: give one of them")
    if options.live and (options.html or options.aux):
        raise RequestError(f"--live is a page of its own: leave out --{'html' if options.html else 'aux'}")
    trust = may_run_code(run_dir, options.trust)
    if options.live:
        return _play_live(run_dir, options, checkpoint, trust)
    out = options.out or output_folder(run_dir) / (
        "play.html" if options.html else "play_aux.gif" if options.aux else "play.gif"
    )
    from jaxrl_vis.run.trained import play_auxiliary, restored_run

    if options.aux:
        play_auxiliary.play_auxiliary(run_dir, out, episodes=options.episodes, trust=trust, checkpoint=checkpoint)
    else:
        restored_run.play_run(
            run_dir,
            out,
            episodes=options.episodes,
            three_dimensional=options.html,
            cache_programs=True,
            trust=trust,
            checkpoint=checkpoint,
        )
    print(out)
    return 0


def _play_live(run_dir: Path, options: Play, checkpoint: int | Literal["best"] | None, trust: bool) -> int:
    """Serve the page of a policy until Ctrl-C."""
    from jaxrl_vis.report import videos
    from jaxrl_vis.run.trained import live
    from jaxrl_vis.run.trained.policy import load_policy

    live.require()
    out = options.out or output_folder(run_dir) / "live.gif"
    videos.check_output(out)
    live.play_live(load_policy(run_dir, checkpoint=checkpoint, trust=trust), run_dir.resolve().name, out)
    return 0
