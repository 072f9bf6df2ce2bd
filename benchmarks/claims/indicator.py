"""Tables of figures 5.1, 5.2 and related ones: docs/lab/indicator.md, and the main table of docs/indicator_rewards.md."""

import functools
from collections.abc import Mapping, Sequence

from benchmarks.claims import columns as c
from benchmarks.claims.markdown import Row, table
from benchmarks.claims.records import DISTANCE, SUCCESS, Record, study
from jaxrl_vis.report.plots import format_steps
from jaxrl_vis.studies.indicator import FETCH, FINGER, HAND, REACHER, SAWYER

LAB, GUIDE = "docs/lab/indicator.md", "docs/indicator_rewards.md"
OURS = "indicator_balance_filter"
METHODS = {
    "oracle": "oracle",
    "autoencoder": "autoencoder",
    "indicator": "indicator",
    OURS: "indicator, balanced and filtered",
}
_PARTS = {
    OURS: "indicator, balanced and filtered",
    "balance_only": "without the filter (`balance_only`)",
    "indicator": "without both (`indicator`)",
    "all_relabelled": "p₁ = 1: no goal is the original one",
    "all_next": "p₁ = 0.45, p₂ = 1: replaced goals are always the very next observation",
}


@functools.cache
def run(task: str, variant: str) -> Record:
    """Return the run of a variant of rewards on a task, with fresh seeds if there are any."""
    return study("indicator", f"{task}-{variant}-fast", is_fresh=True)


def _rows(task: str, labels: Mapping[str, str]) -> list[Row]:
    return [Row(label, run(task, variant)) for variant, label in labels.items()]


def _ends(task: str, labels: Mapping[str, str], reference: str, label: str, extra_columns: Sequence[c.Column] = ()) -> str:
    """Return the Markdown table of results at the end and over training, with a test against one of the rows.

    Args:
        task: Name of the environment.
        labels: First cell of each row, by variant.
        reference: Variant that the others are tested against.
        label: Name of the reference in the title of the test's column.
        extra_columns: Further columns.
    """
    base = run(task, reference)
    columns = [
        c.final(),
        c.final_distance(),
        c.mean_success(),
        c.p_value_against(base, label),
        *extra_columns,
    ]
    return table([f"{task}, {format_steps(base.end)} steps"], _rows(task, labels), columns)


def _rewards(task: str, precision: bool) -> str:
    """Return the table of logged reward statistics of all methods, over training and at the end.

    With ``precision``, these are the dropped negatives and the filter's precision, otherwise positive rewards and the value
    at goals; false negatives are in both.
    """
    pairs = [("positive rewards", "train/positive_share"), ("negatives that are false", "train/false_negative_share")]
    if precision:
        pairs = [("negatives dropped", "train/filtered_share"), pairs[1]]
    columns = []
    for title, metric in pairs:
        columns += [c.training_mean(metric, f"{title}, over training"), c.final_median(metric, "at the end")]
        if metric == "train/filtered_share":
            columns += [c.training_precision(), c.final_precision()]
    if not precision:
        columns.append(c.final_median("train/value_at_goals", "value at goals, at the end", 1))
    return table([task], _rows(task, METHODS), columns)


def _estimators() -> str:
    labels = {
        "oracle": "oracle, without errors",
        "false_positives": "10 % false positives, anywhere",
        "clutter": "10 % false positives, in a cluttered quarter",
        "false_negatives": "10 % false negatives, anywhere",
        "state_noise": "Gaussian noise of 30 mm",
        OURS: "indicator, balanced and filtered",
    }
    more = [
        c.training_mean("train/false_positive_share", "false positives, over training"),
        c.training_mean("train/false_negative_share", "negatives that are false, over training"),
        c.final_median("train/false_negative_share", "at the end"),
    ]
    return _ends(FETCH, labels, "oracle", "the oracle", more)


def _cameras() -> str:
    own = {
        "oracle": "oracle",
        "oracle_noise": "oracle, noise of 5 grey levels",
        "oracle_randomized": "oracle, cameras, lights and colours varied",
        OURS: "indicator, balanced and filtered",
        "ours_noise": "the same, noise of 5 grey levels",
        "ours_randomized": "the same, cameras, lights and colours varied",
    }
    oracle, ours = run(FETCH, "oracle"), run(FETCH, OURS)

    def p_cell(record: Record) -> str:
        reference = ours if record.name.partition("-")[2].startswith(("ours", OURS)) else oracle
        return "" if record is reference else c.show_p(c.p_value(record, reference))

    columns = [c.final(), c.final_distance(), c.mean_success(), c.Column("p against plain images", p_cell)]
    return table([f"{FETCH}, {format_steps(oracle.end)} steps"], _rows(FETCH, own), columns)


def _main() -> str:
    """Return the main table of the guide: success and distance at the end on five tasks."""
    rows, oracles = [], {}
    for task in (REACHER, FETCH, SAWYER, HAND, FINGER):
        for variant, label in METHODS.items():
            if (task, variant) == (SAWYER, "autoencoder"):  # figure 5.2 has none
                continue
            record = run(task, variant)
            oracles[record] = run(task, "oracle")
            rows.append(Row(f"{task}, {format_steps(record.end)} steps" if variant == "oracle" else "", record, [label]))

    def p_cell(record: Record) -> str:
        return "" if record is oracles[record] else c.show_p(c.p_value(record, oracles[record]))

    columns = [
        c.final(SUCCESS),
        c.final(DISTANCE, "distance at the end"),
        c.mean_success(),
        c.Column("p against the oracle", p_cell),
    ]
    return table(["task", "reward"], rows, columns)


def tables() -> dict[str, dict[str, str]]:
    """Return the tables, page -> marker -> text."""
    states = {
        "oracle": "oracle",
        "indicator": "indicator",
        OURS: "indicator, balanced and filtered",
        "all_relabelled": "p₁ = 1",
        "all_next": "p₁ = 0.45, p₂ = 1",
    }
    sawyer = {variant: label for variant, label in METHODS.items() if variant != "autoencoder"}
    return {
        GUIDE: {"main": _main()},
        LAB: {
            "figure_5_1_reacher": _ends(REACHER, METHODS, "oracle", "the oracle"),
            "figure_5_1_fetch": _ends(FETCH, METHODS, "oracle", "the oracle"),
            "parts_reacher": _ends(REACHER, _PARTS, OURS, "the whole method"),
            "parts_fetch": _ends(FETCH, _PARTS, OURS, "the whole method"),
            "states_reacher": _ends("Reacher", states, "oracle", "the oracle"),
            "states_fetch": _ends("FetchReach", states, "oracle", "the oracle"),
            "figure_5_2": _ends(SAWYER, sawyer, "oracle", "the oracle"),
            "hand": _ends(HAND, METHODS, "oracle", "the oracle"),
            "hand_rewards": _rewards(HAND, precision=True),
            "finger": _ends(FINGER, METHODS, "oracle", "the oracle"),
            "finger_rewards": _rewards(FINGER, precision=False),
            "estimators": _estimators(),
            "cameras": _cameras(),
        },
    }
