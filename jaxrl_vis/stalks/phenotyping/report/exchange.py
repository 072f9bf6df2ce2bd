"""Results of plots in the forms that breeders' programs read, joined with what is known of the plots.

plain     traits.csv: names of the columns, their units, their terms, and a row for each plot
brapi     brapi/*.json: variables, observation units and observations, as BrAPI 2.1 takes them by POST
miappe    miappe/*.csv: observed variables, observation units and data, in the fields of MIAPPE 1.1
plantcv   plantcv.json: as plantcv-run-workflow writes it, for plantcv-utils json2csv
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
"""Columns of a field plan: plot -> column -> value."""


@dataclasses.dataclass(frozen=True)
class Trait:
    """A column of plots.csv as a variable: a trait, how it was measured, and on what scale.

    Attributes:
        column: Its name in plots.csv and in all forms.
        trait: What is measured.
        unit: Unit of the numbers, as UCUM writes it; ``1`` for counts.
        statistic: What the number is of the stalks of a plot.
        term: Identifier of the trait in an ontology; empty where none is known.
        whole: If true, the numbers are whole.
    """

    column: str
    trait: str
    unit: str
    statistic: str
    term: str = ""
    whole: bool = False


# The term of diameters is that of the Plant Trait Ontology for the thickness of stems. Numbers of stalks have none: the Crop
# Ontology of sorghum (CO_324) counts plants, hills, panicles and the tillers of a plant, and the Plant Trait Ontology tillers
# (TO:0000346), but neither main stems and tillers of a plot together. `--term` names what a programme uses.
_DIAMETER = "TO:0000339"
TRAITS = (
    Trait("stalks", "stalk number", "1", "count in the plot", whole=True),
    Trait("stalks_per_m", "stalk number", "1/m", "count per length of row"),
    Trait("width_mean_mm", "stalk diameter", "mm", "mean over stalks, 12 inches above the ground", _DIAMETER),
    Trait("width_sd_mm", "stalk diameter", "mm", "standard deviation over stalks, 12 inches above the ground", _DIAMETER),
    Trait("width_se_mm", "stalk diameter", "mm", "standard error of the mean, 12 inches above the ground", _DIAMETER),
    Trait("width_24in_mean_mm", "stalk diameter", "mm", "mean over stalks, 24 inches above the ground", _DIAMETER),
    Trait("taper_mean_mm_per_in", "stalk taper", "mm/[in_i]", "mean over stalks, from 12 to 24 inches above the ground"),
    Trait("length_m", "row length", "m", "way of the robot along the row"),
    Trait("stalks_measured", "stalk number", "1", "count of the stalks whose diameter was measured", whole=True),
)
_ABOUT = ("flag", "method", "version")
"""Columns of plots.csv that say something of the numbers beside them."""
_METHOD = "stereo images of a robot that drives along the row; stalks found and outlined by networks (jaxrl-vis phenotype)"


def with_terms(terms: Sequence[str]) -> tuple[Trait, ...]:
    """The traits, some of them with terms of one's own.

    Args:
        terms: ``column=term``, as ``stalks=CO_324:0000999``.

    Raises:
        RequestError: One is not so, or names no column.
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
    """Write results of plots in one form.

    Args:
        out: Folder of the results.
        form: The form.
        rows: Rows of plots.csv.
        columns: Columns of the plan, in their order.
        plan: What is known of the plots.
        traits: The traits, see `with_terms`.

    Returns:
        Name of what was written, in ``out``.

    Raises:
        OSError: It cannot be written.
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
    kinds = {trait.column: "<class 'int'>" if trait.whole else "<class 'float'>" for trait in traits}
    # What is no number in any plot is no variable: json2csv would write "NA" into a column of numbers.
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
                "value": int(row[trait.column]) if trait.whole else float(row[trait.column]),
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
    """Return the position of a plot in its field, by BrAPI's names."""
    small = {name.lower(): value for name, value in about.items()}
    x, y = (next((name for name in names if small.get(name)), "") for names in (_X, _Y))
    y = "" if y == x else y
    place = {"positionCoordinateX": small.get(x, ""), "positionCoordinateY": small.get(y, "")}
    kinds = {"column": "GRID_COL", "col": "GRID_COL", "plot_column": "GRID_COL", "row": "GRID_ROW", "plot_row": "GRID_ROW"}
    place["positionCoordinateXType"] = kinds.get(x, "MEASURED_COL") if x else ""
    place["positionCoordinateYType"] = kinds.get(y, "MEASURED_ROW") if y else ""
    return place
