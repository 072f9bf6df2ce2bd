"""Metrics on their way from the devices to the host.

Reading an array from a GPU takes some 0.1 ms, and one that lies on several GPUs as many times that. So they all travel as one.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.run.storage.metrics import PerSeed
from jaxrl_vis.types import Metrics


@jax.jit
def stacked(metrics: Metrics) -> jax.Array:
    """Metrics of [S] or [], in the order of their names, as [K, S]."""
    return jnp.stack(jnp.broadcast_arrays(*(metrics[name] for name in sorted(metrics))))


class Pending:
    """Metrics that a device may still be working on.

    Args:
        metrics: [S] or [] float32 each, by name. Those that the host has already are left alone.
        stack: `stacked`, or what it was compiled to.
    """

    def __init__(self, metrics: Metrics, stack: Callable[[Metrics], jax.Array] = stacked):
        self._names = sorted(metrics)
        self._rows: Any = [metrics[name] for name in self._names]
        if any(isinstance(value, jax.Array) for value in self._rows):
            self._rows = stack(dict(metrics))
            self._rows.copy_to_host_async()

    def read(self) -> dict[str, np.ndarray]:
        """Wait for them; [S] float32 each, by name."""
        return dict(zip(self._names, np.asarray(self._rows), strict=True))

    def read_per_seed(self, seeds: int) -> PerSeed:
        """Wait for them; of each, one number per seed: the shortest decimal that reads back as the same float32."""
        spread = {name: np.broadcast_to(np.asarray(row, np.float32), (seeds,)) for name, row in self.read().items()}
        return {name: [float(str(number)) for number in row] for name, row in spread.items()}
