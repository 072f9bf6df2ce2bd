"""Sentences about the study of auxiliary losses (figures 5.4 to 5.7), with computed numbers and verdicts; see `prose`."""

from collections.abc import Iterator

import numpy as np

from benchmarks.claims import columns as c
from benchmarks.claims import ol_aux
from benchmarks.claims.ol_aux import LAB
from benchmarks.claims.prose import Sentence
from benchmarks.claims.records import Record, ablation, learning, study
from jaxrl_vis.studies.ol_aux import AUX_TASKS, FETCH, FINGER, HAND

RESULTS = "docs/lab/results.md"


def _logarithm() -> Iterator[Sentence]:
    alone, ours, none = (
        {task: ol_aux.claim(task, name) for task in (FETCH, HAND, FINGER)} for name in ("none_log", "ol_aux_5", "none")
    )
    name, budgets = alone[HAND].name, ol_aux.BUDGETS
    against_ours = {task: f"({c.p_text(alone[task], ours[task], budgets[task])})" for task in budgets}
    verdicts = {task: c.verdict(alone[task], ours[task], budgets[task]) for task in budgets}
    quote = f"seeds) is better than OL-AUX-5 on FetchReach {against_ours[FETCH]}, where"
    yield Sentence(LAB, quote, alone[FETCH].name, verdicts[FETCH] == "better")
    quote = (
        f"better than none ({c.p_text(alone[HAND], none[HAND], budgets[HAND])}) and worse than OL-AUX-5 {against_ours[HAND]},"
    )
    is_better = c.verdict(alone[HAND], none[HAND], budgets[HAND]) == "better"
    yield Sentence(LAB, quote, name, is_better and verdicts[HAND] == "worse")
    p = c.p_text(alone[FINGER], none[FINGER], budgets[FINGER])
    quote = f"on the finger level with none ({p}) and worse than OL-AUX-5 {against_ours[FINGER]}"
    is_level = c.verdict(alone[FINGER], none[FINGER], budgets[FINGER]) == "level"
    yield Sentence(LAB, quote, alone[FINGER].name, is_level and verdicts[FINGER] == "worse")


def _sum() -> Iterator[Sentence]:
    places = ((FINGER, "on the finger", "better"), (HAND, "likewise on the hand", "better"), (FETCH, "on FetchReach", "worse"))
    for task, place, verdict in places:
        plain, *others = (ol_aux.claim(task, name) for name in ("sum", "none", "balance", "ol_aux_5"))
        budget = ol_aux.BUDGETS[task]
        none, balance, ours = (f"({c.p_text(plain, other, budget)})" for other in others)
        conjunction = "and" if verdict == "better" else "as well as"
        quote = f"{place} {verdict} than none {none} {conjunction}"
        quote += f" worse than balancing {balance} and OL-AUX-5 {ours}" if verdict == "better" else f" than balancing {balance}"
        is_supported = [c.verdict(plain, other, budget) for other in others] == [verdict, "worse", "worse"]
        yield Sentence(LAB, quote, plain.name, is_supported)


def _fixed() -> Iterator[Sentence]:
    p, verdicts = {}, {}
    for task, budget in ol_aux.BUDGETS.items():
        tenth, *others = (ol_aux.claim(task, name) for name in ("fixed_0.1", "none", "balance"))
        p[task] = [f"({c.p_text(tenth, other, budget)})" for other in others]
        verdicts[task] = [c.verdict(tenth, other, budget) for other in others]
    name = ol_aux.claim(HAND, "fixed_0.1").name
    quote = f"is better than none on FetchReach {p[FETCH][0]}, the hand {p[HAND][0]} and the finger {p[FINGER][0]}."
    yield Sentence(LAB, quote, name, all(none == "better" for none, _ in verdicts.values()))
    quote = f"on the hand {p[HAND][1]} and the finger {p[FINGER][1]}, and level with it on FetchReach {p[FETCH][1]}."
    yield Sentence(LAB, quote, name, [verdicts[task][1] for task in (HAND, FINGER, FETCH)] == ["worse", "worse", "level"])


def _cosine() -> Iterator[Sentence]:
    on_none = "worse than none on FetchReach {} and better on the hand {} and the finger {}."
    of_sum = "is better on the hand {}, worse on the finger {}, and level on FetchReach {}."
    for reference, order, verdicts, quote in (
        ("none", (FETCH, HAND, FINGER), ["worse", "better", "better"], on_none),
        ("sum", (HAND, FINGER, FETCH), ["worse", "better", "level"], of_sum),  # verdicts on cosine, quote on the sum
    ):
        pairs = [(ol_aux.claim(task, "cosine"), ol_aux.claim(task, reference), ol_aux.BUDGETS[task]) for task in order]
        p = [f"({c.p_text(*pair)})" for pair in pairs]
        yield Sentence(LAB, quote.format(*p), pairs[0][0].name, [c.verdict(*pair) for pair in pairs] == verdicts)


def _release() -> Iterator[Sentence]:
    release, *others = (ol_aux.claim(FETCH, name) for name in ("ol_aux_5_release", "none", "balance", "ol_aux_5"))
    budget, ours = ol_aux.BUDGETS[FETCH], others[-1]
    p = [f"({c.p_text(release, other, budget)})" for other in others]
    quote = f"on FetchReach level with none {p[0]}, and worse than balancing {p[1]} and OL-AUX-5 {p[2]}."
    is_supported = [c.verdict(release, other, budget) for other in others] == ["level", "worse", "worse"]
    yield Sentence(LAB, quote, release.name, is_supported)
    ends = [record.median(metric="train/weight/inverse_dynamics") for record in (release, ours)]
    quote = "that of inverse dynamics is {:,.0f} at the end, and {:.0f} with ours (medians)".format(*ends)
    yield Sentence(LAB, quote, release.name)


def _options() -> Iterator[Sentence]:
    budgets = ol_aux.OPTION_BUDGETS
    ours, tried = {task: ol_aux.run(task, "ol_aux_5") for task in budgets}, {task: ol_aux.options(task) for task in budgets}

    def compare(option: str, task: str, like: Record | None = None) -> tuple[str, str]:
        pair = tried[task][f"ol_aux_5_{option}"], like or ours[task], budgets[task]
        return c.verdict(*pair), c.p_text(*pair)

    options = [variant.removeprefix("ol_aux_5_") for variant in tried[FETCH]]
    verdicts = {option: [compare(option, task)[0] for task in budgets] for option in options}
    quote = "None of these is better than OL-AUX-5 as it is"
    yield Sentence(LAB, quote, ours[FETCH].name, "better" not in sum(verdicts.values(), []))
    quote = "heads that always learn, a maximum or a fixed sum of the weights, and Adam's direction"
    level = all(verdicts[option] == ["level"] * 2 for option in ("heads", "maximum_5", "total_5", "adam"))
    yield Sentence(LAB, quote, ours[HAND].name, level)
    (_, p_fetch), (_, p_hand) = (compare("eps_0.001", task) for task in budgets)
    quote = f"The smaller number in the logarithm is worse on both ({p_fetch} and {p_hand})"
    yield Sentence(LAB, quote, ours[FETCH].name, verdicts["eps_0.001"] == ["worse"] * 2)
    (_, p_100), (_, p_400) = (compare(option, HAND) for option in ("beta_100", "beta_400"))
    quote = f"level on FetchReach and worse on the hand, `beta_100` ({p_100}) as well as `beta_400` ({p_400})"
    fast = [verdicts[option] for option in ("beta_100", "beta_400")]
    yield Sentence(LAB, quote, ours[HAND].name, fast == [["level", "worse"]] * 2)
    pairs = [compare("actor", task, tried[task]["ol_aux_5_loss"]) for task in budgets]
    quote = f"Weights of the actor's own are level with `loss` ({pairs[0][1]} and {pairs[1][1]})"
    yield Sentence(LAB, quote, ours[HAND].name, [verdict for verdict, _ in pairs] == ["level"] * 2)


def _weightings() -> Iterator[Sentence]:
    run = ol_aux.run
    none, ours, balance = (
        {task: run(task, name) for task in (FETCH, HAND, FINGER)} for name in ("none", "ol_aux_5", "balance")
    )
    verdicts = [c.verdict(ours[task], none[task], budget) for task, budget in ol_aux.BUDGETS.items()]
    quote = "**OL-AUX-5 is better than no auxiliary losses on all three tasks**"
    yield Sentence(LAB, quote, ours[HAND].name, verdicts == ["better"] * 3)
    ends = ((HAND, 2_000_000), (FINGER, 1_480_000))
    verdicts = [c.verdict(run(task, "cosine"), other[task], budget) for other in (none, balance) for task, budget in ends]
    quote = "better than none and worse than balancing on hand and finger"
    yield Sentence(LAB, quote, run(HAND, "cosine").name, verdicts == ["better"] * 2 + ["worse"] * 2)
    low, high = (c.speed_up(ours[HAND], none[HAND], level) for level in (0.2, 0.65))
    yield Sentence(LAB, f"on the hand {low} times to 0.2 and {high} times to 0.65", ours[HAND].name)
    yield Sentence(
        LAB,
        f"on FetchReach ({c.p_text(ours[FETCH], balance[FETCH], 240_000)}), on the finger "
        f"({c.p_text(ours[FINGER], balance[FINGER], 1_480_000)}) and on the hand to 1 M steps "
        f"({c.p_text(ours[HAND], balance[HAND], 1_000_000)}). Over 2 M steps it is better on the hand "
        f"({c.p_text(ours[HAND], balance[HAND], 2_000_000)}): {ours[HAND].median(2_000_000):.3f} against "
        f"{balance[HAND].median(2_000_000):.3f} at the end",
        balance[HAND].name,
    )
    yield Sentence(
        LAB,
        f"level with none on FetchReach ({c.p_text(run(FETCH, 'cosine'), none[FETCH], 240_000)})",
        run(FETCH, "cosine").name,
    )
    authors = c.authors(HAND, "none", 2_000_000)
    yield Sentence(
        LAB, f"{none[HAND].median(2_000_000):.3f} against {authors.median(2_000_000):.3f} at 2 M steps", none[HAND].name
    )
    view = run(HAND, "none", ol_aux.VIEW)
    yield Sentence(
        LAB,
        f"falls from {ol_aux.to_authors(none[HAND], HAND)} to {ol_aux.to_authors(view, HAND)}.",
        view.name,
    )
    authors = c.authors(FINGER, "none", 2_480_000)
    yield Sentence(
        LAB, f"{none[FINGER].median(2_480_000):.3f} against {authors.median(2_480_000):.3f} at 2.48 M", none[FINGER].name
    )
    fraction = np.median(none[FINGER].means(metric="train/positive_share"))
    yield Sentence(
        LAB, f"{fraction:.0%}".replace("%", " %") + " of its relabelled goals are reached already", none[FINGER].name
    )
    faster = study("target_decay", f"{FINGER}-none-paper-decay0.95", is_fresh=True)
    yield Sentence(
        LAB,
        f"the distance falls from {ol_aux.to_authors(none[FINGER], FINGER)} to {ol_aux.to_authors(faster, FINGER)}",
        faster.name,
    )
    ten, cross, several = (ablation(f"fetch_paper_10seeds_{name}") for name in ("none", "cross", "all"))
    yield Sentence(
        LAB,
        f"{ol_aux.to_authors(none[FETCH], FETCH)} with seeds 0 to 4, and {ol_aux.to_authors(ten, FETCH)} with seeds 0 to 9",
        ten.name,
    )
    yield Sentence(LAB, f"nearest to theirs, {ol_aux.to_authors(cross, FETCH)}.", cross.name)
    yield Sentence(LAB, f"level with `paper` ({c.p_text(cross, ten, 240_000)})", cross.name)
    yield Sentence(LAB, f"better than `paper` ({c.p_text(several, ten, 240_000)})", several.name)
    first_five = float(np.median(ten.at(100_000)[:5]))
    three = (none[FETCH].median(100_000), learning("fetch_reach_paper").median(100_000), first_five)
    for page in (LAB, RESULTS):
        yield Sentence(page, "have {:.2f}, {:.2f} and {:.2f} at 100 k steps".format(*three), ten.name)


def _single_tasks() -> Iterator[Sentence]:
    run = ol_aux.run
    ours, alone = ({task: run(task, name) for task in (FETCH, HAND, FINGER)} for name in ("ol_aux_5", "inverse_dynamics"))
    p = {task: c.p_text(ours[task], alone[task], ol_aux.BUDGETS[task]) for task in ours}
    yield Sentence(LAB, f"on FetchReach ({p[FETCH]}) and on the hand ({p[HAND]})**", alone[HAND].name)
    yield Sentence(LAB, f"level with it on the finger ({p[FINGER]})", alone[FINGER].name)
    ends = [runs[HAND].median(1_000_000) for runs in (ours, alone)]
    below = all(a < b for (_, a), (_, b) in zip(ours[HAND].points[:25], alone[HAND].points, strict=True))
    quote = "is below that of inverse dynamics at every evaluation to 1 M steps, where they have {:.3f} and {:.3f}".format(
        *ends
    )
    yield Sentence(LAB, quote, ours[HAND].name, below)
    others = {name: c.verdict(ours[FETCH], run(FETCH, name), 240_000) for name in AUX_TASKS}
    quote = "On FetchReach OL-AUX-5 is level with forward dynamics, autoencoder and optical flow, and better than egomotion"
    level = [others[name] for name in ("forward_dynamics", "autoencoder", "optical_flow")]
    yield Sentence(LAB, quote, ours[FETCH].name, level == ["level"] * 3 and others["egomotion"] == "better")
    forward = run(HAND, "forward_dynamics")
    quote = "on the hand two of five seeds learn next to nothing with it"
    yield Sentence(LAB, quote, forward.name, int((forward.at(1_000_000) < 0.05).sum()) == 2)
    ps = [
        c.p_value(run(task, name), run(task, "ol_aux_5"), budget)
        for task, budget in ((FETCH, 240_000), (HAND, 600_000))
        for name in ("ol_aux_1", "ol_aux_5_ablation")
    ]
    yield Sentence(LAB, f"(p from {min(ps):.3f} to {max(ps):.3f})", run(HAND, "ol_aux_1").name)
    fresh, budget = ol_aux.claim(FETCH, "ol_aux_5"), ol_aux.BUDGETS[FETCH]
    one, ablated = (run(FETCH, name) for name in ("ol_aux_1", "ol_aux_5_ablation"))
    quote = (
        f"OL-AUX-1 stays level on FetchReach ({c.p_text(one, fresh, budget)}), and the ablation is worse there "
        f"({c.p_text(ablated, fresh, budget)})"
    )
    is_supported = [c.verdict(record, fresh, budget) for record in (one, ablated)] == ["level", "worse"]
    yield Sentence(LAB, quote, ablated.name, is_supported)


def sentences() -> list[Sentence]:
    """Return the sentences of this module."""
    parts = (_weightings, _logarithm, _sum, _fixed, _cosine, _release, _options, _single_tasks)
    return [sentence for part in parts for sentence in part()]
