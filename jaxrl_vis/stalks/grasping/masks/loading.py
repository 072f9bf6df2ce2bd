"""Loading of the network of masks that a command names by a file of weights, or by its loss."""

import functools
from pathlib import Path

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.digests import file_digest
from jaxrl_vis.stalks.grasping.masks.painter import SHIPPED, Loss, Painter, read_weights


def resolve_weights(weights: Path | None, loss: Loss) -> tuple[Path, str]:
    """Return the file of the network's weights and a name of the network, which changes with the contents of the file.

    Args:
        weights: File from ``grasp train``; None for the shipped one, which is a segmentation.
        loss: Loss of the network that is wanted where ``weights`` is None.

    Raises:
        RequestError: The weights cannot be read, or do not ship.
    """
    if weights is None and loss == "gan":
        raise RequestError(
            "weights of the GAN do not ship: train them on a GPU with `jaxrl-vis grasp train gan.safetensors --loss gan "
            "--minutes 5`, and name them with --weights gan.safetensors"
        )
    path = SHIPPED if weights is None else weights
    _, settings, _ = read_weights(path)
    return path, f"{settings.loss} {file_digest(path)}"


@functools.cache
def load_painter(weights: Path) -> Painter:
    """Return the network with these weights; a process reads a file once.

    Raises:
        RequestError: The weights cannot be read.
    """
    params, settings, _ = read_weights(weights)
    return Painter(params, settings)
