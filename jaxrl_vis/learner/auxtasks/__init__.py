"""Auxiliary tasks: what an encoder's latents should also tell (thesis, section 5.2.3.1).

    forward_dynamics   latent, action       -> next latent
    inverse_dynamics   latent, next latent  -> action
    egomotion          latent, latent of the image rotated -> angle
    autoencoder        latent               -> image
    optical_flow       latent, next latent  -> strength of the optical flow

Each is a head, a loss and a target, in a file of its own. An `AuxTask` is a head and its loss, functions of parameters and of a
`View` of latents and targets, and knows nothing of the encoder. Targets (`make_targets`) are functions of raw images alone, so
they can be computed for every batch that is sampled, or once for every transition that is collected.
"""

import dataclasses
import zlib
from collections.abc import Callable, Collection, Sequence
from typing import get_args

import jax

from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.learner.auxtasks import autoencoder, egomotion, forward_dynamics, inverse_dynamics, optical_flow
from jaxrl_vis.learner.auxtasks.task import AuxTask, Spec, View
from jaxrl_vis.methods import AuxTaskName
from jaxrl_vis.types import Replaceable

__all__ = [
    "NAMES",
    "RELEASE",
    "AuxTask",
    "Options",
    "Spec",
    "Targets",
    "View",
    "head_number",
    "make",
    "make_targets",
    "needs_of",
]

NAMES: tuple[str, ...] = get_args(AuxTaskName)
"""The tasks; first those of the thesis, in its order."""

# Heads of these have begun with these numbers since there were runs.
_NUMBERS = {"forward_dynamics": 0, "inverse_dynamics": 1, "egomotion": 2, "autoencoder": 3, "optical_flow": 4}


@dataclasses.dataclass(frozen=True)
class Options:
    """Where the thesis and the authors' release differ; the defaults are the thesis's, `RELEASE` the others.

    Attributes:
        detach: Whether the loss of forward dynamics leaves the next latent alone. The thesis does not say; in the release, it
            does not.
        border: What becomes of the corners that a rotation leaves empty.
        max_shift: Farthest shift that comes with a rotation, as a share of the image's size.
        in_grey: Whether the autoencoder reconstructs one grey channel rather than the observation.
        stretch: Whether each mask of optical flow is stretched to [0, 1], rather than being in pixels.
    """

    detach: bool = True
    border: egomotion.Border = "clip"
    max_shift: float = 0.0
    in_grey: bool = False
    stretch: bool = False


RELEASE = Options(detach=False, border="zero", max_shift=egomotion.RELEASE_SHIFT, in_grey=True, stretch=True)
"""The authors' release."""

_MAKERS: dict[str, Callable[[Spec, Options], AuxTask]] = {
    "forward_dynamics": lambda spec, options: forward_dynamics.make(spec, options.detach),
    "inverse_dynamics": lambda spec, _: inverse_dynamics.make(spec),
    "egomotion": lambda spec, options: egomotion.make(spec, options.max_shift),
    "autoencoder": lambda spec, options: autoencoder.make(spec, options.in_grey),
    "optical_flow": lambda spec, _: optical_flow.make(spec),
}


def make(names: Sequence[str], spec: Spec, options: Options = Options()) -> dict[str, AuxTask]:
    """The tasks of these names, by name.

    Args:
        names: Some of `NAMES`, or none.
        spec: Sizes of the observation, the action and the latent.
        options: Where the thesis and the release differ.

    Raises:
        RequestError: A name is unknown or given twice, or there are no images.
    """
    for name in names:
        if name not in NAMES:
            raise RequestError(f"unknown auxiliary task {name!r}{nearest(name, NAMES)}")
        if names.count(name) > 1:
            raise RequestError(f"auxiliary task {name} is given twice; give it once")
    shape = spec.observation.shape
    if names and len(shape) != 3:
        raise RequestError(
            f"auxiliary tasks ({', '.join(names)}) train an encoder of images, and here observations are states of "
            f"{shape[0]} numbers: choose a task that shows images (its name begins with Visual), or no auxiliary tasks"
        )
    return {name: _MAKERS[name](spec, options) for name in names}


def head_number(name: str) -> int:
    """Number folded into the key of a task's head, uint32: heads start alike whichever other tasks there are, in any order."""
    return _NUMBERS[name] if name in _NUMBERS else zlib.crc32(name.encode())


def needs_of(tasks: dict[str, AuxTask]) -> frozenset[str]:
    """The optional fields of `View` that any of these tasks reads."""
    return frozenset().union(*(task.needs for task in tasks.values()))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Targets(Replaceable):
    """What auxiliary tasks are to predict, as far as it follows from raw images; None where nobody needs it.

    Attributes:
        images_moved: [B, C, H, W] uint8, the images before the action, rotated; their latents are ``View.latent_moved``.
        motion: As of `View`.
        flow: As of `View`.
    """

    images_moved: jax.Array | None = None
    motion: jax.Array | None = None
    flow: jax.Array | None = None


def make_targets(
    key: jax.Array,
    images_t: jax.Array,
    images_tp1: jax.Array,
    needs: Collection[str],
    options: Options = Options(),
    frame_stack: int = 1,
) -> Targets:
    """The targets of B transitions that some tasks need.

    Args:
        key: [] a typed key, for rotations.
        images_t: [B, C, H, W] uint8, before the action.
        images_tp1: The same after it.
        needs: From `needs_of`.
        options: As the tasks were made with.
        frame_stack: Images that an observation stacks.
    """
    targets = Targets()
    if "motion" in needs:
        images_moved, motion = egomotion.egomotion_pair(key, images_t, options.border, options.max_shift)
        targets = targets.replace(images_moved=images_moved, motion=motion)
    if "flow" in needs:
        targets = targets.replace(flow=optical_flow.flow_strength(images_t, images_tp1, frame_stack, options.stretch))
    return targets
