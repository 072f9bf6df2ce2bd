"""The figures of chapter 4: ``jaxrl-vis figure 4.4 | 4.5 | 4.6``."""

from pathlib import Path
from typing import Any, Protocol

from jaxrl_vis.cli.checks import check_extra
from jaxrl_vis.devices import check_devices
from jaxrl_vis.errors import RequestError
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.stalks.cli.grasp_synth import painter_of
from jaxrl_vis_envs.documents import read_json

NAMES = ("4.4", "4.5", "4.6")
OPTIONS = ("wind", "video", "evaluation")
"""Options of some of them."""
_MOST_WIND = 100.0  # mm


class FigureOptions(Protocol):
    """The options of the command that are used here."""

    @property
    def seed(self) -> int | None:
        """Of the run, or of the first one."""
        ...

    @property
    def wind(self) -> float:
        """How far stalks sway, mm."""
        ...

    @property
    def video(self) -> Path | None:
        """A file for the video of figure 4.5."""
        ...

    @property
    def evaluation(self) -> Path | None:
        """What ``grasp eval --reach --json`` wrote."""
        ...


def make_figure(name: str, out: Path, options: FigureOptions) -> int:
    """Draws one of them, with the masks of the networks that are shipped.

    Args:
        name: Of `NAMES`.
        out: The file.
        options: Of the command.

    Raises:
        RequestError: An option makes no sense.
    """
    seed = options.seed or 0
    if seed < 0:
        raise RequestError(f"--seed must be at least 0, not {seed}")
    if not 0 <= options.wind <= _MOST_WIND:
        raise RequestError(f"--wind must be from 0 to {_MOST_WIND:g} mm, not {options.wind:g}")
    check_extra(f"figure {name}", "grasping")
    if options.video is not None:
        from jaxrl_vis.report.videos import check_output

        check_writable(options.video, "--video")
        check_output(options.video)
    check_devices()
    if name == "4.6":
        _draw_grasps(out, seed, options)
    else:
        _draw_run(name, out, seed, options)
    print(out)
    return 0


def _draw_run(name: str, out: Path, seed: int, options: FigureOptions) -> None:
    """Figure 4.4 or 4.5."""
    from jaxrl_vis.stalks.grasping.report.perception_figure import draw_figure
    from jaxrl_vis.stalks.grasping.report.reach_figures import draw_reach
    from jaxrl_vis_envs.plants.grasping import GRASPING

    loss = "gan" if name == "4.4" else "segmentation"  # what the thesis shows, and what the commands use
    painter, named = painter_of(None, loss)

    def mask(image: Any, number: int) -> Any:
        return painter(image)

    if name == "4.4":
        draw_figure(out, GRASPING, seed, mask, named)
    else:
        draw_reach(out, GRASPING, seed, mask, options.wind, options.video)
        if options.video is not None:
            print(options.video)


def _draw_grasps(out: Path, seed: int, options: FigureOptions) -> None:
    """Figure 4.6, from an evaluation, or after one."""
    from jaxrl_vis.stalks.cli.grasp_eval import Eval, evaluate
    from jaxrl_vis.stalks.grasping.evaluation import records
    from jaxrl_vis.stalks.grasping.report.reach_figures import RUNS, draw_grasps

    path = options.evaluation or out.with_suffix(".json")
    if options.evaluation is None:
        evaluate(Eval(runs=RUNS, seed=seed, reach=True, wind=(options.wind,), json=path))
    try:
        found = read_json(path)
        shown = [each for each in found["each"] if each["number"] >= seed][:RUNS]
        known = set.intersection(*(set(each["reaches"]) for each in shown))
        family, masks = found["family"], found["masks"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RequestError(
            f"{path} is not what `grasp eval --reach --json` writes, or holds no run from seed {seed}"
        ) from error
    name = str(records.Reaches("again", options.wind))
    if name not in known:
        raise RequestError(
            f"{path} holds no reaches of the kind `{name}`, only {', '.join(sorted(known))}: choose another --wind"
        )
    title = f"Simulated: family {family}, masks: {masks}, {options.wind:g} mm of wind, {len(shown)} runs; the arm looks again."
    draw_grasps(out, shown, name, records.grasp_score(shown, name), title)
