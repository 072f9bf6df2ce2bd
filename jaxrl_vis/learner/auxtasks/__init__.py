"""Auxiliary tasks, which an encoder's latents should also serve (thesis, section 5.2.3.1).

    forward_dynamics   latent, action       -> next latent
    inverse_dynamics   latent, next latent  -> action
    egomotion          latent, latent of the image rotated -> angle
    autoencoder        latent               -> image
    optical_flow       latent, next latent  -> magnitude of the optical flow

Each is a separate file with a function ``make`` of a `Spec`. An `AuxTask` declares its inputs; the learner encodes, stores and
samples what the tasks of a run declare, without referring to any task by name.
"""

from collections.abc import Callable, Sequence

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.plugins import build_component, find_component
from jaxrl_vis.learner.auxtasks import autoencoder, egomotion, forward_dynamics, inverse_dynamics, optical_flow
from jaxrl_vis.learner.auxtasks.task import RELEASE, AuxTask, Options, Spec, Transitions, View

__all__ = ["NAMES", "RELEASE", "AuxTask", "Options", "Spec", "Transitions", "View", "make"]

_MAKERS: dict[str, Callable[[Spec], AuxTask]] = {
    "forward_dynamics": forward_dynamics.make,
    "inverse_dynamics": inverse_dynamics.make,
    "egomotion": egomotion.make,
    "autoencoder": autoencoder.make,
    "optical_flow": optical_flow.make,
}

NAMES: tuple[str, ...] = tuple(_MAKERS)
"""Names of the built-in tasks, in the order of the thesis."""


def make(names: Sequence[str], spec: Spec, folder: str | None = None) -> dict[str, AuxTask]:
    """Build the named tasks; return them by `AuxTask.name`.

    Args:
        names: Names out of `NAMES`, or ``module:Name`` of functions of a `Spec` that return an `AuxTask`; may be empty.
        spec: Sizes of the observation, the action and the latent.
        folder: Folder from which modules are imported first; None to begin with the current folder.

    Raises:
        RequestError: A name is unknown or occurs twice, a function does not return an `AuxTask`, two tasks have the same
            `AuxTask.name`, or observations are not images.
    """
    makers = [find_component("auxiliary task", name, _MAKERS, folder) for name in names]
    for name in names:
        if names.count(name) > 1:
            raise RequestError(f"auxiliary task {name} is given twice; give it once")
    shape = spec.observation.shape
    if names and len(shape) != 3:
        raise RequestError(
            f"auxiliary tasks ({', '.join(names)}) train an encoder of images, and here observations are states of "
            f"{shape[0]} numbers: choose a task that shows images (its name begins with Visual), or no auxiliary tasks"
        )
    built = [build_component("auxiliary task", name, maker, spec, expected_type=AuxTask) for name, maker in zip(names, makers)]
    tasks = {task.name: task for task in built}
    if len(tasks) < len(built):
        raise RequestError(f"two auxiliary tasks have the same name ({', '.join(task.name for task in built)}): rename one")
    return tasks
