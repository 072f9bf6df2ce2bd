"""``jaxrl-vis grasp figure``: the figures of chapter 4."""

import dataclasses
from pathlib import Path
from typing import ClassVar

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices
from jaxrl_vis.report.outputs import check_figure, check_writable
from jaxrl_vis.stalks.cli.grasp_eval import Eval, check_wind, evaluate
from jaxrl_vis.stalks.cli.options import check_extra


@dataclasses.dataclass(frozen=True, kw_only=True)
class _FigureOptions:
    """Options common to all figures."""

    name: ClassVar[str]

    out: Path | None = None
    """A .png, .pdf or .svg file; figure_FIGURE.png in the current folder if not given."""
    seed: int = 0
    """Seed of the run, or of the first run."""

    def check(self) -> Path:
        """Check the options, packages and devices, and return the file of the figure.

        Raises:
            RequestError: An option is invalid, a package is missing, or no device works.
        """
        if self.seed < 0:
            raise RequestError(f"--seed must be at least 0, not {self.seed}")
        out = self.out or Path(f"figure_{self.name}.png")
        check_figure(out)
        check_extra("grasping")
        check_devices()
        return out


@dataclasses.dataclass(frozen=True, kw_only=True)
class PerceptionFigure(_FigureOptions):
    """Draw figure 4.4: from a stereo pair of a synthetic run to grasp points."""

    name: ClassVar[str] = "4.4"

    weights: Path | None = None
    """Weights of the mask network, from `grasp train`; the shipped segmentation if not given. The thesis shows `--loss gan`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PathFigure(_FigureOptions):
    """Draw figure 4.5: planned and actual path of the gripper to a stalk of a synthetic run."""

    name: ClassVar[str] = "4.5"

    wind: float = 10.0
    """Amplitude of the stalks' sway in the wind, mm."""
    video: Path | None = None
    """Video of all reaches of the run: a .gif, .mp4 or .html file."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GraspsFigure(_FigureOptions):
    """Draw figure 4.6: grasp attempts and successes in 16 runs of half a metre."""

    name: ClassVar[str] = "4.6"

    wind: float = 10.0
    """Amplitude of the stalks' sway in the wind, mm."""
    evaluation: Path | None = None
    """File written by `grasp eval --reach --json`; if not given, runs are evaluated first, and the file is written beside the
    figure."""


def draw_perception(options: PerceptionFigure) -> int:
    """Draw figure 4.4, and return the exit status.

    Raises:
        RequestError: An option or the file of weights is invalid, a package is missing, or no device works.
    """
    out = options.check()
    from jaxrl_vis.stalks.grasping.masks.loading import load_painter, resolve_weights
    from jaxrl_vis.stalks.grasping.report.perception_figure import draw_figure
    from jaxrl_vis_envs.plants.grasping import GRASPING

    weights, name = resolve_weights(options.weights, "segmentation")
    painter = load_painter(weights)
    draw_figure(out, GRASPING, options.seed, lambda image, _: painter(image), name)
    print(out)
    return 0


def draw_path(options: PathFigure) -> int:
    """Draw figure 4.5, optionally with a video, and return the exit status.

    Raises:
        RequestError: An option is invalid, a package is missing, or no device works.
    """
    check_wind(options.wind)
    if options.video is not None:
        from jaxrl_vis.report.videos import check_output

        check_writable(options.video, "--video")
        check_output(options.video)
    out = options.check()
    from jaxrl_vis.stalks.grasping.masks.loading import load_painter, resolve_weights
    from jaxrl_vis.stalks.grasping.report.reach_figures import draw_reach
    from jaxrl_vis_envs.plants.grasping import GRASPING

    painter = load_painter(resolve_weights(None, "segmentation")[0])
    draw_reach(out, GRASPING, options.seed, lambda image, _: painter(image), options.wind, options.video)
    if options.video is not None:
        print(options.video)
    print(out)
    return 0


def draw_grasps(options: GraspsFigure) -> int:
    """Draw figure 4.6 from an evaluation, which is run first if none is given, and return the exit status.

    Raises:
        RequestError: An option or the evaluation is invalid, a package is missing, or no device works.
    """
    check_wind(options.wind)
    out = options.check()
    from jaxrl_vis.stalks.grasping.report import reach_figures

    path = options.evaluation or out.with_suffix(".json")
    if options.evaluation is None:
        evaluate(Eval(runs=reach_figures.RUNS, seed=options.seed, reach=True, wind=(options.wind,), json=path))
    reach_figures.draw_evaluation(out, path, options.seed, options.wind)
    print(out)
    return 0
