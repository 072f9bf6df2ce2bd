"""Properties of options, as field annotations: their scope, and which components of a learner read them."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Mark:
    """Property of a field, used as an annotation; `marked` lists the fields that have it.

    Attributes:
        meaning: Description of the property.
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
    """Property of a field that is read only if losses are weighted or their logarithms are minimised.

    Attributes:
        names: Weightings that read the field; empty for any.
    """

    names: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class OfAlgorithm:
    """Property of a field that only some of the built-in algorithms read.

    Attributes:
        names: Algorithms that read the field.
    """

    names: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class OfMethod:
    """Property of a field that only one of the built-in methods reads.

    Attributes:
        name: Method that reads the field.
    """

    name: str


OL_AUX = OfWeighting(("ol_aux", "ol_aux_ablation"))
