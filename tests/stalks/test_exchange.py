"""Tests of the export of plot results, joined with a field plan, in formats of breeding software."""

import csv
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.tables.field_plan import missing_plots_message, read_field_plan
from jaxrl_vis.stalks.phenotyping.report.exchange import TRAITS, replace_terms, write_exchange
from jaxrl_vis.stalks.phenotyping.report.tables import PLOT_COLUMNS

ROW = {
    "plot": "plot_0001",
    "pairs": 34,
    "pairs_skipped": 0,
    "length_m": "2.1340",
    "stalks": 33,
    "stalks_per_m": "15.464",
    "width_mean_mm": "14.354",
    "width_sd_mm": "2.100",
    "width_se_mm": "0.366",
    "width_24in_mean_mm": "",
    "taper_mean_mm_per_in": "",
    "stalks_measured": 31,
    "flag": "ok",
    "method": "strip",
    "version": "1",
}
EMPTY = {**ROW, "plot": "=plot_0002", "stalks": "", "stalks_per_m": "", "width_mean_mm": "", "flag": "no odometry"}
PLAN = {"plot_0001": {"range": "3", "row": "12", "genotype": "BTx623", "flag": "mine"}, "=plot_0002": {}}
COLUMNS = ("range", "row", "genotype", "flag")


def write(out: Path, form) -> str:
    return write_exchange(out, form, [ROW, EMPTY], COLUMNS, PLAN, replace_terms(["stalks=CO_324:0000001"]))


def test_every_trait_is_a_column_of_plots():
    assert {trait.column for trait in TRAITS} <= set(PLOT_COLUMNS) and set(ROW) == set(PLOT_COLUMNS)


def test_plain_tables_have_units_and_terms_below_their_names(tmp_path):
    assert write(tmp_path, "plain") == "traits.csv"
    names, units, terms, first, second = csv.reader((tmp_path / "traits.csv").read_text().splitlines())
    assert names[:5] == ["plot", *COLUMNS[:3], "field_flag"] and len(set(names)) == len(names)
    about = {name: (unit, term, value) for name, unit, term, value in zip(names, units, terms, first)}
    assert about["plot"] == ("unit", "term", "plot_0001")
    assert about["width_mean_mm"] == ("mm", "TO:0000339", "14.354")
    assert about["stalks"] == ("count", "CO_324:0000001", "33")
    assert about["genotype"] == ("", "", "BTx623") and about["field_flag"][2] == "mine" and about["flag"][2] == "ok"
    assert second[0] == "'=plot_0002"  # no spreadsheet computes it


BRAPI = {
    "variables": {"observationVariableName", "trait", "method", "scale"},
    "observationunits": {"observationUnitDbId", "observationUnitName", "observationUnitPosition"},
    "observations": {"observationUnitDbId", "observationVariableDbId", "observationVariableName", "value"},
}
"""Fields that BrAPI 2.1 asks for (brapi.org/specification, /variables, /observationunits and /observations by POST)."""
MIAPPE = {
    "observed_variables": {"Variable ID", "Variable name", "Trait", "Method", "Scale"},
    "observation_units": {"Observation unit ID", "Observation unit type"},
    "data": {"Observation unit ID"},
}
"""Fields that the checklist of MIAPPE 1.1 asks for (github.com/MIAPPE/MIAPPE, MIAPPE_Checklist-Data-Model-v1.1), and the names
that the profile miappe 1.1 of the package metaseed 0.69 makes required: an id and a study of each, and a name of variables."""


def test_brapi_has_what_its_calls_ask_for(tmp_path):
    assert write(tmp_path, "brapi") == "brapi/"
    data = {name: json.loads((tmp_path / "brapi" / f"{name}.json").read_text()) for name in BRAPI}
    for name, fields in BRAPI.items():
        assert data[name] and all(fields <= set(entry) for entry in data[name])
        assert all(isinstance(entry.get("value", ""), str) for entry in data[name])
    variables = {entry["observationVariableDbId"]: entry for entry in data["variables"]}
    assert (
        variables["stalks"]["trait"]["traitDbId"] == "CO_324:0000001" and variables["width_mean_mm"]["scale"]["units"] == "mm"
    )
    unit = data["observationunits"][0]
    assert unit["germplasmName"] == "BTx623" and unit["observationUnitPosition"]["observationLevel"]["levelName"] == "plot"
    assert [unit["observationUnitPosition"][f"positionCoordinate{axis}"] for axis in "XY"] == ["3", "12"]
    units = {entry["observationUnitDbId"] for entry in data["observationunits"]}
    assert {entry["observationUnitDbId"] for entry in data["observations"]} <= units
    assert {entry["observationVariableDbId"] for entry in data["observations"]} <= set(variables)
    counts = [entry["value"] for entry in data["observations"] if entry["observationVariableDbId"] == "stalks"]
    assert counts == ["33"]  # what was not counted is not an observation


def test_miappe_has_what_its_checklist_asks_for(tmp_path):
    assert write(tmp_path, "miappe") == "miappe/"
    tables = {name: list(csv.DictReader((tmp_path / "miappe" / f"{name}.csv").open())) for name in MIAPPE}
    for name, fields in MIAPPE.items():
        assert tables[name] and all(row[field] for row in tables[name] for field in fields)
    for name in ("observed_variables", "observation_units"):
        assert all(row["Study unique ID"] for row in tables[name])
    assert tables["observation_units"][0]["Spatial distribution"] == "range:3; row:12"
    assert tables["observation_units"][0]["Biological material ID"] == "BTx623"
    ids = {row["Variable ID"] for row in tables["observed_variables"]}
    assert ids <= set(tables["data"][0]) and tables["data"][0]["width_mean_mm"] == "14.354"


def test_plantcv_is_as_its_own_reader_walks_through_it(tmp_path):
    """As plantcv.utils.json2csv expects, variables have category and type, and entities metadata and observations by sample."""
    assert write(tmp_path, "plantcv") == "plantcv.json"
    data = json.loads((tmp_path / "plantcv.json").read_text())
    kinds = {"<class 'int'>": int, "<class 'float'>": float, "<class 'str'>": str}
    metadata = [name for name, about in data["variables"].items() if about["category"] == "metadata"]
    assert {"plot", "genotype", "flag"} <= set(metadata)
    for entity in data["entities"]:
        assert all(set(entity["metadata"][name]) == {"label", "datatype", "value"} for name in metadata)
        for sample in entity["observations"].values():
            for name, observation in sample.items():
                assert set(observation) == {"trait", "method", "scale", "datatype", "value", "label"}
                assert isinstance(observation["value"], kinds[data["variables"][name]["datatype"]])
    first, second = (entity["observations"]["default_1"] for entity in data["entities"])
    assert first["stalks"]["value"] == 33 and "stalks" not in second and "width_24in_mean_mm" not in data["variables"]


@pytest.mark.parametrize("words", ["stalks", "none=TO:1", "stalks=", "=TO:1"])
def test_terms_name_a_column(words):
    with pytest.raises(RequestError, match="--term takes COLUMN=TERM"):
        replace_terms([words])


# --- plans of fields ---
PLOTS = ["field 1/plot_0001", "field 1/plot_0002"]
PLANS = {
    "the whole way": "plot_id,range,genotype\nfield 1/plot_0001,1,A\nfield 1/plot_0002,2,B\n",
    "the last part": "range;genotype;Plot ID\n1;A;PLOT_0001\n2;B;Plot_0002\n3;C;plot_0003\n",
    "a number": "plot\trange\tgenotype\n1\t1\tA\n2\t2\tB\n",
    "a number with zeros": "unique_id,plot,range,genotype\nX7,001,1,A\nX9,002,2,B\n",
    "Field Book, table": '"plot_id","range","genotype","height"\n"plot_0001","1","A","99"\n"plot_0002","2","B",""\n',
    "Field Book, observations": "plot_id,range,genotype,trait,userValue,timeTaken\n"
    + "".join(
        f"plot_000{plot},{plot},{name},height,{value},2024-08-0{value}\n"
        for plot, name in ((1, "A"), (2, "B"))
        for value in (1, 2)
    ),
}


@pytest.mark.parametrize("form", PLANS)
def test_rows_of_a_plan_are_those_of_folders(tmp_path, form):
    (tmp_path / "plan.csv").write_text(PLANS[form])
    columns, plan = read_field_plan(tmp_path / "plan.csv", PLOTS)
    assert "range" in columns and "genotype" in columns
    assert [(plan[plot]["range"], plan[plot]["genotype"]) for plot in PLOTS] == [("1", "A"), ("2", "B")]
    assert missing_plots_message(plan, PLOTS) is None
    assert missing_plots_message(plan, [*PLOTS, "c"]) == "the plan of the field does not name c"


def test_ranges_and_rows_name_plots(tmp_path):
    (tmp_path / "plan.csv").write_text("Range,Row,Genotype\n1,07,A\n2,07,B\n")
    plots = ["range1/row7", "range_02-row_7"]
    _, plan = read_field_plan(tmp_path / "plan.csv", plots)
    assert [plan[plot]["Genotype"] for plot in plots] == ["A", "B"]


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("genotype\nA\n", "it needs a column plot_id"),
        ("plot_id,genotype\nx,A\ny,B\n", "its plot_id has x, y, and the folders are field 1/plot_0001"),
        ("plot_id,genotype,genotype\n1,A,B\n", "must name columns, each once"),
        ("", "must name columns"),
        ("plot_id,genotype\nplot_0001,A\nplot_0001,B\nplot_0002,B\n", "two values of genotype for plot field 1/plot_0001: A"),
    ],
)  # fmt: skip
def test_plans_that_cannot_be_joined_are_reported_in_one_line(tmp_path, text, part):
    (tmp_path / "plan.csv").write_text(text)
    with pytest.raises(RequestError) as error:
        read_field_plan(tmp_path / "plan.csv", PLOTS)
    assert part in str(error.value) and len(str(error.value).splitlines()) == 1


@given(st.permutations(range(1, 9)), st.integers(1, 8))
def test_no_plot_gets_the_row_of_another(tmp_path_factory, order, count):
    """The order of rows, and missing or further rows, make no difference."""
    path = tmp_path_factory.mktemp("plan") / "plan.csv"
    path.write_text("plot,genotype\n" + "".join(f"{number},G{number}\n" for number in order))
    plots = [f"plot_{number:04d}" for number in range(1, count + 1)]
    _, plan = read_field_plan(path, plots)
    assert {plot: about["genotype"] for plot, about in plan.items()} == {
        plot: f"G{place + 1}" for place, plot in enumerate(plots)
    }
