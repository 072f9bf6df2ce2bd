"""Figures of several runs: one column per task, one line per variant."""

import dataclasses
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from jaxrl_vis.report.plots import FAINT, INK, draw_median, style_curves

_WIDTH, _HEIGHT, _HEADER, _FOOTER = 4.9, 3.5, 0.85, 0.85  # inches: a panel, and the space above and below all panels
_LINE, _LETTERS = 0.17, 14  # subtitle: line spacing in inches, characters per inch
_TITLE_LINE, _TITLE_LETTERS = 0.26, 8.3  # likewise for the title


@dataclasses.dataclass(frozen=True)
class Curve:
    """Line of a panel.

    Attributes:
        label: Label in the legend; lines with the same label share an entry.
        colour: Colour of the line.
        steps: [P] environment steps, or other positions on the panel's x axis.
        values: [S, P], one row per seed, NaN for gaps.
        is_reference: Whether these are published results of others, drawn thin, dashed and behind the others.
    """

    label: str
    colour: str
    steps: np.ndarray
    values: np.ndarray
    is_reference: bool = False


@dataclasses.dataclass(frozen=True)
class Panel:
    """Panel with the lines of one task.

    Attributes:
        title: Title of the panel.
        curves: Lines of the panel.
        is_share: Whether values are fractions in [0, 1], shown in percent.
        x_label: Label of the x axis; shown below the lowest of several panels with the same label.
    """

    title: str
    curves: Sequence[Curve]
    is_share: bool = True
    x_label: str = "environment steps per seed"

    @property
    def has_values(self) -> bool:
        """True if there is any finite value."""
        return any(np.isfinite(curve.values).any() for curve in self.curves)


@dataclasses.dataclass(frozen=True)
class Picture:
    """Image file of a figure.

    Attributes:
        suffix: Suffix appended to the figure's file name.
        rows: Panels, row by row; all rows have the same length.
        subtitle: Addition to the description of the runs in the second line.
    """

    suffix: str
    rows: Sequence[Sequence[Panel]]
    subtitle: str = ""


def draw_panels(path: Path, rows: Sequence[Sequence[Panel]], title: str, subtitle: str) -> None:
    """Compose a figure and write it to a file.

    Args:
        path: Path of the file, .png or any other format that Matplotlib can write.
        rows, title, subtitle: See `compose`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    compose(rows, title, subtitle).savefig(path)


def compose(rows: Sequence[Sequence[Panel]], title: str, subtitle: str) -> Figure:
    """Compose a figure of panels with one legend.

    Args:
        rows: Panels, row by row; all rows have the same length.
        title: Title above the panels, bold; wrapped to the width of the figure, like the subtitle.
        subtitle: Subtitle below the title.
    """
    width = max(7.5, _WIDTH * len(rows[0]))
    titles = textwrap.wrap(title, int((width - 0.7) * _TITLE_LETTERS))
    lines = _break_lines(subtitle, int((width - 0.7) * _LETTERS))
    below = _TITLE_LINE * (len(titles) - 1)  # shift of the subtitle
    labels = {curve.label for row in rows for panel in row for curve in panel.curves}
    longest = max(map(len, labels), default=0)
    columns = max(1, min(len(labels), int(width / max(2.1, 0.55 + 0.068 * longest))))
    header = _HEADER + below + _LINE * (len(lines) - 1)
    footer = _FOOTER + _LINE * max(0, -(-len(labels) // columns) - 2)
    height = _HEIGHT * len(rows) + header + footer
    figure = Figure(figsize=(width, height), dpi=150, facecolor="white")
    grid = figure.subplots(len(rows), len(rows[0]), squeeze=False)
    entries = {}
    for axes, panel in zip(grid.flat, (panel for row in rows for panel in row), strict=True):
        _draw(axes, panel)
        handles, names = axes.get_legend_handles_labels()
        entries |= {name: handle for name, handle in zip(names, handles, strict=True) if name not in entries}
    for row, below_row, all_axes in zip(rows, [*rows[1:], [None] * len(rows[-1])], grid, strict=True):
        for panel, lower, axes in zip(row, below_row, all_axes, strict=True):
            if lower is None or lower.x_label != panel.x_label:
                axes.set_xlabel(panel.x_label, fontsize=9.5, color=INK)
    for number, line in enumerate(titles):
        y = 1 - (0.22 + _TITLE_LINE * number) / height
        figure.text(0.35 / width, y, line, fontsize=14, weight="bold", color=INK, va="center")
    for number, line in enumerate(lines):
        y = 1 - (0.48 + below + _LINE * number) / height
        figure.text(0.35 / width, y, line, fontsize=9, color=FAINT, va="center")
    figure.legend(
        list(entries.values()), list(entries), loc="lower center", ncols=columns, frameon=False, fontsize=9, labelcolor=INK
    )
    left, right = 0.6 / width, 1 - 0.2 / width
    figure.subplots_adjust(
        **{"left": left, "right": right, "bottom": (footer + 0.15) / height, "top": 1 - (header + 0.2) / height},
        **{"wspace": 0.2, "hspace": 0.3},
    )
    return figure


def _break_lines(text: str, max_characters: int) -> list[str]:
    """Break a text after semicolons into lines of at most ``max_characters`` characters, except for longer clauses."""
    lines = [""]
    for clause in text.split("; "):
        longer = f"{lines[-1]}; {clause}" if lines[-1] else clause
        if len(longer) <= max_characters or not lines[-1]:
            lines[-1] = longer
        else:
            lines[-1] += ";"
            lines.append(clause)
    return lines


def _draw(axes: Axes, panel: Panel) -> None:
    ends = [float(curve.steps[-1]) for curve in panel.curves if curve.steps.size and not curve.is_reference]
    end = max(ends, default=1)
    for curve in panel.curves:
        if curve.is_reference:
            style = {"linewidth": 1.3, "linestyle": (0, (4, 2)), "alpha": 0.75, "zorder": 1}
            axes.plot(curve.steps, np.median(curve.values, axis=0), color=curve.colour, label=curve.label, **style)
        else:
            draw_median(axes, curve.steps, curve.values, curve.colour, curve.label)
    if not panel.has_values:
        axes.text(0.5, 0.5, "no values", transform=axes.transAxes, ha="center", fontsize=9.5, color=FAINT)
    style_curves(axes, panel.title)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.set_xlim(0, 1.01 * end)
    if panel.is_share:
        axes.set_ylim(-0.02, 1.03)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    else:
        axes.set_ylim(bottom=0.0)
