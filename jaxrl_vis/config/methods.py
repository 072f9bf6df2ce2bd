"""Names of the parts that a learner can be trained with, and its reward methods as data.

A method says where rewards come from, and which of them are trusted. A person's own is a `Method` in a module, named
``module:Name``, with a function for its reward. Imports no JAX.
"""

import dataclasses
from collections.abc import Callable
from typing import Annotated, Any, Literal

from jaxrl_vis.config.fields import Names

RewardName = Literal["oracle", "autoencoder", "classifier", "features", "indicator", "indicator_tolerance"]
RewardFunction = Callable[..., Any]
"""(`types.Batch`; [B, ...] what was reached, as a goal would show it; R+; R-) -> rewards [B] float32."""


@dataclasses.dataclass(frozen=True)
class Method:
    """One method (thesis, section 5.1.4).

    Attributes:
        reward: oracle: distance of the true states; autoencoder: cosine similarity of the latents of an autoencoder that is
            trained along; classifier: probability of a success classifier that is; features: cosine similarity in a frozen
            encoder; indicator: equality of observations; indicator_tolerance: the same but for camera noise. Or a function.
            Rewards are computed anew at every sample, so it must read nothing else than its arguments.
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
    def balance(self) -> bool:
        """True if samples are balanced: some take the very next observation as their goal, which is a sure positive."""
        return self.balance_probability > 0.0

    @property
    def needs_images(self) -> bool:
        """True if rewards are made from images, so that the environment must show some."""
        return self.is_learned or self.reward == "features"

    @property
    def is_learned(self) -> bool:
        """True if rewards are those of a model that is trained along."""
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
# Weightings of losses by what they need (`jaxrl_vis.weighting`), and by the options that they have.
MAIN_WEIGHTINGS = ("none", "none_log", "sum", "fixed", "balance", "cosine", "ol_aux", "ol_aux_ablation")
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

WeightingName = Annotated[
    str, Names((*MAIN_WEIGHTINGS, *LOSS_WEIGHTINGS, "gradnorm", *GRAMIAN_WEIGHTINGS, *DIRECTION_WEIGHTINGS))
]
AuxTaskName = Annotated[str, Names(("forward_dynamics", "inverse_dynamics", "egomotion", "autoencoder", "optical_flow"))]
ALGORITHMS = ("ddpg", "td3", "contrastive")
"""Names of the built-in algorithms."""
AlgorithmName = Annotated[str, Names(ALGORITHMS)]
