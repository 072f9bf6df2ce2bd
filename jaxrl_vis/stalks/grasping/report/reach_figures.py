"""Figures 4.5 and 4.6 of the thesis for simulated runs: planned and actual path; attempts and grasps of 16 runs."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.worker_pool import Record
from jaxrl_vis.report.plots import FAINT, INK
from jaxrl_vis.stalks.grasping.arm.approach import is_within_reach
from jaxrl_vis.stalks.grasping.arm.reach import reach
from jaxrl_vis.stalks.grasping.evaluation.attempts import plan, redetecting_observer, wind_keys
from jaxrl_vis.stalks.grasping.evaluation.grasp_score import Score
from jaxrl_vis.stalks.grasping.evaluation.records import Reaches, attempts_in, grasp_score
from jaxrl_vis.stalks.grasping.evaluation.scoring import draw_scene, score_scene
from jaxrl_vis.stalks.grasping.perception.perceive import Mask
from jaxrl_vis.stalks.grasping.report.path_figure import draw_path
from jaxrl_vis.stalks.grasping.report.video import write_reaches
from jaxrl_vis_envs.documents import read_json
from jaxrl_vis_envs.plants import Family

THESIS_RATIO, CORNBOT_FRACTION = 0.7413, 43 / 48
RUNS = 16
"""Number of runs in figure 4.6, as in the thesis."""
_HELD, _OTHER, _LOST = "#2f855a", "#dd6b20", "#cbd5e0"


def draw_reach(
    out: Path, family: Family, seed: int, mask: Mask | None, wind_mm: float, video: Path | None = None, size: int = 320
) -> None:
    """Draw figure 4.5 of the middle one of a run's attempts that are sent; with ``video``, also render all of these.

    The arm detects the stalks again on the way, see `attempts.redetecting_observer`.

    Args:
        out: Path of the figure.
        family: Family that the row is sampled from.
        seed: Seed of the row and of the wind.
        mask: Function that returns the mask of an image; None for true masks.
        wind_mm: Amplitude of the stalks' sway, mm.
        video: Path of the video, .gif, .mp4 or .html; None for no video.
        size: Height and width of the video's images without their header, px.

    Raises:
        RequestError: The video cannot be written, or the arm is not sent anywhere.
        OSError: A file cannot be written.
    """
    scene = draw_scene(family, seed)
    _, perception = score_scene(scene, mask)
    made = plan(scene, perception, seed)
    sent = np.flatnonzero(~made.refused & is_within_reach(made.stands.origin, made.targets))
    if not len(sent):
        raise RequestError(f"there is nothing that the arm can be sent to in run {seed}: choose another --seed")
    keys = wind_keys(np.full(len(made.targets), seed), np.arange(len(made.targets)))
    look = redetecting_observer(made.stands, made.stalks, made.redetection_errors)
    result = reach(made.stands, made.targets, keys, wind_mm, sides=made.sides, observer=look)
    draw_path(out, made.stands, made.targets, result, int(sent[len(sent) // 2]))
    if video is not None:
        write_reaches(video, made.stands, result, made.stalks.tolist(), sent.tolist(), size)


def draw_evaluation(out: Path, evaluation: Path, seed: int, wind_mm: float) -> None:
    """Draw figure 4.6 from a file written by ``grasp eval --reach --json``, for reaches that detect stalks again on the way.

    Args:
        out: Path of the figure.
        evaluation: Path of the file of records.
        seed: Seed of the first run; up to `RUNS` runs from it are shown.
        wind_mm: Amplitude of the stalks' sway in the wind, mm.

    Raises:
        RequestError: The file cannot be read, has another format, or holds no such runs or reaches.
        OSError: The figure cannot be written.
    """
    try:
        data = read_json(evaluation)
        shown = [record for record in data["each"] if record["number"] >= seed][:RUNS]
        known = set.intersection(*(set(record["reaches"]) for record in shown))
        family, masks = data["family"], data["masks"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RequestError(
            f"{evaluation} is not what `grasp eval --reach --json` writes, or holds no run from seed {seed}"
        ) from error
    name = str(Reaches("again", wind_mm))
    if name not in known:
        raise RequestError(
            f"{evaluation} holds no reaches of the kind `{name}`, only {', '.join(sorted(known))}: choose another --wind"
        )
    title = f"Simulated: family {family}, masks: {masks}, {wind_mm:g} mm of wind, {len(shown)} runs; the arm looks again."
    draw_grasps(out, shown, name, grasp_score(shown, name), title)


def draw_grasps(out: Path, records: Sequence[Record], name: str, score: Score, title: str) -> None:
    """Draw figure 4.6: numbers of stalks, attempts, and single grasps of each run.

    Args:
        out: Path of the figure.
        records: Records of the runs.
        name: Name of the reaches in the records, the string of their `Reaches`.
        score: Score of these reaches.
        title: Description of the simulation, below the heading.

    Raises:
        OSError: The file cannot be written.
    """
    figure = Figure(figsize=(11.0, 5.6), dpi=150, facecolor="white")
    axes = figure.add_axes((0.07, 0.13, 0.58, 0.7))
    x = np.arange(len(records))
    stalks, attempted, alone, others = np.array([_count_outcomes(record, name) for record in records]).T
    axes.bar(x - 0.28, stalks, 0.26, color=_LOST, label="stalks in the half metre")
    axes.bar(x, attempted, 0.26, color="#2b6cb0", label="attempts: the arm was sent")
    axes.bar(x + 0.28, alone, 0.26, color=_HELD, label="grasped: exactly the target held")
    axes.bar(x + 0.28, others, 0.26, bottom=alone, color=_OTHER, label="held in other attempts")
    axes.set(xlabel="run of 0.5 m", ylabel="count", xticks=x, xlim=(-0.6, len(x) - 0.4))
    axes.set_ylim(0, 1.3 * max(stalks.max(initial=1), attempted.max(initial=1)))
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xticklabels([str(record["number"]) for record in records])
    axes.grid(axis="y", alpha=0.25)
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="upper left")
    _draw_proportions(figure, score)
    figure.text(0.03, 0.95, "Attempts and grasps", fontsize=14, weight="bold", color=INK, va="center")
    figure.text(0.03, 0.895, title, fontsize=9, color=FAINT, va="center")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)


def _count_outcomes(record: Record, name: str) -> tuple[int, int, int, int]:
    """Count the stalks of a run, attempts sent, those that hold exactly their target, and stalks held in the others."""
    attempts = [attempt for attempt in attempts_in(record, name) if attempt.sent]
    alone = sum(attempt.outcome == "success" for attempt in attempts)
    return int(record["stalks"]), len(attempts), alone, sum(len(attempt.held) for attempt in attempts) - alone


def _draw_proportions(figure: Figure, score: Score) -> None:
    """Draw the success rates with their intervals, beside those that the thesis and Cornbot report from fields."""
    axes = figure.add_axes((0.76, 0.13, 0.21, 0.7))
    rows = [
        ("attempts:\ntarget held", score.of_sent),
        ("reachable\nwith room", score.with_room),
        ("reachable,\ncrowded", score.crowded),
        ("all stalks", score.of_all),
    ]
    for place, (_, proportion) in enumerate(rows):
        if proportion.total:
            low, high = proportion.interval
            axes.plot([100 * low, 100 * high], [place, place], color=_HELD, linewidth=2)
            axes.plot(100 * proportion.value, place, "o", color=_HELD)
            axes.text(101, place - 0.22, f"{proportion.count} of {proportion.total}", fontsize=7, color=FAINT, ha="right")
    place = len(rows)
    axes.plot(100 * score.thesis_ratio, place, "s", color="#2b6cb0")
    axes.plot(100 * THESIS_RATIO, place + 1, "D", color=_OTHER)
    axes.plot(100 * CORNBOT_FRACTION, place + 2, "D", color=_OTHER)
    names = [name for name, _ in rows] + [
        "thesis's ratio,\nhere",
        "thesis's ratio,\nin its field",
        "Cornbot, in\nmaize: 43 of 48",
    ]
    axes.set(xlim=(0, 104), ylim=(len(names) - 0.5, -0.5), xlabel="%", yticks=range(len(names)))
    axes.set_yticklabels(names, fontsize=8)
    axes.grid(axis="x", alpha=0.25)
    axes.set_title("simulated, and from fields", fontsize=9, color=INK)
