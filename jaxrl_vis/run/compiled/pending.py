"""Asynchronous transfer of metrics to the host.

Reading an array from a GPU takes about 0.1 ms, times the number of GPUs. So all metrics are copied as one array.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.run.storage.metrics import PerSeed
from jaxrl_vis.types import Metrics


@jax.jit
def stack_metrics(metrics: Metrics) -> jax.Array:
    """Stack K metrics, [S] or [] each, in the order of their names: [K, S], or [K] if all are []."""
    return jnp.stack(jnp.broadcast_arrays(*(metrics[name] for name in sorted(metrics))))


class PendingMetrics:
    """Metrics that a device may still be computing.

    Args:
        metrics: [S] or [] float32 each, by name. NumPy arrays are kept as they are.
        stack: `stack_metrics`, or its compiled program.
    """

    def __init__(self, metrics: Metrics, stack: Callable[[Metrics], jax.Array] = stack_metrics):
        self._names = sorted(metrics)
        self._rows: Any = [metrics[name] for name in self._names]
        if any(isinstance(value, jax.Array) for value in self._rows):
            self._rows = stack(dict(metrics))
            self._rows.copy_to_host_async()

    def read(self) -> dict[str, np.ndarray]:
        """Wait for the metrics; return them by name, [S] or [] float32 each."""
        return dict(zip(self._names, np.asarray(self._rows), strict=True))

    def read_per_seed(self, seeds: int) -> PerSeed:
        """Wait for the metrics; return one number per seed, the shortest decimal that represents the same float32."""
        spread = {name: np.broadcast_to(np.asarray(row, np.float32), (seeds,)) for name, row in self.read().items()}
        return {name: [float(str(number)) for number in row] for name, row in spread.items()}
