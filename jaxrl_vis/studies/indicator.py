"""Runs of figures 5.1 and 5.2 of the thesis, and of claims in it that have no figure.

    5.1          oracle, autoencoder, indicator, indicator with balancing and filtering: Reacher and FetchReach
    5.2          the same without the autoencoder: SawyerReach
    estimators   rewards from inaccurate state estimators, and the indicator, which needs none
    cameras      the indicator and the oracle with noisy images, and with randomised cameras, lights and colours

Figure 5.1 can also be drawn for the two tasks from states, and for the hand and the finger, which are not in the thesis.
"""

from typing import Any

from jaxrl_vis.config import changes, general_values
from jaxrl_vis.studies.engine.study import Family, Study, Variant

_OURS: dict[str, Any] = {"method": "indicator_balance_filter"}
_ORACLE: dict[str, Any] = {"method": "oracle"}
_NOISE: dict[str, Any] = {"observation_noise": 5.0}
_RANDOM: dict[str, Any] = {"randomize": ("camera", "lights", "colours")}

VARIANTS: dict[str, Variant] = {
    "oracle": Variant("oracle", _ORACLE, "#5b626c"),
    "autoencoder": Variant("autoencoder", {"method": "autoencoder"}, "#b4531f"),
    "indicator": Variant("indicator", {"method": "indicator"}, "#3b5bdb"),
    "indicator_balance_filter": Variant("indicator, balanced and filtered", _OURS, "#0f7b6c"),
    "balance_only": Variant("indicator, balanced, no filter", changes(method="indicator", balance_probability=0.5), "#6b7a1f"),
    # Ablations of the thesis (5.1.6): every relabelled goal is the next observation; every goal is relabelled.
    "all_next": Variant("p1 = 0.45, p2 = 1", _OURS | changes(relabel_probability=0.45, balance_probability=1.0), "#a61e8c"),
    "all_relabelled": Variant("p1 = 1", _OURS | {"relabel_probability": 1.0}, "#c28f00"),
    # Estimators with errors in a cluttered quarter of the workspace, with as many anywhere, and without bias.
    "clutter": Variant(
        "10 % false positives, in a cluttered quarter",
        _ORACLE | changes(reward_false_positives=0.1, reward_clutter=0.25),
        "#b4531f",
    ),
    "false_positives": Variant("10 % false positives, anywhere", _ORACLE | {"reward_false_positives": 0.1}, "#c28f00"),
    "false_negatives": Variant("10 % false negatives, anywhere", _ORACLE | {"reward_false_negatives": 0.1}, "#a61e8c"),
    "state_noise": Variant("Gaussian noise of 30 mm", _ORACLE | {"reward_noise": 0.03}, "#3b5bdb"),
    "oracle_noise": Variant("oracle, noisy images", _ORACLE | _NOISE, "#b4531f"),
    "ours_noise": Variant("indicator, balanced and filtered, noisy images", _OURS | _NOISE, "#3b5bdb"),
    "oracle_randomized": Variant("oracle, varied images", _ORACLE | _RANDOM, "#c28f00"),
    "ours_randomized": Variant("indicator, balanced and filtered, varied images", _OURS | _RANDOM, "#a61e8c"),
}
"""Variants for figures, by name."""

REACHER, FETCH, SAWYER = "VisualReacher", "VisualFetchReach", "VisualSawyerReach"
HAND, FINGER = "VisualHandReach", "VisualFingerTurn"
_OTHERS = {"Reacher": 100_000, "FetchReach": 100_000, HAND: 700_000, FINGER: 500_000}
# All methods use unshifted images (the autoencoder compares them, and does not work with shifted ones), and relabel alike.

FAMILY = Family(
    name="indicator",
    variants=VARIANTS,
    tasks=(REACHER, FETCH, SAWYER, *_OTHERS),
    preset="fast",
    # Reacher's threshold is about one pixel of a 64x64 image. All methods relabel alike, and only the oracle can tell trivial
    # goals.
    of_task={
        ("fast", REACHER): {"image_size": 100},
        ("cpu", REACHER): general_values("cpu", REACHER),
        **{(name, task): general_values(name, task) for name in ("fast", "cpu") for task in (FETCH, "FetchReach")},
        ("fast", HAND): {"random_shift": 0},
        ("fast", FINGER): {"trivial_goals": 1.0},
        ("cpu", FINGER): {"trivial_goals": 1.0},
    },
    max_steps={},
    quick_changes={},
)

STUDIES: dict[str, Study] = {
    "5.1": Study(
        FAMILY,
        "Rewards with and without ground truth",
        ("oracle", "autoencoder", "indicator", "indicator_balance_filter"),
        {REACHER: 100_000, FETCH: 100_000},
        optional_steps=_OTHERS,
    ),
    "5.2": Study(
        FAMILY,
        "Rewards with and without ground truth",
        ("oracle", "indicator", "indicator_balance_filter"),
        {SAWYER: 150_000},
    ),
    "estimators": Study(
        FAMILY,
        "Rewards from state estimators that err",
        ("oracle", "state_noise", "false_positives", "false_negatives", "clutter", "indicator_balance_filter"),
        {FETCH: 100_000},
    ),
    "cameras": Study(
        FAMILY,
        "Rewards with and without ground truth, with noisy and with varied images",
        ("oracle", "oracle_noise", "oracle_randomized", "indicator_balance_filter", "ours_noise", "ours_randomized"),
        {FETCH: 100_000},
    ),
}
