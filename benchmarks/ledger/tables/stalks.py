"""Tables of docs/phenotyping.md: lenses (`benchmarks.stalks.lenses`), and widths and families (`phenotype eval --json`)."""

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.claims.markdown import origin_sentence
from benchmarks.claims.records import Record
from benchmarks.ledger.records import RESULTS
from jaxrl_vis.stalks.phenotyping.measure.lens import VALIDATED
from jaxrl_vis_envs.documents import read_json

LENSES = Path("phenotyping") / "lenses.json"
FAMILIES = {
    "training": "`training`: at night, as in training, unseen seeds",
    "shifted": "`shifted`: at night, all factors shifted",
    "thin_wet": "`thin_wet`: thin, crowded, wet sorghum at night",
    "maize_by_day": "`maize_by_day`: green maize, rows behind",
}
"""Description by name of the family, and of its record in ``phenotyping/families``."""


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
    """Return a table of plots that no choice depended on, from the records of `phenotype eval`; None unless both exist."""
    lines = [
        "| family | seeds | error of the count (bias, R²) | error of widths, mm (bias) | coverage of 95 % "
        "| mean standard error, mm | F1 (precision, recall) |",
        "|---|---|---|---|---|---|---|",
    ]
    origins = set()
    for family in ("training", "shifted"):
        path = results / "phenotyping" / f"coverage_{family}.json"
        if not path.exists():
            return None
        record = read_json(path)
        origins |= _origins(record)
        seeds = [plot["seed"] for plot in record["each"]]
        standard_errors = [error for plot in record["each"] for error in plot["width_errors_mm"]]
        count, width, coverage, f1 = _cells(record)
        cells = (f"`{family}`", f"{min(seeds)} to {max(seeds)}", count, width, coverage, f"{np.mean(standard_errors):.2f}", f1)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", origin_sentence([Record("coverage", (), frozenset(origins))])])


def families_table(results: Path = RESULTS) -> str | None:
    """Return a table of the records of `phenotype eval` for several families; None without records."""
    lines = [
        "| family | plots | stalks per plot | error of the count (bias, R²) | error of widths, mm (bias) | coverage of 95 % "
        "| F1 (precision, recall) |",
        "|---|---|---|---|---|---|---|",
    ]
    origins = set()
    for family, title in FAMILIES.items():
        path = results / "phenotyping" / "families" / f"{family}.json"
        if not path.exists():
            continue
        record = read_json(path)
        origins |= _origins(record)
        cells = (title, f"{record['plots']}", f"{record['count_true'] / record['plots']:.1f}", *_cells(record))
        lines.append("| " + " | ".join(cells) + " |")
    if not origins:
        return None
    return "\n".join([*lines, "", origin_sentence([Record("families", (), frozenset(origins))])])


def _cells(record: dict[str, Any]) -> tuple[str, str, str, str]:
    """Return the cells for the counts, widths, coverage and detections of a record of `phenotype eval`."""
    return (
        f"{record['count_mae']:.2f} ({100 * record['count_bias']:+.1f} %, {record['count_r2']:.3f})",
        f"{record['width_mae_mm']:.2f} ({record['width_bias_mm']:+.2f})",
        f"{100 * record['width_coverage_95']:.0f} %",
        f"{record['f1']:.3f} ({record['precision']:.3f}, {record['recall']:.3f})",
    )


def _origins(record: dict[str, Any]) -> set[str]:
    """Return revision and device of each plot of a record."""
    return {f"{(plot['revision'] or 'unknown')[:7]} on {plot['device'].removesuffix(' x1')}" for plot in record["each"]}
