"""Shards of one learner, seen from within one of them: averages over the shards, and each shard's part of an array.

Every method here is called within a mapped axis `DATA` (of `jax.shard_map` or `jax.vmap`), unless there is only one shard: then
nothing is communicated, and averages, sums and parts are the arguments themselves.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
from jax.flatten_util import ravel_pytree

DATA = "data"
"""Name of the mapped axis of shards."""


@dataclasses.dataclass(frozen=True)
class Shards:
    """Shards of one learner.

    Attributes:
        count: Number of shards.
    """

    count: int = 1

    def mean(self, tree: Any) -> Any:
        """Average a pytree of float32 arrays over the shards, by one all-reduce of one flat buffer."""
        if self.count == 1:
            return tree
        flat, restore = ravel_pytree(tree)
        return restore(jax.lax.pmean(flat, DATA))

    def total(self, array: jax.Array) -> jax.Array:
        """Sum an array over the shards; the same shape."""
        return array if self.count == 1 else jax.lax.psum(array, DATA)

    def global_mean(self, mean: jax.Array) -> jax.Array:
        """Average a mean [...] over the shards, with the gradient of this shard alone, to be averaged by `mean` itself."""
        return mean if self.count == 1 else mean + jax.lax.stop_gradient(self.mean(mean) - mean)

    def part(self, array: jax.Array) -> jax.Array:
        """Return this shard's part [B / count, ...] of an array [B, ...] of the whole learner."""
        if self.count == 1:
            return array
        size = array.shape[0] // self.count
        return jax.lax.dynamic_slice_in_dim(array, jax.lax.axis_index(DATA) * size, size)

    def draw(self, draw: Callable[[tuple[int, ...]], jax.Array], shape: tuple[int, ...]) -> jax.Array:
        """Sample this shard's part, of ``shape``, of the random numbers of the whole learner.

        Args:
            draw: shape -> random numbers, with a key that all shards share.
            shape: Shape of this part; the first axis is divided among shards.
        """
        return self.part(draw((shape[0] * self.count, *shape[1:])))

    def noise(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Sample standard normal numbers of ``shape`` for this shard's images, independent of the number of shards."""
        return self.draw(lambda size: jax.random.normal(key, size), shape)

    def split(self, key: jax.Array, count: int) -> jax.Array:
        """Return a typed key for each of the ``count`` environments of this shard, [count]."""
        return self.part(jax.random.split(key, count * self.count))

    def gather(self, array: jax.Array, axis: int = 0) -> jax.Array:
        """Concatenate all shards of an array along ``axis``."""
        return array if self.count == 1 else jax.lax.all_gather(array, DATA, axis=axis, tiled=True)

    def own_key(self, key: jax.Array) -> jax.Array:
        """Derive a typed key [] that differs between shards."""
        return key if self.count == 1 else jax.random.fold_in(key, jax.lax.axis_index(DATA))


ONE = Shards()
"""The only shard of an undivided learner."""
