"""Tables of figures 5.4 to 5.7: docs/lab/ol_aux.md, and the main table of docs/auxiliary_losses.md."""

import functools
from collections.abc import Sequence

import numpy as np
from scipy.stats import spearmanr

from benchmarks.claims import columns as c
from benchmarks.claims.markdown import Row, table
from benchmarks.claims.records import FIRST_FRESH_SEED, Record, ablation, fresh_variants, study
from jaxrl_vis.studies.figures.authors import mean_difference, released_curves
from jaxrl_vis.studies.ol_aux import AUX_TASKS, FETCH, FINGER, HAND, OPTIONS

LAB, GUIDE = "docs/lab/ol_aux.md", "docs/auxiliary_losses.md"
VIEW = "view=fingertips-tip_marks=faint-depth_encoding=zbuffer"
BUDGETS = {FETCH: 240_000, HAND: 1_000_000, FINGER: 1_000_000}
"""Environment steps up to which success is averaged, by task; all records reach them."""
OPTION_BUDGETS = {FETCH: BUDGETS[FETCH], HAND: 600_000}
"""The same for options of OL-AUX-5."""
_OTHER_OPTIONS = ("ol_aux_5_adam", "ol_aux_5_loss", "ol_aux_5_actor")
"""Options of OL-AUX-5 that are no variants of the figures: two plug-ins of benchmarks/tasks, and ``--actor-log loss``."""
LABELS = {
    "none": "without",
    "balance": "balance",
    "cosine": "cosine",
    **{name: name.replace("_", " ") for name in AUX_TASKS},
    "ol_aux_1": "OL-AUX-1",
    "ol_aux_5_ablation": "ablation of OL-AUX-5",
    "ol_aux_5": "OL-AUX-5",
}


def run(task: str, variant: str, view: str = "") -> Record:
    """Return the run for figures: seeds 0 to 4 of a task with a variant of auxiliary losses, and a view if given."""
    return study("ol_aux", f"{task}-{variant}-paper" + (f"-{view}" if view else ""))


def to_authors(record: Record, task: str) -> str:
    """Format the mean absolute difference between a record's success and the authors' curve without auxiliary losses."""
    return f"{mean_difference(record.points, released_curves()[task, 'none']):.3f}"


@functools.cache
def claim(task: str, variant: str, budget: int | None = None) -> Record:
    """Return the run of a variant of auxiliary losses on a task for claims, with fresh seeds if any ran for the budget.

    Args:
        task: Name of the environment.
        variant: Name of the variant, a key of `LABELS`.
        budget: Environment steps that fresh seeds must have; None for the task's in `BUDGETS`.
    """
    return study("ol_aux", f"{task}-{variant}-paper", is_fresh=True, budget=budget or BUDGETS[task])


def _figure_5_4(
    task: str, variants: Sequence[str], levels: Sequence[float], budget: int, ends: Sequence[int], view: str = ""
) -> str:
    records = {variant: run(task, variant, view) for variant in variants}
    last = max(record.end for record in records.values())
    released = {variant: c.authors(task, variant, last) for variant in ("none", "ol_aux_5")}
    rows = [Row(LABELS[variant], record) for variant, record in records.items()]
    rows += [Row(f"the authors' release: {LABELS[variant]}", record) for variant, record in released.items()]
    columns = [
        *(c.steps_to(level, records["none"], released["none"]) for level in levels),
        c.mean_success(budget),
        c.p_value_against(records["none"], "without", budget),
        *([c.p_value_against(records["ol_aux_5"], "OL-AUX-5", budget)] if len(variants) > 2 else []),
        *(c.success_at(end) for end in ends),
    ]
    return table([task + (" as the authors saw it" if view else "")], rows, columns)


def _figure_5_5(task: str, levels: Sequence[float], ends: Sequence[int]) -> str:
    budget = BUDGETS[task]
    records = {variant: run(task, variant) for variant in ("none", *AUX_TASKS, "ol_aux_5")}
    columns = [
        *(c.steps_to(level, records["none"]) for level in levels),
        c.mean_success(budget),
        c.p_value_against(records["none"], "without", budget),
        c.p_value_against(records["ol_aux_5"], "OL-AUX-5", budget),
        *(c.success_at(end) for end in ends),
    ]
    return table([task], [Row(LABELS[variant], record) for variant, record in records.items()], columns)


def _figure_5_7(task: str, budget: int, columns: Sequence[c.Column]) -> str:
    records = {variant: run(task, variant) for variant in ("none", "ol_aux_1", "ol_aux_5_ablation", "ol_aux_5")}
    columns = [*columns, c.mean_success(budget), c.p_value_against(records["ol_aux_5"], "OL-AUX-5", budget)]
    return table([task], [Row(LABELS[variant], record) for variant, record in records.items()], columns)


def rank_correlation(task: str) -> float:
    """Return Spearman's rank correlation, over the auxiliary losses, of weight and gain.

    The weight is the median over seeds of a loss's mean weight in OL-AUX-5. The gain is the mean success up to the budget
    with that loss alone, minus that without auxiliary losses.
    """
    base = np.mean([success for steps, success in run(task, "none").points if steps <= BUDGETS[task]])
    gains = [np.mean([v for steps, v in run(task, name).points if steps <= BUDGETS[task]]) - base for name in AUX_TASKS]
    weights = [np.median(run(task, "ol_aux_5").means(metric=f"train/weight/{name}")) for name in AUX_TASKS]
    return float(spearmanr(weights, gains).statistic)


def _weights() -> str:
    tasks = {run(task, "ol_aux_5"): task for task in (FETCH, HAND, FINGER)}
    correlation = c.Column("rank correlation with the gain alone", lambda record: f"{rank_correlation(tasks[record]):+.1f}")
    rows = [Row(f"{task}, to {c.format_steps(record.points[-1][0])}", record) for record, task in tasks.items()]
    return table(["mean weight over training"], rows, [*c.weights(AUX_TASKS), correlation])


DEPARTURES = {
    "`paper`": "none",
    "`--env-options cross_hair=true`": "cross",
    "`--env-options goal_at=link`": "link",
    "`--env-options finger_colour=grey`": "grey",
    "`--env-options depth_encoding=zbuffer`": "zbuffer",
    "`--normalizers separate --normalizer-source relabelled`": "normalizers",
    "`--replay-transitions 160000 --replay-mean-age 40000`": "replay",
    "all but the replay": "all",
}
"""Suffix of the record's name by setting."""


def _departures() -> str:
    records = {label: ablation(f"fetch_paper_10seeds_{name}") for label, name in DEPARTURES.items()}
    base, budget = records["`paper`"], BUDGETS[FETCH]
    rows = [Row("the authors' curve", c.authors(FETCH, "none", budget))]
    rows += [Row(label, record) for label, record in records.items()]
    columns = [
        c.to_authors(FETCH, "none"),
        c.mean_success(budget),
        c.p_value_against(base, "`paper`", budget),
        *(c.mean_at(count * 1000) for count in (60, 80, 100, 120, 160, 200)),
        c.names(),
    ]
    return table(["VisualFetchReach, seeds 0 to 9"], rows, columns)


def _undone_departures() -> str:
    """Return the table of runs with one or more departures from the authors' release undone, on hand and finger."""
    hand = [
        ("VisualHandReach, `paper`", run(HAND, "none")),
        ("the z-buffer", ablation("hand_paper_zbuffer")),
        ("two normalisers, fed with relabelled transitions", ablation("hand_paper_normalizers")),
        ("camera, marks and z-buffer of the authors", ablation("hand_paper_release_view")),
        ("the same, two normalisers and random replacement", ablation("hand_paper_release_all")),
    ]
    finger = [
        ("VisualFingerTurn, `paper`", run(FINGER, "none")),
        ("two normalisers, fed with relabelled transitions", ablation("finger_paper_normalizers")),
        ("random replacement", ablation("finger_paper_replay")),
        ("`--compute-dtype float32`", ablation("finger_paper_float32")),
    ]
    rows = [Row(label, record) for label, record in [*hand, *finger]]
    at_end = {id(record): 600_000 for _, record in hand} | {id(record): 1_400_000 for _, record in finger}
    success = c.Column("success", lambda record: f"{record.median(at_end[id(record)]):.2f}")
    steps = c.Column("environment steps", lambda record: c.format_steps(at_end[id(record)]))
    return table(["undone"], rows, [c.seeds(), steps, success, c.names()])


def _fresh(task: str) -> str:
    """Return the table of all variants with seeds from 100 on."""
    budget = BUDGETS[task]
    records = {variant: claim(task, variant) for variant in fresh_variants(task)}
    records = {variant: record for variant, record in records.items() if record.seeds[0] >= FIRST_FRESH_SEED}
    order = sorted(records, key=lambda variant: list(LABELS).index(variant) if variant in LABELS else len(LABELS))
    columns = [c.seeds(), c.mean_success(budget)]
    columns += [
        c.p_value_against(records[variant], LABELS[variant], budget)
        for variant in ("none", "balance", "ol_aux_5")
        if variant in records
    ]
    rows = [Row(LABELS.get(variant, f"`{variant}`"), records[variant]) for variant in order]
    return table([task], rows, columns) if rows else f"{task}: no run with fresh seeds is kept."


def _main() -> str:
    """Return the main table of the guide: four choices on three tasks, with fresh seeds if there are any."""
    rows, base = [], {}
    for task in (FETCH, HAND, FINGER):
        for variant in ("none", "balance", "inverse_dynamics", "ol_aux_5"):
            record = claim(task, variant)
            base[record] = (claim(task, "none"), BUDGETS[task])
            label = f"{LABELS[variant]} alone" if variant in AUX_TASKS else LABELS[variant]
            rows.append(Row(f"{task}, to {c.format_steps(BUDGETS[task])}" if variant == "none" else "", record, [label]))

    def p_cell(record: Record) -> str:
        reference, budget = base[record]
        return "" if record is reference else c.show_p(c.p_value(record, reference, budget))

    columns = [
        c.seeds(),
        c.Column("mean success, IQM (95 %)", lambda record: c.interval(record.means(base[record][1]))),
        c.Column("p against without", p_cell),
    ]
    return table(["`paper`", "auxiliary losses"], rows, columns)


def options(task: str) -> dict[str, Record]:
    """Return the runs of OL-AUX-5's options on a task, with the tuning seeds, by variant."""
    return {variant: run(task, variant) for variant in (*OPTIONS, *_OTHER_OPTIONS)}


def _options(task: str) -> str:
    base, budget = run(task, "ol_aux_5"), OPTION_BUDGETS[task]
    rows = [Row("OL-AUX-5", base), *(Row(f"`{variant}`", record) for variant, record in options(task).items())]
    loss, actor = (options(task)[variant] for variant in ("ol_aux_5_loss", "ol_aux_5_actor"))
    against_loss = c.Column(
        "p against `ol_aux_5_loss`",
        lambda record: c.show_p(c.p_value(record, loss, budget)) if record is actor else "",
    )
    weights = [f"train/weight/{name}" for name in AUX_TASKS]
    total = c.Column(
        f"sum of weights at {c.format_steps(budget)}",
        lambda record: f"{sum(record.median(budget, metric=name) for name in weights):.0f}",
    )
    against_base = c.p_value_against(base, "OL-AUX-5", budget)
    return table([task], rows, [c.mean_success(budget), against_base, against_loss, total, c.names()])


def tables() -> dict[str, dict[str, str]]:
    """Return the tables, page -> marker -> text."""
    four = ("none", "balance", "cosine", "ol_aux_5")
    return {
        GUIDE: {"main": _main()},
        LAB: {
            "figure_5_4_fetch": _figure_5_4(FETCH, four, (0.5, 0.9), 240_000, [240_000]),
            "figure_5_4_hand": _figure_5_4(HAND, four, (0.2, 0.3, 0.4, 0.65), 2_000_000, [1_000_000, 2_000_000]),
            "figure_5_4_hand_view": _figure_5_4(HAND, ("none", "ol_aux_5"), (0.2, 0.3, 0.4), 2_000_000, [2_000_000], VIEW),
            "figure_5_4_finger": _figure_5_4(FINGER, four, (0.3, 0.5, 0.9), 1_480_000, [1_480_000, 2_480_000]),
            "figure_5_5_fetch": _figure_5_5(FETCH, (0.5, 0.9), [100_000]),
            "figure_5_5_hand": _figure_5_5(HAND, (0.4,), [1_000_000]),
            "figure_5_5_finger": _figure_5_5(FINGER, (0.3,), [1_000_000]),
            "figure_5_6": _weights(),
            "figure_5_7_fetch": _figure_5_7(FETCH, 240_000, [c.steps_to(0.9, run(FETCH, "none"))]),
            "figure_5_7_hand": _figure_5_7(HAND, 600_000, [c.success_at(600_000)]),
            "fresh_fetch": _fresh(FETCH),
            "fresh_hand": _fresh(HAND),
            "fresh_finger": _fresh(FINGER),
            "options_fetch": _options(FETCH),
            "options_hand": _options(HAND),
            "departures": _departures(),
            "gaps": _undone_departures(),
        },
    }
