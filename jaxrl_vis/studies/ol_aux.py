"""Runs of figures 5.4 to 5.7 of the thesis. `grid` trains them; `figures` draws.

    5.4   no auxiliary losses, gradient balancing, cosine similarity, OL-AUX-5
    5.5   each auxiliary task alone, with gradient balancing, and OL-AUX-5
    5.6   weights of OL-AUX-5 over training
    5.7   OL-AUX-5, its ablation, OL-AUX-1

Every figure but 5.6 also has a run without auxiliary losses as the reference of speed-ups. Runs are shared between figures.
"""

from collections.abc import Sequence
from typing import Any

from jaxrl_vis.config import changes, general_values
from jaxrl_vis.config.methods import AuxTaskName
from jaxrl_vis.errors import RequestError
from jaxrl_vis.studies.engine.study import Family, Study, Variant

_AUX_COLOURS: dict[AuxTaskName, str] = {
    "forward_dynamics": "#3b5bdb",
    "inverse_dynamics": "#a61e8c",
    "egomotion": "#b4531f",
    "autoencoder": "#6b7a1f",
    "optical_flow": "#1f8fb0",
}
AUX_TASKS: tuple[AuxTaskName, ...] = tuple(_AUX_COLOURS)
"""Auxiliary tasks of the thesis, in its order. Further tasks of a learner are not part of these figures."""

_ALL: dict[str, Any] = {"aux_tasks": AUX_TASKS}

OPTIONS: dict[str, dict[str, Any]] = {
    "ol_aux_5_beta_100": changes(weighting_beta=100.0),
    "ol_aux_5_beta_400": changes(weighting_beta=400.0),
    "ol_aux_5_eps_0.001": changes(weighting_eps=0.001),
    "ol_aux_5_heads": changes(weighting_heads="always"),
    "ol_aux_5_maximum_5": changes(weighting_maximum=5.0),
    "ol_aux_5_total_5": changes(weighting_total=5.0),
}
"""Options of OL-AUX-5 that were tried, by variant."""

VARIANTS: dict[str, Variant] = {
    "none": Variant("no auxiliary losses", {}, "#5b626c"),
    "none_log": Variant("none, log of the main loss", {"weighting": "none_log"}, "#9aa1ab"),
    "sum": Variant("plain sum", _ALL | {"weighting": "sum"}, "#c28f00"),
    **{
        f"fixed_{weight:g}": Variant(
            f"fixed weights {weight:g}", _ALL | changes(weighting="fixed", weighting_fixed=weight), colour
        )
        for weight, colour in ((0.1, "#d98a8a"), (1.0, "#c25555"), (10.0, "#8f2424"))
    },
    "balance": Variant("gradient balancing", _ALL | {"weighting": "balance"}, "#3b5bdb"),
    "cosine": Variant("cosine similarity", _ALL | {"weighting": "cosine"}, "#b4531f"),
    "ol_aux_5": Variant("OL-AUX-5", _ALL | changes(weighting="ol_aux", weighting_interval=5), "#0f7b6c"),
    "ol_aux_5_ablation": Variant(
        "OL-AUX-5 (ablation)", _ALL | changes(weighting="ol_aux_ablation", weighting_interval=5), "#3b5bdb"
    ),
    **{
        name: Variant(
            name.replace("ol_aux_5_", "OL-AUX-5, ").replace("_", " "),
            _ALL | changes(weighting="ol_aux", weighting_interval=5) | options,
            "#74b816",
        )
        for name, options in OPTIONS.items()
    },
    "ol_aux_5_release": Variant(
        "OL-AUX-5 as released",
        _ALL
        | changes(
            weighting="ol_aux",
            weighting_interval=5,
            weighting_main_grad="total",
            weighting_window=4,
            aux_form="release",
            normalizers="separate",
            normalizer_source="relabelled",
        ),
        "#5c940d",
    ),
    "ol_aux_1": Variant("OL-AUX-1", _ALL | changes(weighting="ol_aux", weighting_interval=1), "#a61e8c"),
    **{
        name: Variant(f"{name.replace('_', ' ')} alone", changes(aux_tasks=(name,), weighting="balance"), _AUX_COLOURS[name])
        for name in AUX_TASKS
    },
}
"""Variants for figures, by name."""

FETCH, HAND, FINGER = "VisualFetchReach", "VisualHandReach", "VisualFingerTurn"
LEVELS: dict[str, tuple[float, ...]] = {FETCH: (0.5, 0.9), FINGER: (0.3, 0.5, 0.9), HAND: (0.2, 0.3, 0.4)}
"""Levels of success for which tables give the steps, by environment."""

# The authors did not stack images of the finger, and evaluated these two every 40 k steps.
_OF_TASK: dict[tuple[str, str], dict[str, Any]] = {
    ("paper", FINGER): changes(frame_stack=1, eval_interval=10),
    ("paper", HAND): {"eval_interval": 10},
}
QUICK: dict[str, Any] = {
    # The same for all tasks: FetchReach's values of this preset would take more iterations.
    **general_values("cpu", "FetchReach"),
    **changes(env_steps=19_200, updates_per_iteration=100, batch_size=64, eval_interval=1, eval_episodes=64),
}
"""Changes of the preset ``cpu`` for `figure --quick`: six evaluations, 600 gradient steps."""


FAMILY = Family(
    name="ol_aux",
    variants=VARIANTS,
    tasks=tuple(LEVELS),
    preset="paper",
    of_task=_OF_TASK,
    # Presets that learn faster than the authors' release need smaller budgets.
    max_steps={"fast": {FETCH: 100_000, HAND: 2_000_000, FINGER: 500_000}},
    quick_changes=QUICK,
)

STUDIES: dict[str, Study] = {
    "5.4": Study(
        FAMILY,
        "Auxiliary losses, and how they are weighted",
        ("none", "balance", "cosine", "ol_aux_5"),
        {FETCH: 250_000, HAND: 2_000_000, FINGER: 2_500_000},
        {(FINGER, "balance"): 1_500_000, (FINGER, "cosine"): 1_500_000},
    ),
    "5.5": Study(
        FAMILY,
        "Single auxiliary tasks, and OL-AUX-5 with all of them",
        (*AUX_TASKS, "ol_aux_5"),
        {FETCH: 250_000, HAND: 1_000_000, FINGER: 1_000_000},
        extra_variants=("none",),
    ),
    "5.6": Study(
        FAMILY,
        "Weights of the auxiliary losses in OL-AUX-5",
        ("ol_aux_5",),
        {FETCH: 250_000, HAND: 2_000_000, FINGER: 2_500_000},
    ),
    "5.7": Study(
        FAMILY,
        "What OL-AUX-5 owes to looking ahead",
        ("ol_aux_1", "ol_aux_5_ablation", "ol_aux_5"),
        {FETCH: 250_000, HAND: 600_000},
        extra_variants=("none",),
    ),
}

WEIGHTS = "5.6"
"""Name of the figure of weights, which shows those of one method."""


def check_weights(variants: Sequence[str]) -> None:
    """Check that the figure `WEIGHTS` can show these variants; an empty sequence selects its default.

    Raises:
        RequestError: There are several variants, or one without learned weights.
    """
    learning = [name for name, variant in VARIANTS.items() if str(variant.changes.get("weighting")).startswith("ol_aux")]
    if len(variants) > 1 or not set(variants) <= set(learning):
        raise RequestError(
            f"figure {WEIGHTS} shows weights of one method that learns them; choose one of {', '.join(learning)}"
        )
