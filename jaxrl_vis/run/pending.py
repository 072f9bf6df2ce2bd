"""Metrics on their way from the devices to the host.

Reading an array from a GPU takes some 0.1 ms, and one that lies on several GPUs as many times that. So they all travel as one.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.types import Metrics


@jax.jit
def _stacked(metrics: Metrics) -> jax.Array:
    """Metrics of [S], in the order of their names, as [K, S]."""
    return jnp.stack(jnp.broadcast_arrays(*(metrics[name] for name in sorted(metrics))))


class Pending:
    """Metrics that a device may still be working on.

    Args:
        metrics: [S] or [] float32 each, by name.
    """

    def __init__(self, metrics: Metrics):
        self._names = sorted(metrics)
        self._rows = _stacked(dict(metrics))
        self._rows.copy_to_host_async()

    def read(self) -> dict[str, np.ndarray]:
        """Waits for them; [S] float32 each, by name."""
        return dict(zip(self._names, np.asarray(self._rows), strict=True))
