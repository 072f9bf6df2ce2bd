"""Registry of weightings by name. To add one, write its constructor and add an entry here."""

import inspect
from collections.abc import Callable
from typing import Any

from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.weighting.base import Weighting
from jaxrl_vis.weighting.constant import balance, cosine, fixed, none, none_log, plain_sum
from jaxrl_vis.weighting.directions import db_mtl, graddrop, moco
from jaxrl_vis.weighting.gramian_based import (
    Options,
    aligned_mtl,
    cagrad,
    config,
    dualproj,
    fairgrad,
    imtl_g,
    mgda,
    nash_mtl,
    upgrad,
)
from jaxrl_vis.weighting.learned import auxinash, gradnorm
from jaxrl_vis.weighting.loss_values import dwa, famo, geometric_mean, imtl_l, random, stch, uncertainty, uniform
from jaxrl_vis.weighting.ol_aux import ol_aux
from jaxrl_vis.weighting.ol_aux_variants import ol_aux_ablation, ol_aux_window
from jaxrl_vis.weighting.surgery import gradvac, pcgrad

WEIGHTINGS: dict[str, Callable[..., Weighting]] = {
    "none": none,
    "none_log": none_log,
    "sum": plain_sum,
    "fixed": fixed,
    "balance": balance,
    "cosine": cosine,
    "ol_aux": ol_aux,
    "ol_aux_ablation": ol_aux_ablation,
    "uniform": uniform,
    "random": random,
    "uncertainty": uncertainty,
    "imtl_l": imtl_l,
    "dwa": dwa,
    "geometric_mean": geometric_mean,
    "stch": stch,
    "famo": famo,
    "gradnorm": gradnorm,
    "auxinash": auxinash,
    "mgda": mgda,
    "upgrad": upgrad,
    "dualproj": dualproj,
    "cagrad": cagrad,
    "imtl_g": imtl_g,
    "nash_mtl": nash_mtl,
    "fairgrad": fairgrad,
    "aligned_mtl": aligned_mtl,
    "config": config,
    "pcgrad": pcgrad,
    "gradvac": gradvac,
    "graddrop": graddrop,
    "db_mtl": db_mtl,
    "moco": moco,
}
# Slower variants with options that the default constructors lack.
_VARIANTS: dict[str, Callable[..., Weighting]] = {"ol_aux": ol_aux_window}


def make_weighting(name: str, **options: Any) -> Weighting:
    """Build a weighting by name.

    Args:
        name: One of `WEIGHTINGS`.
        options: Arguments of its constructor; for ol_aux also of `ol_aux_window`, which is slower and used only if needed.

    Raises:
        RequestError: The weighting or an option is unknown, or an option's value is invalid.
    """
    if name not in WEIGHTINGS:
        raise RequestError(f"unknown weighting {name!r}{nearest(name, WEIGHTINGS)}")
    maker = WEIGHTINGS[name]
    if not set(options) <= set(_parameters(maker)):
        maker = _VARIANTS.get(name, maker)
    allowed = _parameters(maker)
    for option in options:
        if option not in allowed:
            hint = nearest(option, allowed) if allowed else "; it has none"
            raise RequestError(f"weighting {name} has no option {option!r}{hint}")
    return maker(**options)


def _parameters(maker: Callable[..., Weighting]) -> tuple[str, ...]:
    parameters = inspect.signature(maker).parameters.values()
    common = Options.__annotations__ if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters) else ()
    return (*(parameter.name for parameter in parameters if parameter.kind is not parameter.VAR_KEYWORD), *common)
