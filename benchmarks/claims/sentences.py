"""Sentences of the pages with computed numbers and verdicts; see `prose`."""

from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.claims import columns as c
from benchmarks.claims import comparison_sentences, indicator, ol_aux, ol_aux_sentences, thesis
from benchmarks.claims.ablations import FAST, OPTIONS
from benchmarks.claims.indicator import LAB as RULES
from benchmarks.claims.indicator import OURS, REACHER, SAWYER
from benchmarks.claims.prose import Sentence
from benchmarks.claims.records import DISTANCE, Record, ablation, learning, study
from jaxrl_vis.studies.ol_aux import FETCH, FINGER, HAND

DECAY, RESULTS = "docs/lab/target_decay.md", "docs/lab/results.md"
GUIDE, REWARDS = ol_aux.GUIDE, indicator.GUIDE


def _all_have_verdict(verdict: str, records: Sequence[Record], reference: Record) -> bool:
    return all(c.verdict(record, reference) == verdict for record in records)


def _indicator() -> Iterator[Sentence]:
    run = indicator.run
    ours, oracle = ({task: run(task, name) for task in (REACHER, FETCH, SAWYER, HAND, FINGER)} for name in (OURS, "oracle"))
    ends = {record: record.median() for record in (*ours.values(), *oracle.values())}
    quote = (
        f"more slowly than the oracle ({c.p_text(ours[FETCH], oracle[FETCH])}), ends about as successful "
        f"({ends[ours[FETCH]]:.3f} against {ends[oracle[FETCH]]:.3f})"
    )
    yield Sentence(RULES, quote, ours[FETCH].name)
    nxt, relabelled = ({task: run(task, name) for task in (REACHER, FETCH)} for name in ("all_next", "all_relabelled"))
    ps = {c.p_text(nxt[task], ours[task]) for task in nxt}
    yield Sentence(RULES, f"worse on both ({' and '.join(sorted(ps))})", nxt[FETCH].name)
    yield Sentence(
        RULES,
        f"({c.p_text(relabelled[FETCH], ours[FETCH])}) but not lost, {relabelled[FETCH].median():.3f} at the end; on "
        f"Reacher success over training is level ({c.p_text(relabelled[REACHER], ours[REACHER])})",
        relabelled[FETCH].name,
    )
    yield Sentence(
        RULES,
        f"({c.p_text(ours[SAWYER], oracle[SAWYER])}) and a little less successful at the end, {ends[ours[SAWYER]]:.3f} against "
        f"{ends[oracle[SAWYER]]:.3f}",
        ours[SAWYER].name,
    )
    yield Sentence(RULES, f"level over training ({c.p_text(ours[SAWYER], run(SAWYER, 'indicator'))})", ours[SAWYER].name)
    hand = ours[HAND]
    precision, chance = (hand.median(metric=f"train/{name}") for name in ("filter_precision", "false_negative_share"))
    dropped, false = (np.median(hand.means(metric=f"train/{name}")) for name in ("filtered_share", "filtered_false_share"))
    yield Sentence(
        RULES,
        f"at the end {precision:.3f} of what it drops is false, twice the share among all negatives, {chance:.3f}. Over "
        f"training it was {false / dropped:.3f}",
        hand.name,
    )
    positive = oracle[FINGER].median(metric="train/positive_share")
    yield Sentence(RULES, "four of five relabelled rewards are positive", oracle[FINGER].name, 0.78 < positive < 0.85)
    fast = learning("finger_turn_oracle")
    yield Sentence(RULES, f"the oracle is at {fast.median(500_000):.2f} by then", fast.name)
    p = {name: c.p_text(run(FETCH, name), oracle[FETCH]) for name in ("false_positives", "clutter", "state_noise")}
    yield Sentence(
        RULES,
        f"anywhere ({p['false_positives']}) or in a quarter of the workspace only ({p['clutter']})",
        run(FETCH, "clutter").name,
    )
    yield Sentence(RULES, f"harms ({p['state_noise']})", run(FETCH, "state_noise").name)


def _options() -> Iterator[Sentence]:
    hand = learning("hand_reach_oracle")
    yield Sentence(OPTIONS, f"the median is {hand.median(2_000_000):.2f}", hand.name)
    twenty = ablation("fetch_25_20seeds_base")
    fives = np.median(twenty.at(15_000).reshape(4, 5), axis=1)
    quote = f"the four fives of the first row below have medians from {fives.min():.2f} to {fives.max():.2f} at 15 k steps"
    yield Sentence(OPTIONS, quote, twenty.name)


def _parts_of_the_method() -> Iterator[Sentence]:
    run = indicator.run
    others = [run(REACHER, name) for name in ("autoencoder", "indicator", OURS)]
    quote = "On Reacher the four are level"
    yield Sentence(RULES, quote, others[2].name, _all_have_verdict("level", others, run(REACHER, "oracle")))
    quote = "with and without it the method is level on both"
    pairs = [c.verdict(run(task, OURS), run(task, "balance_only")) for task in (REACHER, FETCH)]
    yield Sentence(RULES, quote, run(FETCH, "balance_only").name, pairs == ["level"] * 2)
    ours, fetch = run(FETCH, OURS), "FetchReach"
    false = ours.median(metric="train/false_negative_share")
    value = ours.median(metric="train/value_at_goals")
    quote = f"up to {false:.0%} of FetchReach's are false".replace("%", " %")
    yield Sentence(RULES, quote, ours.name)
    yield Sentence(RULES, f"value at goals stays near {value:.0f}, half of q₀ = 49", ours.name)
    ratio = run(REACHER, "all_relabelled").median(metric=DISTANCE) / run(REACHER, OURS).median(metric=DISTANCE)
    yield Sentence(RULES, f"the distance at the end is {ratio:.0f} times that of the whole method", run(REACHER, OURS).name)
    ratio = run(fetch, "oracle").median(metric=DISTANCE) / run(fetch, OURS).median(metric=DISTANCE)
    yield Sentence(RULES, f"{ratio:.0f} times as precisely as by the oracle", run(fetch, OURS).name)
    states = [run("Reacher", name) for name in ("indicator", OURS)]
    quote = "On Reacher indicator methods are level with the oracle over training"
    yield Sentence(RULES, quote, states[1].name, _all_have_verdict("level", states, run("Reacher", "oracle")))
    ablated = ("all_next", "all_relabelled")
    worse = all(
        _all_have_verdict("worse", [run(task, name) for name in ablated], run(task, "oracle")) for task in ("Reacher", fetch)
    )
    yield Sentence(RULES, "Both ablations are worse than the oracle on either task", run(fetch, OURS).name, worse)
    level = [
        c.verdict(run(FETCH, f"{who}_{how}"), run(FETCH, plain))
        for who, plain in (("oracle", "oracle"), ("ours", OURS))
        for how in ("noise", "randomized")
    ]
    yield Sentence(RULES, "all are level with plain images", run(FETCH, "ours_noise").name, level == ["level"] * 4)
    fast, slow = learning("fetch_reach_oracle").steps_to(0.97), run(FETCH, "oracle").steps_to(0.97)
    quote = f"the oracle is at 0.97 after {c.format_steps(fast)} steps in the place of {c.format_steps(slow)}"
    yield Sentence(RULES, quote, "learning/fetch_reach_oracle")


def _choices() -> Iterator[Sentence]:
    """Yield the recommendations of the guides, based on fresh seeds if there are any."""
    claim, tasks = ol_aux.claim, ol_aux.BUDGETS
    against = {
        other: [c.verdict(claim(task, "balance"), claim(task, other), tasks[task]) for task in tasks]
        for other in ("none", "ol_aux_5")
    }
    quote = (
        "better than none on all three tasks. OL-AUX-5 is better on the hand and on par on the other two within these budgets"
    )
    by_task = dict(zip(tasks, against["ol_aux_5"], strict=True))
    is_supported = against["none"] == ["better"] * 3 and by_task == {FETCH: "level", HAND: "worse", FINGER: "level"}
    yield Sentence(GUIDE, quote, claim(HAND, "balance").name, is_supported)
    quote = "over 2 M steps it is better than balancing on the hand"
    long = [claim(HAND, name, 2_000_000) for name in ("ol_aux_5", "balance")]
    yield Sentence(GUIDE, quote, long[0].name, c.verdict(*long, 2_000_000) == "better")
    alone = [c.verdict(claim(task, "inverse_dynamics"), claim(task, "ol_aux_5"), tasks[task]) for task in (FETCH, HAND, FINGER)]
    quote = "is better than OL-AUX-5 with all five on FetchReach and the hand, worse on the finger"
    yield Sentence(GUIDE, quote, claim(HAND, "inverse_dynamics").name, alone == ["better", "better", "worse"])
    ours = {task: indicator.run(task, OURS) for task in (REACHER, FETCH, SAWYER)}
    oracle = {task: indicator.run(task, "oracle") for task in ours}
    nearer = [ours[task].median(metric=DISTANCE) < oracle[task].median(metric=DISTANCE) for task in (FETCH, SAWYER)]
    near = all(abs(ours[task].median() - oracle[task].median()) < 0.05 for task in ours)
    quote = (
        "FetchReach, the Sawyer and Reacher end about as successful as with true states, and on the first two closer to the "
        "goal"
    )
    yield Sentence(REWARDS, quote, ours[FETCH].name, near and all(nearer))


def _fast() -> Iterator[Sentence]:
    base = learning("fetch_reach_oracle")
    names = {name: ablation(f"fetch_fast_now_{name}") for name in ("ol_aux_5", "sum", "fixed_01", "fixed_1", "fixed_10")}
    verdicts = {name: c.verdict(record, base, 25_000) for name, record in names.items()}
    quote = "all but fixed weights of 10, which are worse, are level with no auxiliary losses"
    yield Sentence(FAST, quote, base.name, [*verdicts.values()] == ["level"] * 4 + ["worse"])
    rest = ("none", "sum", "fixed_01", "fixed_1", "fixed_10")
    hand = ablation("hand_fast_ol_aux_5")
    quote = "OL-AUX-5 is better than every fixed weight that was tried, than the plain sum and than none"
    is_supported = all(c.verdict(hand, ablation(f"hand_fast_{name}"), 300_000) == "better" for name in rest)
    yield Sentence(FAST, quote, hand.name, is_supported)
    finger = ablation("finger_fast_ol_aux_5")
    verdicts = {name: c.verdict(finger, ablation(f"finger_fast_{name}"), 125_000) for name in rest}
    quote = "OL-AUX-5 is level with fixed weights of 10 and with the plain sum, and better than the others"
    level = {name for name, verdict in verdicts.items() if verdict == "level"}
    yield Sentence(FAST, quote, finger.name, level == {"sum", "fixed_10"} and "worse" not in verdicts.values())


def _devices() -> Iterator[Sentence]:
    four, one = (ablation(f"fetch_28_environments_on_{name}") for name in ("four_gpus", "one_gpu"))
    quote = "is at 0.97 by {} steps, and by {} on one".format(*(c.steps_cell(record, 0.97) for record in (four, one)))
    yield Sentence("docs/scaling.md", quote, four.name, c.verdict(four, one) == "level")


def _decays() -> Iterator[Sentence]:
    """Yield the sentences of the page on target networks, whose tables are written by `benchmarks.target_decay`."""

    def run(task: str, variant: str, decay: float) -> Record:
        if decay == 0.98 and task == FETCH:
            return study("target_decay", f"{task}-{variant}-paper-decay0.98", is_fresh=True)
        return ol_aux.run(task, variant) if decay == 0.98 and task == FINGER else thesis.with_decay(task, variant, decay)

    def times(task: str, level: float, decay: float) -> str:
        return c.speed_up(run(task, "ol_aux_5", decay), run(task, "none", decay), level)

    distances = {
        (task, decay): ol_aux.to_authors(run(task, "none", decay), task)
        for task in (FETCH, HAND, FINGER)
        for decay in (0.98, 0.95)
    }
    yield Sentence(
        DECAY,
        f"lies {distances[FINGER, 0.95]} from theirs at 0.95, and {distances[FINGER, 0.98]} at 0.98; on the hand "
        f"{distances[HAND, 0.95]} and {distances[HAND, 0.98]}",
        run(FINGER, "none", 0.95).name,
    )
    quote = f"is ours at 0.98 ({distances[FETCH, 0.98]}), not at 0.95 ({distances[FETCH, 0.95]})"
    yield Sentence(DECAY, quote, run(FETCH, "none", 0.95).name)
    p = [c.p_value(run(FETCH, "ol_aux_5", decay), run(FETCH, "none", decay), 240_000) for decay in (0.98, 0.95, 0.9)]
    short = [f"{p[0]:.3f}"[1:], f"{p[1]:.2f}"[1:], f"{p[2]:.2f}"[1:]]
    quote = "At 0.98 it is better than none (p = {}); at 0.95 and 0.9 it is level (p = {} and {})".format(*short)
    yield Sentence(DECAY, quote, run(FETCH, "ol_aux_5", 0.95).name)
    finger = [times(FINGER, 0.3, decay) for decay in (0.98, 0.95, 0.9)]
    hand = [times(HAND, 0.2, decay) for decay in (0.98, 0.95)]
    yield Sentence(
        DECAY,
        f"On the finger 0.3 takes {finger[0]}, {finger[1]} and {finger[2]} times fewer steps at 0.98, 0.95 and 0.9, but 0.5 "
        f"only {times(FINGER, 0.5, 0.9)} times fewer at 0.9. On the hand 0.2 takes {hand[0]} and {hand[1]} "
        "times fewer at 0.98 and 0.95.",
        run(FINGER, "ol_aux_5", 0.9).name,
    )
    faster, slower = run(FETCH, "none", 0.95).means(240_000).mean(), run(FETCH, "ol_aux_5", 0.98).means(240_000).mean()
    quote = "none at 0.95 is ahead of OL-AUX-5 at 0.98"
    yield Sentence(DECAY, quote, run(FETCH, "none", 0.95).name, bool(faster > slower))


def sentences() -> list[Sentence]:
    """Return all registered sentences."""
    parts = (
        _indicator,
        _parts_of_the_method,
        _choices,
        _options,
        _fast,
        _devices,
        _decays,
    )
    return [
        *ol_aux_sentences.sentences(),
        *comparison_sentences.sentences(),
        *(sentence for part in parts for sentence in part()),
    ]
