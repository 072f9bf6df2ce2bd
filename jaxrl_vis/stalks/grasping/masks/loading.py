"""Loading of the mask network that a command selects by a file of weights, or by its loss."""

import functools
from pathlib import Path

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.digests import file_digest
from jaxrl_vis.stalks.grasping.masks.painter import SHIPPED, Loss, Painter, read_weights


def resolve_weights(weights: Path | None, loss: Loss) -> tuple[Path, str]:
    """Return the network's weights file, and a name of the network that contains a digest of the file.

    Args:
        weights: File from ``grasp train``; None for the shipped one, a segmentation network.
        loss: Loss of the network; used only if ``weights`` is None.

    Raises:
        RequestError: The weights cannot be read, or the package ships none for this loss.
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
    """Return the network with these weights; cached, so that a process reads a file once.

    Raises:
        RequestError: The weights cannot be read.
    """
    params, settings, _ = read_weights(weights)
    return Painter(params, settings)
