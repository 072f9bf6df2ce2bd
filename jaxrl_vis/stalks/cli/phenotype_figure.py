"""The figures of chapter 3: ``jaxrl-vis figure 3.4 | 3.5 | table3.1``."""

from pathlib import Path

from jaxrl_vis.cli.checks import check_extra
from jaxrl_vis.devices import check_devices
from jaxrl_vis.stalks.cli.phenotype_eval import Eval, evaluate

NAMES = ("3.4", "3.5", "table3.1")


def make_figure(name: str, out: Path, evaluation: Path | None, plots: int | None, quick: bool) -> int:
    """Draws one of them.

    Args:
        name: Of `NAMES`.
        out: The picture, or the table; tables go beside it.
        evaluation: What `phenotype eval --json` wrote; if not given, plots are evaluated first, and that file goes beside, too.
        plots: How many; 10 if not given.
        quick: Three small plots.
    """
    check_extra("figures of chapter 3", "phenotyping")
    check_devices()
    from jaxrl_vis.stalks.phenotyping.report import figures

    path = evaluation or out.with_suffix(".json")
    if evaluation is None:
        width, frames = (1055, 8) if quick else (None, None)
        evaluate(Eval(plots=plots or (3 if quick else 10), json=path, width=width, frames=frames))
    data = figures.read_evaluation(path)
    if name == "3.4":
        figures.draw_counts(data, out)
    elif name == "3.5":
        figures.draw_widths(data, out)
    else:
        figures.write_times(data, out)
    print(out)
    return 0
