"""Requests for figures, and the content of figures."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxrl_vis.studies.engine.study import Scope, Study
from jaxrl_vis.studies.figures.drawing import Picture


@dataclasses.dataclass(frozen=True)
class Request:
    """Request for a figure.

    Attributes:
        figure: Name of the figure.
        study: Study of the figure.
        out: Path of the image; the tables are written beside it.
        runs: Folder of the run folders.
        tasks: Environments; empty: those of the study.
        variants: Names of variants of its family; empty: those of the study.
        scope: Scope of the runs.
        draw_only: Train nothing: draw existing runs, including those with other settings, which are noted.
        seconds: Time after which training stops.
        per_device: Parallel runs per device.
    """

    figure: str
    study: Study
    out: Path
    runs: Path
    tasks: tuple[str, ...] = ()
    variants: tuple[str, ...] = ()
    scope: Scope = Scope()
    draw_only: bool = False
    seconds: float | None = None
    per_device: int = 1


@dataclasses.dataclass(frozen=True)
class FigureContent:
    """Content of a figure.

    Attributes:
        pictures: Images to draw.
        text: Tables, as lines of Markdown.
        rows: The same tables as rows of data.
        notes: Sentences below the tables.
        title: Replacement of the study's title, if the selected lines need another one.
    """

    pictures: Sequence[Picture]
    text: Sequence[str]
    rows: Sequence[Mapping[str, Any]]
    notes: Sequence[str]
    title: str = ""
