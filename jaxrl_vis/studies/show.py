"""What is asked of a figure, and what it is made of."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxrl_vis.studies.drawing import Picture
from jaxrl_vis.studies.study import Scope, Study


@dataclasses.dataclass(frozen=True)
class Request:
    """A figure that is asked for.

    Attributes:
        figure: Its name.
        study: What it shows.
        out: The picture; the tables go beside it.
        runs: The folder of run folders.
        tasks: Environments; none: those of the study.
        variants: Names of its family's variants; none: those of the study.
        scope: How it is run.
        draw_only: Train nothing: draw what is there, also runs of other settings, and say which those are.
        seconds: Stop training after so long.
        per_device: Runs side by side on each device.
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
class Shown:
    """What a figure says.

    Attributes:
        pictures: To draw.
        text: Lines of Markdown: its tables.
        rows: The same to compute with.
        notes: Sentences below the tables.
        title: In the place of the study's, where the lines that were asked for need another one.
    """

    pictures: Sequence[Picture]
    text: Sequence[str]
    rows: Sequence[Mapping[str, Any]]
    notes: Sequence[str]
    title: str = ""
