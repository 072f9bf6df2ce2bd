"""Tables of docs/phenotyping.md: lenses (`benchmarks.stalks.lenses`), and intervals of widths (`phenotype eval --json`)."""

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.ledger.records import RESULTS
from jaxrl_vis.stalks.phenotyping.measure.lens import TRIED
from jaxrl_vis_envs.documents import read_json

LENSES = Path("phenotyping") / "lenses.json"


def lens_table(results: Path = RESULTS) -> str | None:
    """Write the table of lenses; None without a record."""
    path = results / LENSES
    return lens_rows(read_json(path)["lenses"]) if path.exists() else None


def lens_rows(lenses: dict[str, Any]) -> str:
    """Format a table of lenses from results by focal length factor; see `benchmarks.stalks.lenses.look`."""
    usual = lenses.get("1", {"errors_mm": {}})["errors_mm"]
    lines = [
        "| focal length | pixels per m | view, m | counted | found | false finds | ground seen | widths | error, mm "
        "| beside x 1, mm | `phenotype run` |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for factor, lens in lenses.items():
        errors = lens["errors_mm"]
        differences = [errors[stalk] - usual[stalk] for stalk in errors.keys() & usual.keys()]
        tried = lens["density"] >= TRIED.pixels_per_metre and lens["view"] >= TRIED.view
        cells = (
            f"x {factor}",
            f"{lens['density']:.0f}",
            f"{lens['view']:.2f}",
            f"{lens['counted']} of {lens['true']}",
            f"{lens['found']} of {lens['clear']}",
            f"{lens['false']}",
            f"{100 * lens['ground']:.0f} %",
            f"{len(errors)}",
            f"{np.median(list(errors.values())):+.2f}" if errors else "",
            f"{np.median(differences):+.2f}" if differences and factor != "1" else "",
            "measures" if tried else "refuses",
        )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def coverage_table(results: Path = RESULTS) -> str | None:
    """Write the table of 95 % intervals from the records of `phenotype eval` for each family; None without both."""
    lines = [
        "| family | seeds | widths | within the interval | mean absolute error, mm | mean standard error, mm |",
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
