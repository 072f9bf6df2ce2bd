"""Values derived from a configuration and an environment's horizon: discount, rewards, filter, bounds of targets."""

import dataclasses
import math

from jaxrl_vis.config.groups import Config
from jaxrl_vis.config.methods import METHODS, Method
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.plugins import build_component, find_component


@dataclasses.dataclass(frozen=True)
class Resolved:
    """Values derived from a `Config` and the environment's horizon, with all defaults filled in.

    Attributes:
        method: Source of rewards.
        horizon: T, number of control steps in an episode.
        discount: gamma.
        reward_positive, reward_negative: R+ and R-.
        balance_probability: p2.
        filter_threshold: q0; infinity if the method does not filter.
        critic_output_bias: Initial bias of the critic's output, about its prediction before training.
        target_minimum, target_maximum: Bounds of the critic's targets, R-/(1-gamma) and R+/(1-gamma); the maximum is infinite
            without ``clip_targets_above``.
    """

    method: Method
    horizon: int
    discount: float
    reward_positive: float
    reward_negative: float
    balance_probability: float
    filter_threshold: float
    critic_output_bias: float
    target_minimum: float
    target_maximum: float


def resolve(config: Config, horizon: int) -> Resolved:
    """Fill in the defaults that depend on the method and the horizon.

    The valid range of the filter threshold is R- + gamma R+/(1-gamma) < q0 < R+/(1-gamma) (thesis, section 5.1.4); its middle
    is the default. A critic that starts at or above q0 would drop every negative before learning from any, and its values would
    never decrease. A newly initialised critic (Q near 0) does so if q0 <= 0, as with rewards 0/-1: it then starts at
    R-/(1-gamma), the minimum value of any state.

    Raises:
        RequestError: The method is unknown, the discount or the filter threshold is out of range, a threshold is set for a
            method that does not filter, or R+ is not larger than R-.
    """
    method = find_component("method", config.reward.method, METHODS, config.environment.env_folder)
    method = build_component("method", config.reward.method, method, expected_type=Method)
    discount = 1.0 - 1.0 / horizon if config.ddpg.discount is None else config.ddpg.discount
    if not 0.0 <= discount < 1.0:
        raise RequestError(f"discount must lie in [0, 1), not {discount}; leave it out for 1 - 1/horizon")
    positive = method.reward_positive if config.reward.reward_positive is None else config.reward.reward_positive
    negative = method.reward_negative if config.reward.reward_negative is None else config.reward.reward_negative
    if positive <= negative:
        raise RequestError(f"reward_positive ({positive}) must be larger than reward_negative ({negative})")
    best, worst = positive / (1.0 - discount), negative / (1.0 - discount)
    low = negative + discount * best
    threshold = math.inf
    if method.filter:
        threshold = (low + best) / 2 if config.goals.filter_threshold is None else config.goals.filter_threshold
    if config.goals.filter_threshold is not None:
        if not method.filter:
            filtering = " or ".join(name for name, other in METHODS.items() if other.filter)
            raise RequestError(f"filter_threshold needs --method {filtering}")
        if not low < threshold < best:
            raise RequestError(f"filter_threshold {threshold} lies outside its band ({low:g}, {best:g})")
    return Resolved(
        method=method,
        horizon=horizon,
        discount=discount,
        reward_positive=positive,
        reward_negative=negative,
        balance_probability=method.balance_probability
        if config.goals.balance_probability is None
        else config.goals.balance_probability,
        filter_threshold=threshold,
        critic_output_bias=worst if threshold <= 0.0 else 0.0,
        target_minimum=worst,
        target_maximum=best if config.ddpg.clip_targets_above else math.inf,
    )
