"""The methods that a learner can be trained with, as data: where rewards come from, and which of them are trusted.

Imports no JAX. A new method is a row here and a name in `MethodName`; a new kind of reward is a name in `RewardName` as well.
"""

import dataclasses
from typing import Literal

MethodName = Literal["oracle", "autoencoder", "indicator", "indicator_balance_filter"]
RewardName = Literal["oracle", "autoencoder", "indicator"]
WeightingName = Literal["none", "none_log", "sum", "fixed", "balance", "cosine", "ol_aux", "ol_aux_ablation"]
AuxTaskName = Literal["forward_dynamics", "inverse_dynamics", "egomotion", "autoencoder", "optical_flow"]


@dataclasses.dataclass(frozen=True)
class Method:
    """One method (thesis, section 5.1.4).

    Attributes:
        reward: oracle: distance of the true states; autoencoder: cosine similarity of the latents of an autoencoder that is
            trained along; indicator: equality of observations.
        filter: Whether negatives that the critic contradicts are dropped as false.
        reward_positive, reward_negative: Defaults of R+ and R-.
        balance_probability: Default of p2.
    """

    reward: RewardName
    filter: bool
    reward_positive: float
    reward_negative: float = -1.0
    balance_probability: float = 0.0

    @property
    def balance(self) -> bool:
        """Whether samples are balanced: some take the very next observation as their goal, which is a sure positive."""
        return self.balance_probability > 0.0

    @property
    def needs_images(self) -> bool:
        """Whether rewards are made from images, so that the environment must show some."""
        return self.reward == "autoencoder"


METHODS: dict[MethodName, Method] = {
    "oracle": Method(reward="oracle", filter=False, reward_positive=0.0),
    "autoencoder": Method(reward="autoencoder", filter=False, reward_positive=1.0, reward_negative=0.0),
    "indicator": Method(reward="indicator", filter=False, reward_positive=1.0),
    "indicator_balance_filter": Method(reward="indicator", filter=True, reward_positive=1.0, balance_probability=0.5),
}
