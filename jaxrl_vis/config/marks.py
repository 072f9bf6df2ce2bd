"""Properties of options, for the annotations of their fields: scope, and which parts of a learner read them."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Mark:
    """Property of a field, for its annotation; `marked` lists the fields that have it.

    Attributes:
        meaning: Its meaning.
    """

    meaning: str


HOST = Mark("only the host reads it: no compiled program depends on it")
RESUMABLE = Mark("may change when a run is resumed: it has no effect on learning")
UNMEASURED = Mark("has no effect on the metrics up to the same number of environment steps")
DIVIDED = Mark("must be divisible by the number of devices that share a learner")
NEEDS_STATES = Mark("if changed, rewards must be computed from true states, as the oracle's are")
FALSE_REWARD = Mark("fraction of rewards that are false")


@dataclasses.dataclass(frozen=True)
class OfWeighting:
    """Property of a field that is read only if losses are weighted, or have logarithms.

    Attributes:
        names: Weightings that the field is an option of; empty for any.
    """

    names: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class OfAlgorithm:
    """Property of a field that only some of the built-in algorithms read.

    Attributes:
        names: These algorithms.
    """

    names: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class OfMethod:
    """Property of a field that only one of the built-in methods reads.

    Attributes:
        name: The method.
    """

    name: str


OL_AUX = OfWeighting(("ol_aux", "ol_aux_ablation"))
