"""Tables of docs/phenotyping.md: lenses (`benchmarks.stalks.lenses`), widths, families and shifts (`phenotype eval --json`)."""

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
FRESH_FAMILIES = {
    "thick_dry": "`thick_dry`: thick, sparse, dry stalks and more leaves at night",
    "other_rig": "`other_rig`: at night, cameras that are closer and look down, with a longer baseline",
    "sorghum_by_day": "`sorghum_by_day`: dense green rows, rows behind",
}
"""Descriptions by name of the family, and of its record in ``phenotyping/families`` or ``phenotyping/fresh``."""

SHIFTS = {
    "flash": "flash",
    "lean": "lean",
    "rig": "baseline and focal length (`rig`)",
    "noise": "noise",
    "leaves": "leaves",
    "textures": "textures",
}
"""Descriptions by name of the factor that is shifted alone, and of its record in ``phenotyping/shifts``."""


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


def families_table(results: Path = RESULTS) -> str | None:
    """Return a table of the families on which rules were chosen; None without records."""
    return _table_of_families(results / "phenotyping" / "families", FAMILIES)


def fresh_table(results: Path = RESULTS) -> str | None:
    """Return a table of plots and families that no choice depended on; None without records."""
    return _table_of_families(results / "phenotyping" / "fresh", FAMILIES | FRESH_FAMILIES)


def _table_of_families(folder: Path, titles: dict[str, str]) -> str | None:
    """Return a table of the records of `phenotype eval` in a folder, in the order of ``titles``; None without records."""
    lines = [
        "| family | plots | stalks per plot | error of the count (bias, R²) | error of widths, mm (bias) | coverage of 95 % "
        "| F1 (precision, recall) |",
        "|---|---|---|---|---|---|---|",
    ]
    origins = set()
    for family, title in titles.items():
        path = folder / f"{family}.json"
        if not path.exists():
            continue
        record = read_json(path)
        origins |= _origins(record)
        cells = (
            title,
            f"{record['plots']}",
            f"{record['count_true'] / record['plots']:.1f}",
            _count_cell(record),
            _width_cell(record),
            f"{100 * record['width_coverage_95']:.0f} %",
            _f1_cell(record),
        )
        lines.append("| " + " | ".join(cells) + " |")
    if not origins:
        return None
    return "\n".join([*lines, "", origin_sentence([Record("families", (), frozenset(origins))])])


def shifts_table(results: Path = RESULTS) -> str | None:
    """Return a table with a row for each factor of the shifted family by itself; None if a record is missing."""
    folder = results / "phenotyping"
    paths = {
        "none": folder / "families" / "training.json",
        **{title: folder / "shifts" / f"{factor}.json" for factor, title in SHIFTS.items()},
        "all": folder / "families" / "shifted.json",
    }
    if not all(path.exists() for path in paths.values()):
        return None
    lines = [
        "| shifted | error of the count (bias, R²) | error of widths, mm (bias) | AP50 | F1 (precision, recall) |",
        "|---|---|---|---|---|",
    ]
    origins: set[str] = set()
    for title, path in paths.items():
        record = read_json(path)
        origins |= _origins(record)
        cells = title, _count_cell(record), _width_cell(record), f"{record['ap50']:.3f}", _f1_cell(record)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", origin_sentence([Record("shifts", (), frozenset(origins))])])


def thesis_table(results: Path = RESULTS) -> str | None:
    """Return a table of the shifted family, and of the thesis's methods on the same detections; None without records."""
    paths = results / "phenotyping" / "families" / "shifted.json", results / "phenotyping" / "thesis.json"
    if not all(path.exists() for path in paths):
        return None
    many, some = map(read_json, paths)
    lines = [
        f"| | {many['plots']} plots | {some['plots']} of them | the thesis's methods, same detections |",
        "|---|---|---|---|",
    ]
    rows = (
        ("stalks counted, mean absolute error (bias, R²)", _count_cell(many), _count_cell(some), _count_cell(some, "thesis_")),
        ("width at 12 inches, mm", _width_cell(many), _width_cell(some), _width_cell(some, "thesis_width")),
        (
            "the same compared with two people with calipers, like the thesis's scatter",
            *(f"{record['width_mae_two_people_mm']:.2f}" for record in (many, some)),
            "",
        ),
        ("width at 24 inches, mm", _width_cell(many, "width_24in"), _width_cell(some, "width_24in"), ""),
        ("detections: AP at IoU 0.5", f"{many['ap50']:.3f}", f"{some['ap50']:.3f}", ""),
        ("detections: F1 (precision, recall)", _f1_cell(many), _f1_cell(some), ""),
    )
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    origins = frozenset(_origins(many) | _origins(some))
    return "\n".join([*lines, "", origin_sentence([Record("thesis", (), origins)])])


def _count_cell(record: dict[str, Any], prefix: str = "") -> str:
    """Return mean absolute error, bias and R² of the counts of a record of `phenotype eval`."""
    mae, bias, r2 = (record[f"{prefix}count_{name}"] for name in ("mae", "bias", "r2"))
    return f"{mae:.2f} ({100 * bias:+.1f} %, {r2:.3f})"


def _width_cell(record: dict[str, Any], which: str = "width") -> str:
    """Return mean absolute error and bias of the widths of a record, mm."""
    return f"{record[f'{which}_mae_mm']:.2f} ({record[f'{which}_bias_mm']:+.2f})"


def _f1_cell(record: dict[str, Any]) -> str:
    """Return F1, precision and recall of the detections of a record."""
    return f"{record['f1']:.3f} ({record['precision']:.3f}, {record['recall']:.3f})"


def _origins(record: dict[str, Any]) -> set[str]:
    """Return revision and device of each plot of a record."""
    return {f"{(plot['revision'] or 'unknown')[:7]} on {plot['device'].removesuffix(' x1')}" for plot in record["each"]}
