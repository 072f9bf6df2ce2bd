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
        out: Path of the image; tables are written to the same folder.
        runs: Folder of the run folders.
        tasks: Environments; empty for those of the study.
        variants: Names of variants of its family; empty for those of the study.
        scope: Scope of the runs.
        draw_only: Whether to plot existing runs without training, including runs with other settings, which are noted.
        seconds: Time in seconds after which training stops; None if unlimited.
        per_device: Number of parallel runs per device.
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
        title: Replacement for the study's title; empty to keep it.
    """

    pictures: Sequence[Picture]
    text: Sequence[str]
    rows: Sequence[Mapping[str, Any]]
    notes: Sequence[str]
    title: str = ""
