"""Names of a learner's built-in components, and definitions of the reward methods.

A method defines the source of rewards, and which of them are trusted. A custom one is a `Method` in your own module, named
``module:Name``, with a function as its reward. Imports no JAX.
"""

import dataclasses
from collections.abc import Callable
from typing import Annotated, Any, Literal

from jaxrl_vis.config.fields import Names

RewardName = Literal["oracle", "autoencoder", "classifier", "features", "indicator", "indicator_tolerance"]
RewardFunction = Callable[..., Any]
"""Function of a `types.Batch`, achieved observations [B, ...] in the form of a goal, R+ and R-; returns rewards [B] float32."""


@dataclasses.dataclass(frozen=True)
class Method:
    """Reward method (thesis, section 5.1.4).

    Attributes:
        reward: Source of rewards. oracle: distance between true states; autoencoder: cosine similarity of the latents of an
            autoencoder trained alongside; classifier: probability from a success classifier trained alongside; features:
            cosine similarity in a frozen encoder; indicator: equality of observations; indicator_tolerance: equality up to
            camera noise. Or a function, which must depend only on its arguments, as rewards are recomputed for every sample.
        filter: Whether negatives that the critic contradicts are dropped as false.
        reward_positive, reward_negative: Defaults of R+ and R-.
        balance_probability: Default of p2.
    """

    reward: RewardName | RewardFunction
    filter: bool
    reward_positive: float
    reward_negative: float = -1.0
    balance_probability: float = 0.0

    @property
    def needs_images(self) -> bool:
        """True if rewards are computed from images, so that the environment must provide them."""
        return self.is_learned or self.reward == "features"

    @property
    def is_learned(self) -> bool:
        """True if rewards are computed by a model trained alongside."""
        return self.reward in ("autoencoder", "classifier")


METHODS: dict[str, Method] = {
    "oracle": Method(reward="oracle", filter=False, reward_positive=0.0),
    "autoencoder": Method(reward="autoencoder", filter=False, reward_positive=1.0, reward_negative=0.0),
    "classifier": Method(reward="classifier", filter=False, reward_positive=1.0, reward_negative=0.0),
    "features": Method(reward="features", filter=False, reward_positive=1.0, reward_negative=0.0),
    "indicator": Method(reward="indicator", filter=False, reward_positive=1.0),
    "indicator_balance_filter": Method(reward="indicator", filter=True, reward_positive=1.0, balance_probability=0.5),
    "indicator_tolerance": Method(reward="indicator_tolerance", filter=True, reward_positive=1.0, balance_probability=0.5),
}

MethodName = Annotated[str, Names(tuple(METHODS))]
# Loss weightings, grouped by their inputs (`jaxrl_vis.weighting`) and by the options that apply to them.
MAIN_LOSS_WEIGHTINGS = ("none", "none_log", "sum", "fixed", "balance", "cosine", "ol_aux", "ol_aux_ablation")
LOSS_WEIGHTINGS = ("uniform", "random", "uncertainty", "imtl_l", "dwa", "geometric_mean", "stch", "famo")
GRAMIAN_WEIGHTINGS = (
    "auxinash",
    "mgda",
    "upgrad",
    "dualproj",
    "cagrad",
    "imtl_g",
    "nash_mtl",
    "fairgrad",
    "aligned_mtl",
    "config",
    "pcgrad",
    "gradvac",
)
DIRECTION_WEIGHTINGS = ("graddrop", "db_mtl", "moco")
LOG_WEIGHTINGS = ("cosine", *GRAMIAN_WEIGHTINGS)
HEAD_WEIGHTINGS = ("cosine", "ol_aux", "gradnorm", *GRAMIAN_WEIGHTINGS)
EPS_WEIGHTINGS = ("fixed", "balance", "cosine", "ol_aux", "ol_aux_ablation", *GRAMIAN_WEIGHTINGS, "db_mtl")
LIMITED_WEIGHTINGS = ("ol_aux", "ol_aux_ablation", "gradnorm", *LOSS_WEIGHTINGS, *GRAMIAN_WEIGHTINGS)

WEIGHTING_NAMES = (*MAIN_LOSS_WEIGHTINGS, *LOSS_WEIGHTINGS, "gradnorm", *GRAMIAN_WEIGHTINGS, *DIRECTION_WEIGHTINGS)
"""Names of the built-in weightings."""
WeightingName = Annotated[str, Names(WEIGHTING_NAMES)]
AuxTaskName = Annotated[str, Names(("forward_dynamics", "inverse_dynamics", "egomotion", "autoencoder", "optical_flow"))]
ALGORITHMS = ("ddpg", "td3", "contrastive")
"""Names of the built-in algorithms."""
AlgorithmName = Annotated[str, Names(ALGORITHMS)]
