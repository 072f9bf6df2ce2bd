"""All weightings by name. A new one is a function that makes it, and a row here."""

import inspect
from collections.abc import Callable
from typing import Any

from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.learner.weighting.base import Weighting
from jaxrl_vis.learner.weighting.members import balance, cosine, fixed, none, none_log, plain_sum
from jaxrl_vis.learner.weighting.ol_aux import ol_aux, ol_aux_ablation

WEIGHTINGS: dict[str, Callable[..., Weighting]] = {
    "none": none,
    "none_log": none_log,
    "sum": plain_sum,
    "fixed": fixed,
    "balance": balance,
    "cosine": cosine,
    "ol_aux": ol_aux,
    "ol_aux_ablation": ol_aux_ablation,
}


def make_weighting(name: str, **options: Any) -> Weighting:
    """A weighting by its name.

    Args:
        name: One of `WEIGHTINGS`.
        options: Arguments of the function that makes it.

    Raises:
        RequestError: There is no such weighting, it has no such option, or the option's value makes no sense.
    """
    if name not in WEIGHTINGS:
        raise RequestError(f"unknown weighting {name!r}{nearest(name, WEIGHTINGS)}")
    allowed = options_of(name)
    for option in options:
        if option not in allowed:
            mend = nearest(option, allowed) if allowed else "; it has none"
            raise RequestError(f"weighting {name} has no option {option!r}{mend}")
    return WEIGHTINGS[name](**options)


def options_of(name: str) -> tuple[str, ...]:
    """The options that a weighting has."""
    found = tuple(inspect.signature(WEIGHTINGS[name]).parameters)
    if name == "ol_aux_ablation":
        return tuple(option for option in inspect.signature(ol_aux).parameters if option != "held")
    return found
