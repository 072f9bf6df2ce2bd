"""Export of the plots' results, joined with the field plan, in formats of breeding software.

plain     traits.csv: names, units and ontology terms of the columns, then one row per plot
brapi     brapi/*.json: variables, observation units and observations, as POST bodies of BrAPI 2.1
miappe    miappe/*.csv: observed variables, observation units and data, in the fields of MIAPPE 1.1
plantcv   plantcv.json: as written by plantcv-run-workflow, for plantcv-utils json2csv
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.host.spreadsheets import to_csv

Format = Literal["plain", "brapi", "miappe", "plantcv"]
Plan = Mapping[str, Mapping[str, str]]
"""Field plan: plot -> column -> value."""


@dataclasses.dataclass(frozen=True)
class Trait:
    """Observed variable, a column of plots.csv: trait, method and scale.

    Attributes:
        column: Name of the column in plots.csv and in all formats.
        trait: Name of the measured trait.
        unit: UCUM unit of the values; ``1`` for counts.
        statistic: Statistic over the stalks of a plot, in words.
        term: Identifier of the trait in an ontology; empty if none is known.
        is_integer: If true, the values are integers.
    """

    column: str
    trait: str
    unit: str
    statistic: str
    term: str = ""
    is_integer: bool = False


# Diameters have the Plant Trait Ontology's term for stem thickness. Stalk numbers have none (docs/phenotyping.md).
_DIAMETER = "TO:0000339"
TRAITS = (
    Trait("stalks", "stalk number", "1", "count in the plot", is_integer=True),
    Trait("stalks_per_m", "stalk number", "1/m", "count per length of row"),
    Trait("width_mean_mm", "stalk diameter", "mm", "mean over stalks, 12 inches above the ground", _DIAMETER),
    Trait("width_sd_mm", "stalk diameter", "mm", "standard deviation over stalks, 12 inches above the ground", _DIAMETER),
    Trait("width_se_mm", "stalk diameter", "mm", "standard error of the mean, 12 inches above the ground", _DIAMETER),
    Trait("width_24in_mean_mm", "stalk diameter", "mm", "mean over stalks, 24 inches above the ground", _DIAMETER),
    Trait("taper_mean_mm_per_in", "stalk taper", "mm/[in_i]", "mean over stalks, from 12 to 24 inches above the ground"),
    Trait("length_m", "row length", "m", "distance travelled by the robot along the row"),
    Trait("stalks_measured", "stalk number", "1", "count of the stalks whose diameter was measured", is_integer=True),
)
_ABOUT = ("flag", "method", "version")
"""Columns of plots.csv that describe the values in the same row."""
_METHOD = "stereo images of a robot that drives along the row; stalks found and outlined by networks (jaxrl-vis phenotype)"


def replace_terms(terms: Sequence[str]) -> tuple[Trait, ...]:
    """Return the traits, with some ontology terms replaced.

    Args:
        terms: Items ``column=term``, such as ``stalks=CO_324:0000999``.

    Raises:
        RequestError: An item has another format, or names an unknown column.
    """
    own: dict[str, str] = {}
    for words in terms:
        column, mark, term = words.partition("=")
        if not mark or not term.strip() or column not in {trait.column for trait in TRAITS}:
            columns = ", ".join(trait.column for trait in TRAITS)
            raise RequestError(f"--term takes COLUMN=TERM, as stalks=CO_324:0000001, not {words[:60]!r}; columns are {columns}")
        own[column] = term.strip()
    return tuple(dataclasses.replace(trait, term=own.get(trait.column, trait.term)) for trait in TRAITS)


def write_exchange(
    out: Path, form: Format, rows: Sequence[Mapping[str, Any]], columns: Sequence[str], plan: Plan, traits: Sequence[Trait]
) -> str:
    """Write the results of the plots in one format.

    Args:
        out: Folder of the results.
        form: The format.
        rows: Rows of plots.csv.
        columns: Columns of the field plan, in order. Those named like a column of plots.csv get the prefix ``field_``.
        plan: Field plan; plots may be missing.
        traits: The traits, see `replace_terms`.

    Returns:
        Name of the file or folder written, relative to ``out``.

    Raises:
        OSError: A file cannot be written.
    """
    taken = {"plot", *_ABOUT, *(trait.column for trait in traits)}
    own = {name: f"field_{name}" if name in taken else name for name in columns}
    plan = {plot: {own[name]: value for name, value in about.items()} for plot, about in plan.items()}
    columns = list(own.values())
    write = {"plain": _write_plain, "brapi": _write_brapi, "miappe": _write_miappe, "plantcv": _write_plantcv}[form]
    return write(out, rows, columns, plan, traits)


def _write_plain(
    out: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str], plan: Plan, traits: Sequence[Trait]
) -> str:
    names = ["plot", *columns, *(trait.column for trait in traits), *_ABOUT]
    units = {"plot": "unit", **{trait.column: "count" if trait.unit == "1" else trait.unit for trait in traits}}
    terms = {"plot": "term", **{trait.column: trait.term for trait in traits}}
    table = [
        {**plan.get(row["plot"], {}), **{name: row.get(name, "") for name in names if name not in columns}} for row in rows
    ]
    write_atomically(out / "traits.csv", to_csv([units, terms, *table], names))
    return "traits.csv"


def _write_brapi(
    out: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str], plan: Plan, traits: Sequence[Trait]
) -> str:
    variables = [
        {
            "observationVariableDbId": trait.column,
            "observationVariableName": trait.column,
            "commonCropName": "Sorghum",
            "trait": {
                "traitDbId": trait.term or trait.trait.replace(" ", "_"),
                "traitName": trait.trait,
                "traitDescription": f"{trait.trait}, {trait.statistic}",
                "externalReferences": [{"referenceId": trait.term, "referenceSource": trait.term.partition(":")[0]}]
                if trait.term
                else [],
            },
            "method": {
                "methodDbId": "jaxrl-vis-phenotype",
                "methodName": trait.statistic,
                "methodClass": "Measurement",
                "description": _METHOD,
            },
            "scale": {"scaleDbId": trait.unit, "scaleName": trait.unit, "dataType": "Numerical", "units": trait.unit},
        }
        for trait in traits
    ]
    units, observations = [], []
    for row in rows:
        about = plan.get(row["plot"], {})
        place = {name: value for name, value in _position(about).items() if value}
        unit = {
            "observationUnitDbId": row["plot"],
            "observationUnitName": row["plot"],
            "observationUnitPosition": {
                "observationLevel": {"levelName": "plot", "levelCode": row["plot"]},
                **place,
            },
            "additionalInfo": {**about, **{name: str(row.get(name, "")) for name in _ABOUT}},
        }
        genotype = _genotype(about)
        units.append({**unit, **({"germplasmName": genotype} if genotype else {})})
        observations += [
            {
                "observationUnitDbId": row["plot"],
                "observationUnitName": row["plot"],
                "observationVariableDbId": trait.column,
                "observationVariableName": trait.column,
                "value": str(row[trait.column]),
                **({"germplasmName": genotype} if genotype else {}),
                "additionalInfo": {"flag": str(row.get("flag", ""))},
            }
            for trait in traits
            if row.get(trait.column, "") != ""
        ]
    for name, data in (("variables", variables), ("observationunits", units), ("observations", observations)):
        write_atomically(out / "brapi" / f"{name}.json", json.dumps(data, indent=1, ensure_ascii=False) + "\n")
    return "brapi/"


def _write_miappe(
    out: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str], plan: Plan, traits: Sequence[Trait]
) -> str:
    study = out.resolve().name
    variables = [
        {
            "Study unique ID": study,
            "Variable ID": trait.column,
            "Variable name": trait.column,
            "Variable accession number": "",
            "Trait": trait.trait,
            "Trait accession number": trait.term,
            "Method": trait.statistic,
            "Method accession number": "",
            "Method description": _METHOD,
            "Reference associated to the method": "",
            "Scale": "count" if trait.unit == "1" else trait.unit,
            "Scale accession number": "",
            "Time scale": "",
        }
        for trait in traits
    ]
    units, data = [], []
    for row in rows:
        about = plan.get(row["plot"], {})
        place = "; ".join(f"{name}:{value}" for name, value in about.items() if value and name.lower() in _PLACES)
        units.append(
            {
                "Study unique ID": study,
                "Observation unit ID": row["plot"],
                "Observation unit type": "plot",
                "External ID": "",
                "Spatial distribution": place,
                "Biological material ID": _genotype(about),
                "Observation Unit factor value": "",
            }
        )
        values = {trait.column: row.get(trait.column, "") for trait in traits}
        data.append({"Observation unit ID": row["plot"], **values, **{name: row.get(name, "") for name in _ABOUT}})
    for name, table in (("observed_variables", variables), ("observation_units", units), ("data", data)):
        write_atomically(out / "miappe" / f"{name}.csv", to_csv(table))
    return "miappe/"


def _write_plantcv(
    out: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str], plan: Plan, traits: Sequence[Trait]
) -> str:
    about = ["plot", *columns, *_ABOUT]
    kinds = {trait.column: "<class 'int'>" if trait.is_integer else "<class 'float'>" for trait in traits}
    # A trait without a value in any plot is left out: json2csv would write "NA" into a numeric column.
    there = [trait for trait in traits if any(row.get(trait.column, "") != "" for row in rows)]
    variables = {name: {"category": "metadata", "datatype": "<class 'str'>"} for name in about}
    variables |= {trait.column: {"category": "observations", "datatype": kinds[trait.column]} for trait in there}
    entities = []
    for row in rows:
        texts = {**plan.get(row["plot"], {}), **{name: str(row.get(name, "")) for name in ("plot", *_ABOUT)}}
        observations = {
            trait.column: {
                "trait": f"{trait.trait}, {trait.statistic}",
                "method": "jaxrl-vis phenotype",
                "scale": trait.unit,
                "datatype": kinds[trait.column],
                "value": int(row[trait.column]) if trait.is_integer else float(row[trait.column]),
                "label": "count" if trait.unit == "1" else trait.unit,
            }
            for trait in there
            if row.get(trait.column, "") != ""
        }
        metadata = {name: {"label": name, "datatype": "<class 'str'>", "value": [texts.get(name, "")]} for name in about}
        entities.append({"metadata": metadata, "observations": {"default_1": observations}})
    data = {"variables": variables, "entities": entities}
    write_atomically(out / "plantcv.json", json.dumps(data, indent=1, ensure_ascii=False) + "\n")
    return "plantcv.json"


_GENOTYPES = (
    "genotype",
    "germplasm",
    "germplasmname",
    "germplasm_name",
    "accession",
    "variety",
    "cultivar",
    "line",
    "pedigree",
)
_PLACES = ("range", "row", "column", "col", "pass", "rep", "replicate", "block")
_X = ("column", "col", "pass", "plot_column", "range")
_Y = ("row", "plot_row", "range")


def _genotype(about: Mapping[str, str]) -> str:
    small = {name.lower().replace(" ", "_"): value for name, value in about.items()}
    return next((small[name] for name in _GENOTYPES if small.get(name)), "")


def _position(about: Mapping[str, str]) -> dict[str, str]:
    """Return the position of a plot in the field as BrAPI's fields; empty values if unknown."""
    small = {name.lower(): value for name, value in about.items()}
    x, y = (next((name for name in names if small.get(name)), "") for names in (_X, _Y))
    y = "" if y == x else y
    place = {"positionCoordinateX": small.get(x, ""), "positionCoordinateY": small.get(y, "")}
    kinds = {"column": "GRID_COL", "col": "GRID_COL", "plot_column": "GRID_COL", "row": "GRID_ROW", "plot_row": "GRID_ROW"}
    place["positionCoordinateXType"] = kinds.get(x, "MEASURED_COL") if x else ""
    place["positionCoordinateYType"] = kinds.get(y, "MEASURED_ROW") if y else ""
    return place
