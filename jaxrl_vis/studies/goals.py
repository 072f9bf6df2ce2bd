"""Runs of figure ``goals``: comparison of methods that learn from goal images, with all kinds of rewards or without any.

All use the preset's general settings without tuning for a method or task. Images are not shifted, because methods that compare
images do not support that.
"""

from typing import Any

from jaxrl_vis.config import changes
from jaxrl_vis.studies import indicator
from jaxrl_vis.studies.engine.study import Family, Study, Variant
from jaxrl_vis.studies.indicator import FETCH, FINGER, HAND, REACHER, SAWYER

POINT = "VisualPointMass"
_TD3: dict[str, Any] = changes(algorithm="td3", actor_interval=2, target_update_interval=2)
_CONTRASTIVE: dict[str, Any] = changes(
    algorithm="contrastive", future_goals="geometric", relabel_probability=1.0, balance_probability=0.0, trivial_goals=1.0
)
_OURS = "indicator_balance_filter"

VARIANTS: dict[str, Variant] = {
    **{name: indicator.VARIANTS[name] for name in ("oracle", "autoencoder", "indicator", _OURS)},
    "classifier": Variant("classifier", {"method": "classifier"}, "#a61e8c"),
    # Needs an encoder of each task: jaxrl-vis encoder TASK --out encoders/TASK.npz
    "features": Variant("frozen features", changes(method="features", reward_encoder="encoders/{task}.npz"), "#c28f00"),
    "contrastive": Variant("contrastive", _CONTRASTIVE, "#c92a2a"),
    "contrastive_nce": Variant("contrastive, NCE", _CONTRASTIVE | {"contrastive_form": "nce"}, "#f08c00"),
    "td3_oracle": Variant("oracle, TD3", _TD3 | {"method": "oracle"}, "#22252a"),
    "td3_ours": Variant("indicator, balanced and filtered, TD3", _TD3 | {"method": _OURS}, "#087f5b"),
}
"""Variants for the figure, by name."""

FAMILY = Family(
    name="goals",
    variants=VARIANTS,
    tasks=(FETCH, REACHER, SAWYER, HAND, FINGER, POINT, "FetchReach", "Reacher", "PointMass"),
    preset="fast",
    of_task=indicator.FAMILY.of_task,
    max_steps={},
    quick_changes={},
)

STUDIES: dict[str, Study] = {
    "goals": Study(
        FAMILY,
        "Learning from goal images",
        ("oracle", "autoencoder", "indicator", _OURS, "classifier", "contrastive", "td3_oracle"),
        {FETCH: 50_000, REACHER: 100_000, SAWYER: 100_000, HAND: 500_000, FINGER: 300_000, POINT: 100_000},
        optional_steps={"FetchReach": 50_000, "Reacher": 100_000, "PointMass": 100_000},
    )
}
