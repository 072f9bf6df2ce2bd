"""Sentences on figures ``goals`` and ``weightings`` in docs/algorithms.md and docs/weighting.md; see `prose`."""

from collections.abc import Iterator

import numpy as np

from benchmarks.claims import columns as c
from benchmarks.claims import goals, weightings
from benchmarks.claims.prose import Sentence
from benchmarks.claims.records import Record, variants
from jaxrl_vis.studies.goals import FAMILY as GOALS
from jaxrl_vis.studies.indicator import FETCH, FINGER, HAND, REACHER, SAWYER
from jaxrl_vis.studies.weightings import FAMILY as WEIGHTINGS

ALGORITHMS, WEIGHTING = goals.GUIDE, weightings.GUIDE
_OURS, _STATES = "indicator_balance_filter", ("oracle", "td3_oracle")


def _goals() -> Iterator[Sentence]:
    tasks = {task: variants(GOALS, task) for task in (FETCH, REACHER, SAWYER, HAND, FINGER)}
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
        f"({p(SAWYER, 'td3_oracle', 'oracle')}) and Reacher ({p(REACHER, 'td3_oracle', 'oracle')})"
    )
    worse = [verdict(task, "td3_oracle", "oracle") for task in (SAWYER, REACHER)]
    yield Sentence(ALGORITHMS, quote, tasks[SAWYER]["td3_oracle"].name, levels == ["level"] * 3 and worse == ["worse"] * 2)
    quote = f"better on HandReach ({p(HAND, 'td3_ours', _OURS)}) and level on FetchReach ({p(FETCH, 'td3_ours', _OURS)})"
    is_so = [verdict(task, "td3_ours", _OURS) for task in (HAND, FETCH)] == ["better", "level"]
    yield Sentence(ALGORITHMS, quote, tasks[HAND]["td3_ours"].name, is_so)
    states = {task: variants(GOALS, task) for task in ("FetchReach", "Reacher")}
    ps = [c.p_text(records["contrastive"], records["oracle"], goals.BUDGETS[task]) for task, records in states.items()]
    quote = f"`contrastive` is level with the oracle on FetchReach ({ps[0]}) and worse on Reacher ({ps[1]})"
    verdicts = [c.verdict(records["contrastive"], records["oracle"], goals.BUDGETS[task]) for task, records in states.items()]
    yield Sentence(ALGORITHMS, quote, states["Reacher"]["contrastive"].name, verdicts == ["level", "worse"])


def _weightings() -> Iterator[Sentence]:
    def verdicts(records: dict[str, Record], reference: str, budget: int) -> dict[str, str]:
        return {name: c.verdict(record, records[reference], budget) for name, record in records.items() if name != reference}

    fetch, finger = (variants(WEIGHTINGS, task) for task in (FETCH, FINGER))
    steps = weightings.BUDGETS
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
    against_none = verdicts(finger, "none", steps[FINGER])
    count, p = len(finger) - 1, _p_of_all(finger, "none", steps[FINGER])
    quote = f"On FingerTurn five auxiliary losses help with each of {count} weightings** ({p})"
    yield Sentence(WEIGHTING, quote, finger["sum"].name, set(against_none.values()) == {"better"})
    against_sum = verdicts({name: record for name, record in finger.items() if name != "none"}, "sum", steps[FINGER])
    first = [c.p_text(finger[name], finger["sum"], steps[FINGER]) for name in ("uncertainty", "imtl_l", "ol_aux_5")]
    quote = "`uncertainty` and `imtl_l` are better than the plain sum ({} and {}), the others, `ol_aux_5` included ({})".format(
        *first
    )
    better = {name for name, value in against_sum.items() if value == "better"}
    is_supported = better == {"uncertainty", "imtl_l"} and "worse" not in against_sum.values()
    yield Sentence(WEIGHTING, quote, finger["uncertainty"].name, is_supported)


def _greatest_fall(record: Record, seed: int) -> float:
    """Return the greatest relative fall of a seed's success from one evaluation to the next, in 0 to 1."""
    values = [row["eval/success"] for row in record.rows if row["seed"] == seed]
    return max(1.0 - after / before for before, after in zip(values, values[1:], strict=False) if before > 0.0)


def _p_of_all(records: dict[str, Record], reference: str, budget: int) -> str:
    """Format the p-value against a reference that all other records share."""
    values = {c.p_text(record, records[reference], budget) for name, record in records.items() if name != reference}
    return " to ".join(sorted(values))


def sentences() -> list[Sentence]:
    """Return the sentences of this module."""
    return [*_goals(), *_weightings()]
