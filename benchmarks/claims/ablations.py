"""Tables of runs with a few options changed: docs/lab/learner_options.md, docs/lab/weightings_fast.md, docs/learner.md."""

from collections.abc import Sequence

from benchmarks.claims import columns as c
from benchmarks.claims.markdown import Row, table
from benchmarks.claims.records import DISTANCE, ablation, learning, study

GUIDE, OPTIONS, FAST = "docs/learner.md", "docs/lab/learner_options.md", "docs/lab/weightings_fast.md"
_K = 1_000


def _at(*thousands: float) -> list[c.Column]:
    return [c.median_at(round(count * _K)) for count in thousands]


def _rows(labels: Sequence[tuple[str, str]]) -> list[Row]:
    """Return the rows of ablations, from pairs of label and file name; without a name, a row has no record."""
    return [Row(label, ablation(name) if name else None) for label, name in labels]


def _hand() -> str:
    rows = [
        *_rows(
            [
                ("one encoder, `--actor-interval 2`", "hand_shared"),
                ("and layer normalisation", "hand_shared_ln"),
                ("and layer normalisation, two critics", "hand_shared_ln_2q"),
                ("and layer normalisation, `--random-shift 3`", "hand_shared_ln_shift"),
                ("`--random-shift 4`", "hand_shift4"),
            ]
        ),
        Row("`--random-shift 2`: `fast`", learning("hand_reach_oracle")),
        Row("that and auxiliary losses, OL-AUX-5", ablation("hand_shared_shift2_ol_aux_5")),
    ]
    return table(["VisualHandReach"], rows, [c.seeds(), *_at(300, 500, 700), c.names()])


def _fetch_100() -> str:
    rows = _rows(
        [
            ("an encoder for each network", "fetch_none_60k"),
            ("one encoder", "fetch_i1"),
            ("one encoder, `--actor-interval 2`", "fetch_i2"),
            ("one encoder, layer normalisation", "fetch_ln"),
            ("one encoder, `--random-action-probability 0.1`", "fetch_i1_r1"),
            ("an encoder for each network, `--action-penalty 0.1`", "fetch_penalty"),
            ("one encoder, indicator rewards, balanced and filtered", "fetch_reach_indicator_shared"),
        ]
    )
    return table(["VisualFetchReach, 100 environments"], rows, [c.seeds(), *_at(10, 15, 20, 25, 30, 40), c.names()])


def _reacher() -> str:
    rows = [Row("`fast`", learning("reacher_oracle")), Row("one encoder", ablation("reacher_oracle_shared"))]
    distance = c.median_at(80 * _K, 3, DISTANCE, "distance in m at 80 k")
    return table(["VisualReacher, 100x100"], rows, [c.seeds(), distance, c.names()])


def _fetch_environments() -> str:
    rows = _rows(
        [
            ("`--num-envs 50 --updates-per-iteration 100`", "fetch_50"),
            ("`--num-envs 25 --updates-per-iteration 50`", "fetch_25"),
            ("`--num-envs 10 --updates-per-iteration 20`", "fetch_25_e10"),
            ("25 environments, `--random-shift 2`", "fetch_25_shift2"),
            ("50 environments, `--random-shift 2`", "fetch_50_shift2"),
            ("25 environments, `--batch-size 1024`", "fetch_25_b1024"),
            ("25 environments, `--batch-size 2048`", "fetch_25_b2048"),
            ("25 environments, `--random-shift 2 --batch-size 1024`", "fetch_25_shift2_b1024"),
            ("25 environments, `--target-decay 0.97`", "fetch_25_decay97"),
            ("25 environments, learning rates of 0.0015", "fetch_25_lr15"),
            ("25 environments, `--relabel-probability 0.8`", "fetch_25_rp8"),
            ("25 environments, `--random-action-probability 0.1`", "fetch_25_rap1"),
            ("25 environments, `--n-step 3`", "fetch_25_n3"),
        ]
    )
    return table(["VisualFetchReach, one encoder"], rows, [c.seeds(), *_at(10, 12.5, 15, 17.5), c.names()])


TWENTY = {
    "2 pixels (`fast` at first)": "base",
    "3 pixels": "shift3",
    "4 pixels": "shift4",
    "5 pixels": "shift5",
    "6 pixels": "shift6",
    "8 pixels": "shift8",
    "2 pixels, `--balance-probability 0.2` (0.3 by the record's name)": "balance3",
    "2 pixels, `--relabel-probability 0.8`": "relabel8",
    "2 pixels, `--discount 0.95`": "discount95",
    "2 pixels, `--num-envs 20 --updates-per-iteration 40`": "envs20",
    "2 pixels, `--critic-learning-rate 0.002`": "lr2",
    "2 pixels, `--actor-learning-rate 0.0005`": "actorlr5",
    "2 pixels, `--target-decay 0.97`": "decay97",
    "2 pixels, `--target-encoder`": "target",
    "2 pixels, `--action-noise 0.1`": "noise1",
    "2 pixels, `--trivial-goals 0.5`": "trivial5",
    "2 pixels, `--encoders separate`": "sep",
    "2 pixels, `--relabel-probability 1.0`": "relabel1",
    "2 pixels, `--action-penalty 0.3`": "penalty3",
    "2 pixels, `--random-action-probability 0.2`": "random2",
    "4 pixels, `--balance-probability 0.2`": "shift4bal2",
    "4 pixels, `--balance-probability 0.2 --relabel-probability 0.8`": "shift4rel8bal2",
    "6 pixels, `--relabel-probability 0.8`": "shift6rel8",
    "6 pixels, `--balance-probability 0.2`": "shift6bal2",
    "6 pixels, `--balance-probability 0.2 --relabel-probability 0.8`": "shift6bal2rel8",
    "6 pixels, `--balance-probability 0.3 --relabel-probability 0.8`: `fast`": "shift6bal3rel8",
}
"""Suffix of the record's name by setting."""


def _fetch_twenty() -> str:
    rows = _rows([(label, f"fetch_25_20seeds_{name}") for label, name in TWENTY.items()])
    columns = [*_at(10, 12.5, 15, 17.5), c.min_success(15 * _K), c.min_success(20 * _K), c.mean_success(20 * _K), c.names()]
    return table(["VisualFetchReach, seeds 0 to 19"], rows, columns)


def _fetch_indicator() -> str:
    rows = _rows(
        [
            ("2 pixels", "fetch_25_shift2_indicator_10seeds"),
            ("4 pixels", "fetch_25_shift4_indicator_10seeds"),
            ("6 pixels", "fetch_25_shift6_indicator_10seeds"),
            ("6 pixels, `--relabel-probability 0.8`: `fast`", "fetch_25_shift6rel8_indicator_10seeds"),
        ]
    )
    headers = ["VisualFetchReach, indicator rewards, balanced and filtered"]
    return table(headers, rows, [c.seeds(), *_at(10, 15, 20), c.names()])


def _cpu() -> str:
    seeds = learning(*(f"fetch_reach_cpu_seed{seed}" for seed in range(3)))
    rows = [
        Row("64 environments, an encoder for each network, images as they are", None),
        Row("16 environments, an encoder for each network, `--random-shift 1`", None),
        Row("16 environments, one encoder, `--random-shift 1`", None),
        Row("the same with `--balance-probability 0.3 --relabel-probability 0.8`: `cpu`", seeds),
    ]
    return table(["VisualFetchReach, preset `cpu`"], rows, [c.values_at(round(count * _K)) for count in (12.8, 19.2, 25.6)])


def _finger() -> str:
    rows = [
        Row("all trivial goals kept", study("indicator", "VisualFingerTurn-oracle-fast")),
        *_rows(
            [
                ("all kept, one encoder, layer normalisation, `--actor-interval 2`", "finger_ln"),
                ("that and `--trivial-goals 0.2`, which gave way to original goals then", "finger_ln_triv"),
                ("`--trivial-goals 0.2`", "finger_trivial"),
            ]
        ),
        Row("`--trivial-goals 0.2`: `fast`", learning("finger_turn_oracle")),
        *_rows(
            [
                ("`--trivial-goals 0.2`, one encoder, `--random-shift 2`", "finger_shared_shift2"),
                ("`--trivial-goals 0.2 --updates-per-iteration 625`", "finger_trivial_625"),
                ("`--trivial-goals 0.2 --action-penalty 0.1`", "finger_trivial_penalty"),
                ("the same with `--updates-per-iteration 625`", "finger_trivial_penalty_625"),
            ]
        ),
    ]
    return table(["VisualFingerTurn"], rows, [c.seeds(), *_at(100, 200, 300, 500), c.names()])


def _finger_states() -> str:
    rows = _rows(
        [
            ("all trivial goals kept, one update per 16 steps", "finger_states_default"),
            ("and `--action-penalty 0.1`", "finger_states_penalty"),
            ("and `--updates-per-iteration 400`: one update per 8 steps", "finger_states_all_trivial"),
            ("and `--trivial-goals 0.2`, which gave way to original goals", "finger_states_original"),
            ("the same with `--updates-per-iteration 800`", "finger_states_original_800"),
            ("`--trivial-goals 0.2`, goals of other episodes in their place, one update per 8 steps", "finger_states_others"),
            ("the same with one update per 16 steps", "finger_states_others_200"),
        ]
    )
    return table(["FingerTurn from states, one seed"], rows, [*_at(51.2, 76.8, 89.6, 96, 102.4), c.names()])


def _finger_colour() -> str:
    rows = _rows(
        [
            ("`--trivial-goals 0.2`, which gave way to original goals", "finger_rgb32_original"),
            ("`--trivial-goals 0.2`, which gives way to what other episodes observed", "finger_rgb32_others"),
        ]
    )
    return table(["VisualFingerTurn in colour at 32x32, one seed"], rows, [*_at(25.6, 38.4, 51.2, 64), c.names()])


def _first_hand() -> str:
    rows = _rows([("without auxiliary losses", "hand_none"), ("OL-AUX-5", "hand_ol_aux_5")])
    return table(["VisualHandReach, earlier learner"], rows, [c.seeds(), *_at(50, 100, 150, 200, 300, 400), c.names()])


def _first_fetch() -> str:
    rows = _rows(
        [
            ("without auxiliary losses", "fetch_none_60k"),
            ("the same with logarithms of the main losses (`none_log`)", "fetch_none_log"),
            ("OL-AUX-5", "fetch_ol_aux_5"),
        ]
    )
    return table(["VisualFetchReach, earlier learner"], rows, [c.seeds(), *_at(10, 15, 20, 25, 30, 40), c.names()])


def _fetch_fast() -> str:
    base = learning("fetch_reach_oracle")
    rows = [
        Row("without auxiliary losses", base),
        *_rows(
            [
                ("the same, other seeds", "fetch_fast_now_none_seeds5"),
                ("OL-AUX-5", "fetch_fast_now_ol_aux_5"),
                ("OL-AUX-5, other seeds", "fetch_fast_now_ol_aux_5_seeds5"),
                ("the plain sum", "fetch_fast_now_sum"),
                ("fixed weights 0.1", "fetch_fast_now_fixed_01"),
                ("fixed weights 1", "fetch_fast_now_fixed_1"),
                ("fixed weights 10", "fetch_fast_now_fixed_10"),
            ]
        ),
    ]
    end = 25 * _K
    columns = [
        c.seeds(),
        *_at(7.5, 10, 12.5, 15),
        c.steps_to(0.97),
        c.mean_success(end),
        c.p_value_against(base, "without", end),
        c.names(),
    ]
    return table(["VisualFetchReach, `fast`"], rows, columns)


_WEIGHTINGS = {
    "without auxiliary losses": "none",
    "the plain sum": "sum",
    "fixed weights 0.1": "fixed_01",
    "fixed weights 1": "fixed_1",
    "fixed weights 10": "fixed_10",
    "OL-AUX-5": "ol_aux_5",
}


def _fast(task: str, prefix: str, step: float, last: int) -> str:
    """Return the table of all weightings on a task, with means up to the shortest run's end."""
    rows = _rows([(label, f"{prefix}_fast_{name}") for label, name in _WEIGHTINGS.items()])
    best, end = ablation(f"{prefix}_fast_ol_aux_5"), min(row.record.end for row in rows if row.record)
    columns = [
        *_at(*(step * count for count in range(1, last + 1))),
        c.mean_success(end),
        c.p_value_against(best, "OL-AUX-5", end),
        c.names(),
    ]
    return table([f"{task}, `fast`, seeds 0 to 4"], rows, columns)


def _actor_loss() -> str:
    value, log = "-Q + penalty", "log(best - Q) + penalty"
    critic = f"{value}, logarithm in the critic alone"
    part = "log(best - Q) + penalty / 30"
    labels = [
        ("the plain sum", value, "finger_sum"),
        ("`none_log`", log, "finger_none_log"),
        ("fixed weights 0.1", log, "finger_fixed_01"),
        ("balance", log, "finger_balance"),
        ("OL-AUX-5", log, "finger_ol_aux_5"),
        ("OL-AUX-5, `--weighting-beta 2`", log, "finger_ol_aux_5_beta_2"),
        ("`none_log`", critic, "finger_none_log_critic_only"),
        ("OL-AUX-5", critic, "finger_ol_aux_5_critic_only"),
        ("`none_log`", part, "finger_none_log_penalty"),
        ("OL-AUX-5", part, "finger_ol_aux_5_penalty"),
        ("`none_log`", "log(best - Q), no penalty", "finger_none_log_nopenalty"),
    ]
    rows = [
        Row("without auxiliary losses", learning("finger_turn_oracle"), [value]),
        *(Row(label, ablation(name), [loss]) for label, loss, name in labels),
        Row("OL-AUX-5", ablation("finger_fast_ol_aux_5"), ["log(best - Q + penalty): `--actor-log loss`"]),
    ]
    columns = [c.seeds(), *_at(50, 100, 150, 200, 250, 325), c.names()]
    return table(["VisualFingerTurn, `fast`", "actor's main loss"], rows, columns)


def _options() -> str:
    """Return the main table of the guide: a few settings on three tasks."""
    hand, fetch, finger = 500 * _K, 20 * _K, 500 * _K
    settings = [
        ("VisualHandReach", "no shifts, 500 environments", ablation("hand_shared"), hand),
        ("", "shifts of 2 pixels: `fast`", learning("hand_reach_oracle"), hand),
        ("", "and OL-AUX-5 with five tasks", ablation("hand_shared_shift2_ol_aux_5"), hand),
        ("VisualFetchReach", "2 pixels, `--encoders separate`", ablation("fetch_25_20seeds_sep"), fetch),
        ("", "2 pixels, one encoder", ablation("fetch_25_20seeds_base"), fetch),
        ("", "6 pixels", ablation("fetch_25_20seeds_shift6"), fetch),
        ("", "6 pixels, p₁ = 0.8, p₂ = 0.3: `fast`", ablation("fetch_25_20seeds_shift6bal3rel8"), fetch),
        ("VisualFingerTurn", "all trivial goals kept", study("indicator", "VisualFingerTurn-oracle-fast"), finger),
        ("", "`--trivial-goals 0.2`: `fast`", learning("finger_turn_oracle"), finger),
    ]
    budgets = {record: budget for _, _, record, budget in settings}
    rows = [
        Row(f"{task}, to {c.format_steps(budget)}" if task else "", record, [setting])
        for task, setting, record, budget in settings
    ]
    mean = c.Column("mean success, IQM (95 %)", lambda record: c.interval(record.means(budgets[record])))
    end = c.Column("success then", lambda record: c.band(record.at(budgets[record])))
    return table(["task", "setting"], rows, [c.seeds(), mean, end])


def tables() -> dict[str, dict[str, str]]:
    """Return the tables, page -> marker -> text."""
    return {
        GUIDE: {"options": _options()},
        OPTIONS: {
            "hand": _hand(),
            "fetch_100": _fetch_100(),
            "reacher": _reacher(),
            "fetch_environments": _fetch_environments(),
            "fetch_twenty_seeds": _fetch_twenty(),
            "fetch_indicator": _fetch_indicator(),
            "cpu": _cpu(),
            "finger": _finger(),
            "finger_states": _finger_states(),
            "finger_colour": _finger_colour(),
        },
        FAST: {
            "first_hand": _first_hand(),
            "first_fetch": _first_fetch(),
            "fetch": _fetch_fast(),
            "hand": _fast("VisualHandReach", "hand", 50, 6),
            "finger": _fast("VisualFingerTurn", "finger", 25, 6),
            "actor_loss": _actor_loss(),
        },
    }
