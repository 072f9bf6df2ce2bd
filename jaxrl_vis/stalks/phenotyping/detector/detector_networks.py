"""The networks: backbone, proposals, box head and segmentation. Images are [N, H, W, C], float32 or bfloat16.

Stalks are tall and thin, and stand side by side. So the features that boxes are found in are finer across the row than up and
down, and kernels are taller than wide.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp

STRIDE = (8, 4)
"""Lines and columns of the image per feature of the backbone."""
ANCHOR_STRIDE = (16, 4)
"""The same per place at which boxes are proposed."""
PADDING = 32
"""Divisor of the height and width of an image."""


class Block(nn.Module):
    """Two convolutions beside a short cut."""

    channels: int
    kernel: tuple[int, int] = (3, 3)
    strides: tuple[int, int] = (1, 1)
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Features [N, H, W, C]."""
        y = nn.Conv(self.channels, self.kernel, self.strides, dtype=self.dtype, use_bias=False)(x)
        y = nn.relu(nn.GroupNorm(num_groups=None, group_size=8, dtype=self.dtype)(y))
        y = nn.Conv(self.channels, self.kernel, dtype=self.dtype, use_bias=False)(y)
        y = nn.GroupNorm(num_groups=None, group_size=8, dtype=self.dtype)(y)
        if x.shape[-1] != self.channels or self.strides != (1, 1):
            x = nn.Conv(self.channels, (1, 1), self.strides, dtype=self.dtype, use_bias=False)(x)
        return nn.relu(x + y)


class Detector(nn.Module):
    """Backbone and proposals, and the head that judges them.

    Attributes:
        channels: Channels of the finest to the coarsest level; multiples of 8.
        hidden: Units of the box head.
        anchors: Boxes that are proposed in each place.
        dtype: In which convolutions are computed.
    """

    channels: tuple[int, int, int, int] = (24, 48, 64, 64)
    hidden: int = 128
    anchors: int = 3
    dtype: jnp.dtype = jnp.float32

    def setup(self) -> None:
        """Names the layers."""
        first, second, third, fourth = self.channels
        self.stem = nn.Conv(first, (7, 7), (2, 2), dtype=self.dtype)
        self.fine = [Block(second, (3, 3), (2, 2), self.dtype), Block(second, dtype=self.dtype)]
        self.middle = [Block(third, (3, 3), (2, 1), self.dtype), Block(third, (5, 3), dtype=self.dtype)]
        self.coarse = [Block(fourth, (5, 3), (2, 2), self.dtype), Block(fourth, (7, 3), dtype=self.dtype)]
        self.coarsest = [Block(fourth, (7, 3), (2, 2), self.dtype), Block(fourth, (7, 3), dtype=self.dtype)]
        self.lateral = [nn.Conv(third, (1, 1), dtype=self.dtype) for _ in range(2)]
        self.merge = Block(third, (3, 3), dtype=self.dtype)
        self.tall = nn.Conv(third, (9, 3), (2, 1), dtype=self.dtype)
        self.objectness = nn.Conv(self.anchors, (1, 1), bias_init=nn.initializers.constant(-4.0), dtype=jnp.float32)
        self.offsets = nn.Conv(6 * self.anchors, (1, 1), kernel_init=nn.initializers.normal(0.01), dtype=jnp.float32)
        self.looks = [nn.Conv(third, (3, 3), dtype=self.dtype), nn.Conv(third, (3, 3), (2, 1), dtype=self.dtype)]
        self.dense = nn.Dense(self.hidden, dtype=self.dtype)
        self.judge = nn.Dense(1, dtype=jnp.float32)
        self.refine = nn.Dense(6, kernel_init=nn.initializers.normal(0.01), dtype=jnp.float32)

    def features(self, images: jax.Array) -> jax.Array:
        """Images [N, H, W, 3], around 0, as features [N, H / 8, W / 4, C]."""
        x = nn.relu(self.stem(images.astype(self.dtype)))
        for block in (*self.fine, *self.middle):
            x = block(x)
        middle = x
        for block in self.coarse:
            x = block(x)
        coarse = x
        for block in self.coarsest:
            x = block(x)
        up = _twice(self.lateral[0](x)) + self.lateral[1](coarse)
        return self.merge(middle + _twice(up))

    def propose(self, features: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Objectness logits [N, K] and codes [N, K, 6] of all anchors, line by line."""
        x = nn.relu(self.tall(features))
        count = x.shape[0]
        return self.objectness(x).reshape(count, -1), self.offsets(x).reshape(count, -1, 6)

    def classify(self, regions: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Logits [R] and codes [R, 6] of regions [R, h, w, C]."""
        x = regions.astype(self.dtype)
        for look in self.looks:
            x = nn.relu(look(x))
        x = nn.relu(self.dense(x.reshape(x.shape[0], -1)))
        return self.judge(x)[:, 0], self.refine(x)

    def __call__(self, images: jax.Array, regions: jax.Array) -> tuple[jax.Array, ...]:
        """Everything once, to make parameters."""
        features = self.features(images)
        return (features, *self.propose(features), *self.classify(regions))


class Segmenter(nn.Module):
    """A small U-Net: snips [N, H, W, 3], around 0, to logits [N, H, W] of the stalk in the middle. H and W: multiples of 8."""

    channels: tuple[int, ...] = (16, 32, 48, 64)
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, snips: jax.Array) -> jax.Array:
        """Logits [N, H, W]."""
        x = snips.astype(self.dtype)
        across = jnp.linspace(-1.0, 1.0, x.shape[2], dtype=self.dtype)
        # Which stalk is meant is known from where it is: in the middle.
        x = jnp.concatenate([x, jnp.broadcast_to(jnp.abs(across)[None, None, :, None], (*x.shape[:3], 1))], axis=-1)
        levels = []
        for depth, channels in enumerate(self.channels):
            strides = (1, 1) if depth == 0 else (2, 2)
            x = nn.relu(nn.Conv(channels, (3, 3), strides, dtype=self.dtype)(x))
            x = nn.Conv(channels, (5, 3) if depth else (3, 3), dtype=self.dtype, use_bias=False)(x)
            x = nn.relu(nn.GroupNorm(num_groups=None, group_size=8, dtype=self.dtype)(x))
            levels.append(x)
        x = nn.relu(nn.Conv(self.channels[-1], (9, 3), dtype=self.dtype)(x))
        for channels, skip in zip(reversed(self.channels[:-1]), reversed(levels[:-1])):
            x = nn.Conv(channels, (1, 1), dtype=self.dtype)(x)
            x = jax.image.resize(x, (*x.shape[:1], *skip.shape[1:3], channels), "bilinear") + skip
            x = nn.relu(nn.Conv(channels, (3, 3), dtype=self.dtype)(x))
        return nn.Conv(1, (3, 3), dtype=jnp.float32, bias_init=nn.initializers.constant(-1.0))(x)[..., 0]


def _twice(x: jax.Array) -> jax.Array:
    """Each line and column twice."""
    return jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)
