"""Tables of docs/phenotyping.md: lenses (`benchmarks.stalks.lenses`), and intervals of widths (`phenotype eval --json`)."""

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.ledger.records import RESULTS
from jaxrl_vis.stalks.phenotyping.measure.lens import VALIDATED
from jaxrl_vis_envs.documents import read_json

LENSES = Path("phenotyping") / "lenses.json"


def lens_table(results: Path = RESULTS) -> str | None:
    """Return the table of lenses as Markdown; None without a record."""
    path = results / LENSES
    return lens_rows(read_json(path)["lenses"]) if path.exists() else None


def lens_rows(lenses: dict[str, Any]) -> str:
    """Return a table of lenses as Markdown, from results by focal length factor; see `stalks.lenses.evaluate_row`."""
    reference_errors = lenses.get("1", {"width_errors_mm": {}})["width_errors_mm"]
    lines = [
        "| focal length | pixels per m | view, m | stalk count | detected | false positives | ground detected | widths "
        "| error, mm | difference from x 1, mm | `phenotype run` |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for factor, lens in lenses.items():
        errors = lens["width_errors_mm"]
        differences = [errors[stalk] - reference_errors[stalk] for stalk in errors.keys() & reference_errors.keys()]
        tried = lens["pixels_per_metre"] >= VALIDATED.pixels_per_metre and lens["view_m"] >= VALIDATED.view
        cells = (
            f"x {factor}",
            f"{lens['pixels_per_metre']:.0f}",
            f"{lens['view_m']:.2f}",
            f"{lens['counted']} of {lens['true']}",
            f"{lens['true_positives']} of {lens['visible']}",
            f"{lens['false_positives']}",
            f"{100 * lens['ground_share']:.0f} %",
            f"{len(errors)}",
            f"{np.median(list(errors.values())):+.2f}" if errors else "",
            f"{np.median(differences):+.2f}" if differences and factor != "1" else "",
            "measures" if tried else "refuses",
        )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def coverage_table(results: Path = RESULTS) -> str | None:
    """Return a table of 95 % intervals from the records of `phenotype eval` for both families; None unless both exist."""
    lines = [
        "| family | seeds | widths | coverage | mean absolute error, mm | mean standard error, mm |",
        "|---|---|---|---|---|---|",
    ]
    for family in ("training", "shifted"):
        path = results / "phenotyping" / f"coverage_{family}.json"
        if not path.exists():
            return None
        record = read_json(path)
        seeds = [plot["seed"] for plot in record["each"]]
        errors = [error for plot in record["each"] for error in plot["width_errors_mm"]]
        cells = (
            f"{min(seeds)} to {max(seeds)}",
            f"{record['widths']}",
            f"{100 * record['width_coverage_95']:.0f} %",
            f"{record['width_mae_mm']:.2f}",
            f"{np.mean(errors):.2f}",
        )
        lines.append(f"| {family} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
