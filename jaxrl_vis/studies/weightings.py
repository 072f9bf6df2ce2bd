"""Runs of figure ``weightings``: five auxiliary losses on three tasks, by all weightings with their default options."""

import colorsys

from jaxrl_vis.config.methods import WEIGHTING_NAMES
from jaxrl_vis.studies import ol_aux
from jaxrl_vis.studies.engine.study import Family, Study, Variant
from jaxrl_vis.studies.ol_aux import AUX_TASKS, FETCH, FINGER, HAND

_SHARED = ("none", "sum", "balance", "cosine", "ol_aux_5")
"""Variants that are those of figure 5.4."""
_OTHERS = [name for name in WEIGHTING_NAMES if name not in (*_SHARED, "none_log", "fixed", "ol_aux", "ol_aux_ablation")]


def _colour(number: int) -> str:
    """Return one of as many hues as there are other weightings, as #rrggbb."""
    rgb = colorsys.hls_to_rgb(number / len(_OTHERS), 0.62 if number % 2 else 0.42, 0.6)
    return "#" + "".join(f"{round(255 * part):02x}" for part in rgb)


VARIANTS: dict[str, Variant] = {
    **{name: ol_aux.VARIANTS[name] for name in _SHARED},
    **{
        name: Variant(name.replace("_", " "), {"aux_tasks": AUX_TASKS, "weighting": name}, _colour(number))
        for number, name in enumerate(_OTHERS)
    },
}
"""Variants for the figure, by name."""

FAMILY = Family(
    name="weightings",
    variants=VARIANTS,
    tasks=(FETCH, HAND, FINGER),
    preset="fast",
    of_task={("fast", HAND): {"replay_transitions": 300_000}},  # as many as there are steps
    max_steps={},
    quick_changes={},
)

STUDIES: dict[str, Study] = {
    "weightings": Study(
        FAMILY, "All weightings of five auxiliary losses", tuple(VARIANTS), {FETCH: 60_000, HAND: 300_000, FINGER: 300_000}
    )
}
