"""``jaxrl-vis phenotype figure``: the figures of chapter 3."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxrl_vis.cli.checks import check_counts
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices
from jaxrl_vis.report.outputs import FIGURE_SUFFIXES, check_writable
from jaxrl_vis.stalks.cli.options import check_extra
from jaxrl_vis.stalks.cli.phenotype_eval import Eval, evaluate


@dataclasses.dataclass(frozen=True)
class Figure:
    """Draw a figure of chapter 3: counts, widths or times on synthetic plots of sorghum, compared with humans."""

    figure: Annotated[Literal["3.4", "3.5", "table3.1"], tyro.conf.Positional]
    """Figure of the thesis: counts (3.4), widths (3.5) or times (table3.1)."""
    out: Path | None = None
    """File of the figure: .png, .pdf or .svg, or .md for table3.1; figure_FIGURE.png or table_3.1.md in the current folder if
    not given. Its data are written beside it as .md and .csv."""
    evaluation: Path | None = None
    """File written by `phenotype eval --json`; if not given, plots are evaluated first, and the file is written beside the
    figure."""
    plots: int | None = None
    """Number of plots to evaluate; if not given, 10, or 3 with --quick. Not with --evaluation."""
    quick: bool = False
    """Evaluate small plots, three of them unless --plots is given; suitable for a CPU. Not with --evaluation."""


def draw(options: Figure) -> int:
    """Draw one figure, or write the table, from an evaluation, which is run first if none is given; return the exit status.

    Raises:
        RequestError: An option or the evaluation is invalid, a package is missing, or no device works.
    """
    is_table = options.figure == "table3.1"
    suffixes = (".md",) if is_table else FIGURE_SUFFIXES
    out = options.out or Path("table_3.1.md" if is_table else f"figure_{options.figure}.png")
    if out.suffix.lower() not in suffixes:
        raise RequestError(f"--out {out}: {options.figure} is a file that ends in {' or '.join(suffixes)}")
    if options.evaluation is not None and (options.plots is not None or options.quick):
        raise RequestError("--evaluation is of plots that are evaluated already: leave out --plots and --quick")
    check_counts(plots=options.plots)
    for file in (out, out.with_suffix(".md"), out.with_suffix(".csv")):
        check_writable(file, "--out")
    check_extra("phenotyping")
    check_devices()
    from jaxrl_vis.stalks.phenotyping.report import figures

    path = options.evaluation or out.with_suffix(".json")
    if options.evaluation is None:
        width, frames = (1055, 8) if options.quick else (None, None)
        evaluate(Eval(plots=options.plots or (3 if options.quick else 10), json=path, width=width, frames=frames))
    data = figures.read_evaluation(path)
    {"3.4": figures.draw_counts, "3.5": figures.draw_widths, "table3.1": figures.write_times}[options.figure](data, out)
    print(out)
    return 0
