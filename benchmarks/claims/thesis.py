"""Claims of the thesis compared with the records: docs/claims.md and, abridged, README.md.

Verdicts are computed: ``better`` and ``worse`` if the exact permutation test is significant, else ``level``.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from benchmarks.claims import columns as c
from benchmarks.claims import indicator, ol_aux
from benchmarks.claims.indicator import OURS, REACHER, SAWYER
from benchmarks.claims.markdown import origin_sentence
from benchmarks.claims.records import DISTANCE, SUCCESS, Record, study
from jaxrl_vis.studies.ol_aux import AUX_TASKS, FETCH, FINGER, HAND

PAGE = "docs/claims.md"
SHORT = {
    FETCH: "Fetch",
    HAND: "hand",
    FINGER: "finger",
    REACHER: "Reacher",
    SAWYER: "Sawyer",
    "FetchReach": "Fetch from states",
}
HOLDS, PARTLY, FAILS = "holds", "in part", "does not hold"
_LAB, _INDICATOR = "lab/ol_aux.md", "lab/indicator.md"


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Comparison of two records' mean success up to a budget.

    Attributes:
        setting: Task and budget as text.
        first, second: The records.
        budget: Environment steps up to which success is averaged; None for all.
    """

    setting: str
    first: Record
    second: Record
    budget: int | None = None

    @property
    def verdict(self) -> str:
        """Verdict on the first record: ``better``, ``worse`` or ``level``."""
        return c.verdict(self.first, self.second, self.budget)

    @property
    def text(self) -> str:
        """Interquartile means with intervals, and the p-value, as text."""
        means = " against ".join(c.interval(record.means(self.budget)) for record in (self.first, self.second))
        p = c.show_p(c.p_value(self.first, self.second, self.budget))
        return f"{self.setting}: {means}, p {p}" if p.startswith("<") else f"{self.setting}: {means}, p = {p}"


@dataclasses.dataclass(frozen=True)
class Claim:
    """Row of the table.

    Attributes:
        claim: Statement of the thesis.
        outcome: One of `HOLDS`, `PARTLY` and `FAILS`.
        finding: Verdicts and numbers from the records.
        interval: Intervals and p-values.
        source: Link to figure and table.
        records: Runs of the comparisons.
        in_readme: True if the README includes the claim.
    """

    claim: str
    outcome: str
    finding: str
    interval: str
    source: str
    records: Sequence[Record]
    in_readme: bool = True


def _ol_aux(first: str, second: str, tasks: Mapping[str, int]) -> list[Comparison]:
    return [
        Comparison(
            f"{SHORT[task]} to {c.format_steps(budget)}",
            ol_aux.claim(task, first, budget),
            ol_aux.claim(task, second, budget),
            budget,
        )
        for task, budget in tasks.items()
    ]


def _rewards(first: str, second: str, tasks: Sequence[str]) -> list[Comparison]:
    return [Comparison(SHORT[task], indicator.run(task, first), indicator.run(task, second)) for task in tasks]


def _outcome(comparisons: Sequence[Comparison], expected: Sequence[str] = ("better",)) -> str:
    right = [comparison.verdict in expected for comparison in comparisons]
    return HOLDS if all(right) else PARTLY if any(right) else FAILS


def _findings(comparisons: Sequence[Comparison]) -> str:
    verdicts: dict[str, list[str]] = {}
    for comparison in comparisons:
        verdicts.setdefault(comparison.verdict, []).append(comparison.setting)
    return "; ".join(f"{verdict}: {', '.join(places)}" for verdict, places in verdicts.items())


def _comparison_claim(
    claim: str, comparisons: Sequence[Comparison], source: str, expected: Sequence[str] = ("better",), note: str = ""
) -> Claim:
    records = [record for comparison in comparisons for record in (comparison.first, comparison.second)]
    finding = _findings(comparisons) + (f". {note}" if note else "")
    return Claim(
        claim,
        _outcome(comparisons, expected),
        finding,
        "; ".join(comparison.text for comparison in comparisons),
        source,
        records,
    )


def _better_than_none() -> Claim:
    comparisons = _ol_aux("ol_aux_5", "none", ol_aux.BUDGETS)
    return _comparison_claim("OL-AUX-5 learns faster than no auxiliary losses", comparisons, f"[5.4]({_LAB}#figure-54)")


def _better_than_logarithm() -> Claim:
    return _comparison_claim(
        "Our control: OL-AUX-5 learns faster than the logarithm of the main loss alone",
        _ol_aux("ol_aux_5", "none_log", ol_aux.BUDGETS),
        f"[fresh seeds]({_LAB}#fresh-seeds)",
    )


def with_decay(task: str, variant: str, decay: float) -> Record:
    """Return the run with a decay of the target networks; for the hand, with the authors' view.

    Args:
        task: Name of the task.
        variant: Weighting or auxiliary loss, as in the study.
        decay: Fraction of the old parameters that a target network keeps in an update; 0.98 in `paper`.

    Raises:
        LookupError: No such run is stored.
    """
    stem = f"{task}-{variant}-paper" if task != HAND else f"{HAND}-view=fingertips-{variant}-paper"
    if decay != 0.98:
        return study("target_decay", f"{stem}-decay{decay:g}", is_fresh=True)
    if task == HAND:
        return ol_aux.run(HAND, variant, ol_aux.VIEW)
    return ol_aux.claim(task, variant)


def speed_up(task: str, level: float, decay: float) -> str:
    """Format the speed-up of OL-AUX-5 to a success level, over no auxiliary losses; ``decay`` is that of target networks."""
    return c.speed_up(with_decay(task, "ol_aux_5", decay), with_decay(task, "none", decay), level)


LEVELS = {FETCH: 0.5, HAND: 0.2, FINGER: 0.3}
"""Success level at which speed-ups are stated, by task; for the hand, with the authors' view."""


def _speed_ups() -> Claim:
    factors = {task: (speed_up(task, level, 0.98), speed_up(task, level, 0.95)) for task, level in LEVELS.items()}
    records = [
        with_decay(task, variant, decay) for task in LEVELS for variant in ("none", "ol_aux_5") for decay in (0.98, 0.95)
    ]
    words = {FETCH: "Fetch", HAND: "hand as the authors saw it", FINGER: "finger"}
    finding = "; ".join(f"{words[task]} to {LEVELS[task]:g}: {slow} and {fast} times" for task, (slow, fast) in factors.items())
    comparisons = []
    for task, label in words.items():
        budget = ol_aux.BUDGETS[task]
        pair = (with_decay(task, "ol_aux_5", 0.95), with_decay(task, "none", 0.95))
        comparisons.append(Comparison(f"{label} at 0.95, to {c.format_steps(budget)}", *pair, budget))
    return Claim(
        "OL-AUX-5 needs 2 times fewer steps on Fetch, about 3 times fewer on hand and finger",
        _outcome(comparisons),
        f"{finding}, with target networks that keep 0.98 (the release's script) and 0.95 (OpenAI Baselines' default)",
        "; ".join(comparison.text for comparison in comparisons),
        "[Speed of the target networks](lab/target_decay.md)",
        records,
    )


def _single_tasks() -> Claim:
    comparisons = []
    for task, budget in ol_aux.BUDGETS.items():
        records = {name: ol_aux.claim(task, name) for name in AUX_TASKS}
        best = max(records, key=lambda name: records[name].means(budget).mean())
        place = f"{SHORT[task]} to {c.format_steps(budget)} (best: {best.replace('_', ' ')})"
        comparisons.append(Comparison(place, ol_aux.claim(task, "ol_aux_5"), records[best], budget))
    return _comparison_claim(
        "OL-AUX-5 is always better than, or level with, the best single task",
        comparisons,
        f"[5.5]({_LAB}#figure-55)",
        ("better", "level"),
    )


def _best_single_task() -> Claim:
    budget, label = ol_aux.BUDGETS[HAND], "inverse_dynamics"
    others = {name: ol_aux.claim(HAND, name) for name in AUX_TASKS if name != label}
    second = max(others, key=lambda name: others[name].means(budget).mean())
    place = f"hand to {c.format_steps(budget)}, against the second best ({second.replace('_', ' ')})"
    comparison = Comparison(place, ol_aux.claim(HAND, label), others[second], budget)
    return _comparison_claim("Inverse dynamics is the best single task on the hand", [comparison], f"[5.5]({_LAB}#figure-55)")


def _balance() -> Claim:
    comparisons = [*_ol_aux("ol_aux_5", "balance", ol_aux.BUDGETS), *_ol_aux("ol_aux_5", "balance", {HAND: 2_000_000})]
    return _comparison_claim("OL-AUX-5 improves on gradient balancing", comparisons, f"[5.4]({_LAB}#figure-54)")


def _balance_and_none() -> Claim:
    comparisons = _ol_aux("balance", "none", ol_aux.BUDGETS)
    return _comparison_claim(
        "Gradient balancing is better than none in all environments", comparisons, f"[5.4]({_LAB}#figure-54)"
    )


def _cosine() -> Claim:
    comparisons = _ol_aux("cosine", "none", ol_aux.BUDGETS)
    return _comparison_claim("Cosine similarity is better than none (figure 5.4)", comparisons, f"[5.4]({_LAB}#figure-54)")


def _n_steps() -> Claim:
    comparisons = _ol_aux("ol_aux_5", "ol_aux_1", {FETCH: 240_000, HAND: 600_000})
    return _comparison_claim("OL-AUX-1 is much worse than OL-AUX-5", comparisons, f"[5.7]({_LAB}#figure-57)")


def _ablation() -> Claim:
    comparisons = _ol_aux("ol_aux_5", "ol_aux_5_ablation", {FETCH: 240_000, HAND: 600_000})
    return _comparison_claim("The ablation of OL-AUX-5 is worse than OL-AUX-5", comparisons, f"[5.7]({_LAB}#figure-57)")


def _order() -> Claim:
    values = {task: ol_aux.rank_correlation(task) for task in (HAND, FINGER, FETCH)}
    finding = ", ".join(f"{SHORT[task]} {value:+.1f}" for task, value in values.items())
    return Claim(
        "Learned weights often align with what tasks gain alone",
        PARTLY,
        f"Rank correlation of mean weight and gain alone: {finding}",
        "of five tasks; only +1.0 differs from 0 (p < .05)",
        f"[5.6]({_LAB}#figure-56)",
        [ol_aux.run(task, "ol_aux_5") for task in values],
    )


def _ends(task: str, variants: Sequence[str], metric: str = SUCCESS) -> str:
    """Format final medians; the second record's follows ``against``."""
    records = [indicator.run(task, variant) for variant in variants]
    return f"{SHORT[task]} " + " against ".join(f"{record.median(metric=metric):.3f}" for record in records)


def _oracle() -> Claim:
    tasks, pair = (REACHER, FETCH, SAWYER), (OURS, "oracle")
    ends = {metric: ", ".join(_ends(task, pair, metric) for task in tasks) for metric in (SUCCESS, DISTANCE)}
    note = f"Success at the end: {ends[SUCCESS]}; distance at the end in m: {ends[DISTANCE]}"
    claim = "Indicator, balanced and filtered, performs as well as the oracle"
    return _comparison_claim(claim, _rewards(OURS, "oracle", tasks), f"[5.1, 5.2]({_INDICATOR})", ("better", "level"), note)


def _balancing() -> Claim:
    comparisons = _rewards(OURS, "indicator", (FETCH, SAWYER))
    return _comparison_claim(
        "Balancing and filtering improve on the plain indicator (Fetch and Sawyer)", comparisons, f"[5.1, 5.2]({_INDICATOR})"
    )


def filtered_share(task: str) -> float:
    """Return the fraction of negatives dropped by the filter: mean over training, median over seeds."""
    return float(np.median(indicator.run(task, OURS).means(metric="train/filtered_share")))


def _filter() -> Claim:
    fractions = {task: filtered_share(task) for task in (REACHER, FETCH, SAWYER, HAND)}
    hand = indicator.run(HAND, OURS)
    precision, chance = (hand.median(metric=f"train/{name}") for name in ("filter_precision", "false_negative_share"))
    active = [task for task, fraction in fractions.items() if fraction >= 0.01]
    comparisons = _rewards(OURS, "balance_only", (REACHER, FETCH))
    return Claim(
        "The filter removes false negatives",
        PARTLY if active else FAILS,
        f"Active (1 % of negatives or more) on {', '.join(SHORT[task] for task in active) or 'none'}; share of negatives "
        f"dropped: {', '.join(f'{SHORT[task]} {fraction:.3f}' for task, fraction in fractions.items())}. "
        f"On the hand {precision:.2f} of these are false at the end, {chance:.2f} of all negatives",
        "without the filter, " + "; ".join(comparison.text for comparison in comparisons),
        f"[the hand]({_INDICATOR}#the-hand)",
        [indicator.run(task, OURS) for task in fractions],
    )


def _false_positives() -> Claim:
    comparisons = _rewards("false_positives", "oracle", (FETCH,)) + _rewards("clutter", "oracle", (FETCH,))
    named = [
        dataclasses.replace(comparison, setting=f"Fetch, {place}")
        for comparison, place in zip(comparisons, ("anywhere", "in a cluttered quarter"), strict=True)
    ]
    claim = "False positives of a state estimator harm (here one in ten negatives is paid as a positive)"
    return _comparison_claim(claim, named, f"[estimators]({_INDICATOR}#state-estimators-that-err)", ("worse",))


def _ablation_rows(variant: str, claim: str) -> Claim:
    comparisons = _rewards(variant, OURS, (REACHER, FETCH))
    note = "Success at the end: " + ", ".join(_ends(task, (variant, OURS)) for task in (REACHER, FETCH))
    source = f"[parts of the method]({_INDICATOR}#what-each-part-of-the-method-gives)"
    return _comparison_claim(claim, comparisons, source, ("worse",), note)


def _finger() -> Claim:
    comparisons = _rewards(OURS, "oracle", (FINGER,)) + _rewards("autoencoder", "oracle", (FINGER,))
    named = [
        dataclasses.replace(comparison, setting=f"finger, {method}")
        for comparison, method in zip(comparisons, ("indicator, balanced and filtered", "autoencoder"), strict=True)
    ]
    ends = [indicator.run(FINGER, variant).median() for variant in (OURS, "oracle", "autoencoder")]
    note = (
        "Success at the end {:.3f}, {:.3f} with the oracle, {:.3f} with the autoencoder; 0.16 to 0.19 by doing nothing".format(
            *ends
        )
    )
    records = [record for comparison in named for record in (comparison.first, comparison.second)]
    return Claim(
        "Indicator rewards work from images alone (the thesis did not try the finger)",
        _outcome(named[:1], ("better", "level")),
        f"{_findings(named)}. {note}",
        "; ".join(comparison.text for comparison in named),
        f"[the finger]({_INDICATOR}#the-finger)",
        records,
    )


CLAIMS: tuple[Callable[[], Claim], ...] = (
    _better_than_none,
    _better_than_logarithm,
    _speed_ups,
    _balance_and_none,
    _balance,
    _single_tasks,
    _best_single_task,
    _cosine,
    _n_steps,
    _ablation,
    _order,
    _oracle,
    _balancing,
    _filter,
    _false_positives,
    functools.partial(_ablation_rows, "all_relabelled", "p₁ = 1 (no original goals) is clearly worse"),
    functools.partial(
        _ablation_rows, "all_next", "p₁ = 0.45, p₂ = 1 (the next observation as every replaced goal) is clearly worse"
    ),
    _finger,
)


DETAILS = (_balance_and_none, _best_single_task, _ablation, _order, CLAIMS[-2])
"""Claims that the README omits."""


@functools.cache
def claims() -> tuple[Claim, ...]:
    """Compute all claims."""
    return tuple(dataclasses.replace(make(), in_readme=make not in DETAILS) for make in CLAIMS)


def _seeds(claim: Claim) -> str:
    ranges = sorted({(record.seeds[0], record.seeds[-1]) for record in claim.records})
    return ", ".join(f"{first} to {last}" for first, last in ranges)


def _table() -> str:
    lines = ["| claim of the thesis | outcome | finding | interval | seeds | figure |", "|---|---|---|---|---|---|"]
    lines += [
        f"| {row.claim} | {row.outcome} | {row.finding} | {row.interval} | {_seeds(row)} | {row.source} |" for row in claims()
    ]
    made = origin_sentence([record for row in claims() for record in row.records])
    return "\n".join([*lines, "", made])


def _short() -> str:
    lines = ["| claim of the thesis | outcome | finding |", "|---|---|---|"]
    lines += [f"| {row.claim} | {row.outcome} | {row.finding} |" for row in claims() if row.in_readme]
    return "\n".join([*lines, "", "Intervals, p-values, seeds and figures: [Claims of the thesis](docs/claims.md)."])


def tables() -> dict[str, dict[str, str]]:
    """Return the tables, page -> marker -> text."""
    return {PAGE: {"claims": _table()}, "README.md": {"claims": _short()}}
