"""Sentences on figures ``goals`` and ``weightings`` and on contrastive RL, in the guides of these; see `prose`."""

from collections.abc import Iterator

import numpy as np

from benchmarks.claims import columns as c
from benchmarks.claims import contrastive_view, goals, weightings
from benchmarks.claims.prose import Sentence
from benchmarks.claims.records import Record, runs, variants
from jaxrl_vis.report.plots import format_steps
from jaxrl_vis.studies.goals import FAMILY as GOALS
from jaxrl_vis.studies.goals import POINT
from jaxrl_vis.studies.indicator import FETCH, FINGER, HAND, REACHER, SAWYER
from jaxrl_vis.studies.weightings import FAMILY as WEIGHTINGS

ALGORITHMS, WEIGHTING = goals.GUIDE, weightings.GUIDE
_OURS, _STATES = "indicator_balance_filter", ("oracle", "td3_oracle")


def _goals() -> Iterator[Sentence]:
    tasks = {task: variants(GOALS, task) for task in (FETCH, REACHER, SAWYER, HAND, FINGER, POINT)}
    ours = {task: records[_OURS] for task, records in tasks.items()}

    def p(task: str, first: str, second: str) -> str:
        return c.p_text(tasks[task][first], tasks[task][second], goals.BUDGETS[task])

    def verdict(task: str, first: str, second: str) -> str:
        return c.verdict(tasks[task][first], tasks[task][second], goals.BUDGETS[task])

    rivals = [name for name in tasks[SAWYER] if name not in (_OURS, *_STATES)]
    name = ours[HAND].name
    best = [verdict(task, _OURS, rival) for task in (HAND, SAWYER) for rival in rivals]
    quote = f"better than every other one on HandReach and SawyerReach ({p(HAND, _OURS, 'indicator')})"
    yield Sentence(ALGORITHMS, quote, name, best == ["better"] * len(best))
    not_worse = [verdict(task, _OURS, rival) != "worse" for task in (FETCH, REACHER) for rival in rivals]
    quote = (
        f"level with the second on FetchReach (`contrastive`, {p(FETCH, _OURS, 'contrastive')}) and Reacher (`features`, "
        f"{p(REACHER, _OURS, 'features')})"
    )
    seconds = {
        task: max(rivals, key=lambda rival: float(np.mean(tasks[task][rival].means(goals.BUDGETS[task]))))
        for task in (FETCH, REACHER)
    }
    yield Sentence(ALGORITHMS, quote, name, all(not_worse) and seconds == {FETCH: "contrastive", REACHER: "features"})
    most = max(tasks[HAND][rival].median() for rival in rivals)
    quote = f"On HandReach it is the only one that learns: {ours[HAND].median():.2f} at 500 k, the others at most {most:.2f}"
    yield Sentence(ALGORITHMS, quote, name)
    is_behind = [verdict(task, "oracle", _OURS) for task in (FETCH, SAWYER, HAND)] == ["better"] * 3
    quote = f"is better ({p(FETCH, 'oracle', _OURS)}) on all of them but Reacher ({p(REACHER, 'oracle', _OURS)})"
    yield Sentence(ALGORITHMS, quote, name, is_behind and verdict(REACHER, "oracle", _OURS) == "level")
    others = [rival for rival in tasks[POINT] if rival != "contrastive"]
    first = {verdict(POINT, "contrastive", rival) for rival in others} == {"better"}
    quote = f"better than all others, the oracle included** ({_p_of_all(tasks[POINT], 'contrastive', goals.BUDGETS[POINT])}): "
    final = tasks[POINT]["contrastive"].median()
    yield Sentence(ALGORITHMS, f"{quote}{final:.2f} at 100 k", tasks[POINT]["contrastive"].name, first)
    quote = f"level with the oracle there ({p(POINT, _OURS, 'oracle')})"
    yield Sentence(ALGORITHMS, quote, ours[POINT].name, verdict(POINT, _OURS, "oracle") == "level")
    similar = [max(tasks[task][rival].median() for rival in ("autoencoder", "features")) for task in (FETCH, SAWYER, HAND)]
    quote = "end at {:.2f} on FetchReach, {:.2f} on SawyerReach and {:.2f} on HandReach at most".format(*similar)
    yield Sentence(ALGORITHMS, quote, name)
    graded = [tasks[FINGER][rival].median() for rival in ("autoencoder", "features", "contrastive")]
    better = all(verdict(FINGER, rival, "oracle") == "better" for rival in ("autoencoder", "features", "contrastive"))
    quote = f"do better than it there: {min(graded):.2f} to {max(graded):.2f}"
    yield Sentence(ALGORITHMS, quote, tasks[FINGER]["features"].name, better)
    plain = variants(WEIGHTINGS, FINGER)["none"]
    quote = f"with a fifth of them (`trivial_goals`), which `fast` keeps by default, it reaches {plain.median():.2f}"
    yield Sentence(ALGORITHMS, quote, plain.name)
    levels = [verdict(task, "td3_oracle", "oracle") for task in (FETCH, HAND, FINGER)]
    quote = (
        f"With the oracle it is level with DDPG on FetchReach, HandReach and FingerTurn and worse on SawyerReach "
        f"({p(SAWYER, 'td3_oracle', 'oracle')}), Reacher ({p(REACHER, 'td3_oracle', 'oracle')}) and PointMass "
        f"({p(POINT, 'td3_oracle', 'oracle')})"
    )
    worse = [verdict(task, "td3_oracle", "oracle") for task in (SAWYER, REACHER, POINT)]
    yield Sentence(ALGORITHMS, quote, tasks[SAWYER]["td3_oracle"].name, levels == ["level"] * 3 and worse == ["worse"] * 3)
    quote = f"better on HandReach ({p(HAND, 'td3_ours', _OURS)}) and level on FetchReach ({p(FETCH, 'td3_ours', _OURS)})"
    is_so = [verdict(task, "td3_ours", _OURS) for task in (HAND, FETCH)] == ["better", "level"]
    yield Sentence(ALGORITHMS, quote, tasks[HAND]["td3_ours"].name, is_so)
    states = {task: variants(GOALS, task) for task in ("FetchReach", "PointMass", "Reacher")}
    pairs = [(records["contrastive"], records["oracle"], goals.BUDGETS[task]) for task, records in states.items()]
    quote = (
        "`contrastive` is level with the oracle on FetchReach ({}), better on PointMass ({}) and worse on Reacher ({})".format(
            *(c.p_text(*pair) for pair in pairs)
        )
    )
    is_so = [c.verdict(*pair) for pair in pairs] == ["level", "better", "worse"]
    yield Sentence(ALGORITHMS, quote, states["Reacher"]["contrastive"].name, is_so)


def _shifts() -> Iterator[Sentence]:
    by_pixels = runs("contrastive_shift")
    final = [by_pixels[name].median() for name in ("0", "1", "6", "1_rgbd")]
    quote = "{0:.2f} at 96 k; with shifts of 1 pixel {1:.2f} (from RGB-D {3:.2f}), of 6 pixels {2:.2f}".format(*final)
    yield Sentence(ALGORITHMS, quote, by_pixels["0"].name, final[:3] == sorted(final[:3], reverse=True))


def _view() -> Iterator[Sentence]:
    records = runs(contrastive_view.FOLDER)
    stable, nce = records["contrastive"], records["contrastive_nce"]
    level, budget = stable.steps_to(0.9), stable.end
    reached = f"`stable` reaches 0.9 at {format_steps(level) if level else 'no time'} and {stable.median():.2f} at 100 k"
    quote = f"{reached}, level with `nce` ({c.p_text(stable, nce, budget)})"
    yield Sentence(contrastive_view.GUIDE, quote, stable.name, c.verdict(stable, nce, budget) == "level")
    others = [
        (records["contrastive_cpu"], records["contrastive_nce_cpu"]),
        (records["own_contrastive"], records["own_contrastive_nce"]),
    ]
    quote = "better than `nce` ({} and {})".format(*(c.p_text(*pair, budget) for pair in others))
    is_better = all(c.verdict(*pair, budget) == "better" for pair in others)
    yield Sentence(contrastive_view.GUIDE, quote, others[0][0].name, is_better)
    longer = records["contrastive_1M"], records["own_contrastive_cpu_1M"]
    quote = "After 1 M steps it reaches {:.3f} here and {:.3f} in the own view".format(*(record.median() for record in longer))
    yield Sentence(contrastive_view.GUIDE, quote, longer[1].name)


def _weightings() -> Iterator[Sentence]:
    def verdicts(records: dict[str, Record], reference: str, budget: int) -> dict[str, str]:
        return {name: c.verdict(record, records[reference], budget) for name, record in records.items() if name != reference}

    fetch, hand, finger = (variants(WEIGHTINGS, task) for task in (FETCH, HAND, FINGER))
    steps = weightings.BUDGETS
    records = {FETCH: fetch, HAND: hand, FINGER: finger}

    def p(task: str, first: str, second: str) -> str:
        return c.p_text(records[task][first], records[task][second], steps[task])

    order = sorted(fetch, key=lambda name: -fetch[name].means(steps[FETCH]).mean())
    against_sum, against_none = (verdicts(fetch, reference, steps[FETCH]) for reference in ("sum", "none"))
    quote = (
        f"no weighting beats the plain sum, and none of them, the sum included, beats learning without auxiliary losses** "
        f"(`{order[0]}`, the first, {c.p_text(fetch[order[0]], fetch['none'], steps[FETCH])})"
    )
    is_supported = "better" not in (*against_sum.values(), *against_none.values())
    yield Sentence(WEIGHTING, quote, fetch["sum"].name, is_supported)
    level = [name for name in order if against_sum.get(name, "level") == "level"]
    quote = f"Down to `{level[-1]}`, methods are level with the sum"
    yield Sentence(WEIGHTING, quote, fetch[level[-1]].name, order[: len(level)] == level)
    falls = [_greatest_fall(fetch["imtl_g"], seed) for seed in fetch["imtl_g"].seeds]
    weights = [
        value for row in fetch["imtl_g"].rows for name, value in row.items() if name.startswith("train/weight/") and value
    ]
    quote = f"can be negative or greater than 1 (from {min(weights):.2f} to {max(weights):.1f} in the records)"
    yield Sentence(WEIGHTING, quote, fetch["imtl_g"].name)
    quote = "`imtl_g` is unstable: in each seed success falls by more than half at some time"
    yield Sentence(WEIGHTING, quote, fetch["imtl_g"].name, min(falls) > 0.5)
    helped = {HAND: hand, FINGER: finger}
    is_supported = all(set(verdicts(records, "none", steps[task]).values()) == {"better"} for task, records in helped.items())
    quote = "auxiliary losses help with every weighting** ({} on HandReach, {}; {} on FingerTurn, {})".format(
        *(part for task, records in helped.items() for part in (len(records) - 1, _p_of_all(records, "none", steps[task])))
    )
    yield Sentence(WEIGHTING, quote, hand["sum"].name, is_supported)
    against_sum = verdicts(hand, "sum", steps[HAND])
    quote = (
        f"better than the plain sum** ({p(HAND, 'ol_aux_5', 'sum')}), than the thesis's baseline `balance` "
        f"({p(HAND, 'ol_aux_5', 'balance')}), and level with `gradvac` ({p(HAND, 'ol_aux_5', 'gradvac')}), the only other "
        f"weighting that beats the sum ({p(HAND, 'gradvac', 'sum')})"
    )
    is_level = c.verdict(hand["ol_aux_5"], hand["gradvac"], steps[HAND]) == "level"
    is_supported = _with_verdict("better", against_sum) == {"ol_aux_5", "gradvac"} and is_level
    yield Sentence(WEIGHTING, quote, hand["ol_aux_5"].name, is_supported)
    quote = f"level with the sum on FetchReach ({p(FETCH, 'ol_aux_5', 'sum')}) and FingerTurn ({p(FINGER, 'ol_aux_5', 'sum')})"
    level = [
        c.verdict(fetch["ol_aux_5"], fetch["sum"], steps[FETCH]),
        c.verdict(finger["ol_aux_5"], finger["sum"], steps[FINGER]),
    ]
    yield Sentence(WEIGHTING, quote, finger["ol_aux_5"].name, level == ["level", "level"])
    scales = {"uncertainty", "imtl_l"}
    quote = f"(better than the sum, {p(FINGER, 'uncertainty', 'sum')} and {p(FINGER, 'imtl_l', 'sum')})"
    is_supported = _with_verdict("better", verdicts(finger, "sum", steps[FINGER])) == scales
    yield Sentence(WEIGHTING, quote, finger["uncertainty"].name, is_supported)
    quote = f"the worst on HandReach** (worse than the sum, {p(HAND, 'uncertainty', 'sum')})"
    yield Sentence(WEIGHTING, quote, hand["uncertainty"].name, _with_verdict("worse", against_sum) == {*scales, "none"})


def _with_verdict(verdict: str, verdicts: dict[str, str]) -> set[str]:
    return {name for name, value in verdicts.items() if value == verdict}


def _greatest_fall(record: Record, seed: int) -> float:
    """Return the greatest relative fall of a seed's success from one evaluation to the next, in 0 to 1."""
    values = [row["eval/success"] for row in record.rows if row["seed"] == seed]
    return max(1.0 - after / before for before, after in zip(values, values[1:], strict=False) if before > 0.0)


def _p_of_all(records: dict[str, Record], reference: str, budget: int) -> str:
    """Format the least and the greatest p-value of all other records against a reference, one if they are equal."""
    values = sorted({c.p_text(record, records[reference], budget) for name, record in records.items() if name != reference})
    return values[0] if len(values) == 1 else f"{values[0]} to {values[-1]}"


def sentences() -> list[Sentence]:
    """Return the sentences of this module."""
    return [*_goals(), *_shifts(), *_view(), *_weightings()]
