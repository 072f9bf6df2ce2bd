"""Figures 3.4 and 3.5 and Table 3.1 of the thesis, for synthetic plots, from the file written by ``phenotype eval --json``.

Human times are quoted from the thesis, and human measurements are simulated with the standard deviation that it reports. All
figures and tables state this.
"""

from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.host.spreadsheets import to_csv
from jaxrl_vis.stalks.phenotyping.evaluation.scoring import PERSON_SD
from jaxrl_vis_envs.documents import read_json

_INK, _GREY, _GREEN, _ORANGE = "#222222", "#9a9a9a", "#1a7f37", "#d1720c"
_MAX_SHOWN = 60  # stalks in figure 3.5: more would overlap
HUMAN_MINUTES = {"count": (3.33, 3.66), "width": (29.0, 30.0)}
"""Minutes that the first and the second person took for a plot of 33 stalks; quoted from Table 3.1 of the thesis."""
THESIS_SECONDS = 6.5
"""Seconds that the thesis's pipeline took for the same plot; quoted from the same table."""


def read_evaluation(path: Path) -> dict[str, Any]:
    """Read an evaluation of synthetic plots.

    Raises:
        RequestError: The file cannot be read, or was not written by ``phenotype eval --json``.
    """
    try:
        data = read_json(path)
        if data["synthetic"] is not True or not all(
            {"true", "counted", "widths_mm", "pairs"} <= plot.keys() for plot in data["each"]
        ):
            raise ValueError
    except OSError as error:
        raise RequestError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RequestError(f"{path} holds no evaluation: name a file that `jaxrl-vis phenotype eval --json` wrote") from error
    return data


def draw_counts(data: dict[str, Any], out: Path) -> None:
    """Draw figure 3.4, counted against true number of stalks per plot, and write its data beside it as .md and .csv.

    Args:
        data: Result of `read_evaluation`.
        out: File of the figure.

    Raises:
        OSError: A file cannot be written.
    """
    import matplotlib.pyplot as plt

    true = np.array([plot["true"] for plot in data["each"]], float)
    counted = np.array([plot["counted"] for plot in data["each"]], float)
    low, high = min(true.min(), counted.min()) - 2, max(true.max(), counted.max()) + 2
    figure, axis = plt.subplots(figsize=(5.2, 5.0), layout="constrained")
    axis.axline((0, 0), slope=1, color=_GREY, linewidth=1, label="as many as there are")
    axis.plot(true, counted, "o", color=_GREEN, alpha=0.7, label=f"{len(true)} plots")
    if all(plot.get("thesis") for plot in data["each"]):
        thesis = np.array([plot["thesis"]["counted"] for plot in data["each"]], float)
        low, high = min(low, thesis.min() - 2), max(high, thesis.max() + 2)
        axis.plot(
            true, thesis, "s", color=_ORANGE, alpha=0.5, markerfacecolor="none", label="the same, counted as in the thesis"
        )
    r2 = data.get("count_r2")
    text = f"mean absolute error {np.abs(counted - true).mean():.2f} stalks"
    text = text if r2 is None else f"$R^2$ = {r2:.3f} against y = x, {text}"
    axis.set(xlim=(low, high), ylim=(low, high), xlabel="stalks of the plot", ylabel="stalks counted", aspect="equal")
    axis.set_title(f"Synthetic plots, family {data['family']}\n{text}", fontsize=10)
    axis.legend(frameon=False)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=150)
    plt.close(figure)
    rows = [{"seed": plot["seed"], "true": plot["true"], "counted": plot["counted"]} for plot in data["each"]]
    _write_tables(out, "Counts of synthetic plots; the thesis reports an R^2 of 0.88 in the field.", rows)


def draw_widths(data: dict[str, Any], out: Path) -> None:
    """Draw figure 3.5, widths by two simulated people and by the cameras per stalk, and write its data as .md and .csv.

    Args:
        data: Result of `read_evaluation`.
        out: File of the figure.

    Raises:
        RequestError: No width was measured.
        OSError: A file cannot be written.
    """
    import matplotlib.pyplot as plt

    pairs = np.array([pair for plot in data["each"] for pair in plot["widths_mm"]], float).reshape(-1, 2)
    if not len(pairs):
        raise RequestError("no stalk was measured and identified: evaluate more plots, or larger images")
    measured, true = pairs.T
    people = true[:, None] + np.random.default_rng(0).normal(0.0, PERSON_SD, (len(true), 2))
    error, between = np.abs(measured - people.mean(axis=1)).mean(), np.abs(people[:, 0] - people[:, 1]).mean()
    shown = np.linspace(0, len(true) - 1, min(len(true), _MAX_SHOWN)).round().astype(int)
    shown = shown[np.argsort(true[shown])]
    figure, axis = plt.subplots(figsize=(9.0, 4.4), layout="constrained")
    place = np.arange(len(shown))
    for number, marker in enumerate(("^", "v")):
        label = f"person {number + 1} (simulated, sd {PERSON_SD} mm)"
        axis.plot(place, people[shown, number], marker, color=_ORANGE, alpha=0.55, markersize=5, label=label)
    axis.plot(place, true[shown], "_", color=_INK, markersize=10, label="true")
    axis.plot(place, measured[shown], "o", color=_GREEN, markersize=5, label="by the cameras")
    axis.set(xlabel="stalks, the thinnest first", ylabel="diameter at 12 inches, mm", ylim=(0, None), xticks=[])
    text = f"mean absolute error {np.abs(measured - true).mean():.2f} mm against the truth, {error:.2f} mm against both people"
    axis.set_title(
        f"Synthetic plots, family {data['family']}, {len(true)} stalks, {len(shown)} of them shown\n{text}", fontsize=10
    )
    axis.legend(frameon=False, ncols=4, fontsize=9, loc="lower right")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=150)
    plt.close(figure)
    rows = [
        {"measured_mm": f"{m:.3f}", "true_mm": f"{t:.3f}", "person_1_mm": f"{a:.3f}", "person_2_mm": f"{b:.3f}"}
        for (m, t), (a, b) in zip(pairs, people)
    ]
    note = f"Widths on synthetic plots. People are simulated; they differ by {between:.2f} mm (thesis: 1.639 mm in the field)."
    _write_tables(out, note, rows)


def write_times(data: dict[str, Any], out: Path) -> None:
    """Write table 3.1: times per plot of two people and of the thesis's robot, quoted, and ours.

    Args:
        data: Result of `read_evaluation`.
        out: File of the table, .md; a .csv is written beside it.

    Raises:
        RequestError: The evaluation holds no times.
        OSError: A file cannot be written.
    """
    known = [plot for plot in data["each"] if plot.get("seconds_per_pair")]
    if not known:
        raise RequestError("the evaluation holds no times: plots need at least two pairs")
    seconds = float(np.mean([plot["seconds_per_pair"] * plot["pairs"] for plot in known]))
    (count_1, count_2), (width_1, width_2) = HUMAN_MINUTES["count"], HUMAN_MINUTES["width"]

    def row(task: str, first: float, second: float, measured: str, thesis: str) -> dict[str, str]:
        quoted = {"person 1, quoted": f"{first:.2f} min", "person 2, quoted": f"{second:.2f} min"}
        return {"": task, **quoted, "thesis's robot, quoted": thesis, "here, measured": measured}

    rows = [
        row("stalk count", count_1, count_2, "", ""),
        row("stalk width", width_1, width_2, "", ""),
        row("total", count_1 + width_1, count_2 + width_2, f"{seconds:.1f} s", f"{THESIS_SECONDS} s"),
    ]
    pairs = float(np.mean([plot["pairs"] for plot in known]))
    device = known[0].get("device", "a device that is not known")
    side_by_side = max(plot.get("workers", 1) for plot in known)
    shared = f", {side_by_side} plots at a time, which makes each slower" if side_by_side > 1 else ""
    people = 30.0 * (count_1 + width_1 + count_2 + width_2)
    note = (
        f"Time for one plot. People and the thesis's robot: quoted from Table 3.1 of the thesis, 33 stalks in the field. Here: "
        f"synthetic plots of {pairs:.0f} pairs on {device}{shared}, from images in memory, counts and widths in one go: "
        f"{people / seconds:.0f} times faster than people."
    )
    _write_tables(out, note, rows)


def _write_tables(out: Path, note: str, rows: list[dict[str, Any]]) -> None:
    """Write rows, with a note above, as .md and (without the note) as .csv beside a figure."""
    columns = list(rows[0])
    lines = [note, "", "| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(str(row[column]) for column in columns) + " |" for row in rows]
    write_atomically(out.with_suffix(".md"), "\n".join(lines) + "\n")
    write_atomically(out.with_suffix(".csv"), to_csv(rows))
