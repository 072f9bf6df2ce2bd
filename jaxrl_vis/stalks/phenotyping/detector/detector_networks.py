"""Flax networks: backbone, region proposals, box head and segmentation. Images are [N, H, W, C], float32 or bfloat16.

Stalks are tall, thin, and side by side. So the feature map is finer horizontally than vertically, and kernels are taller than
wide.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp

STRIDE = (8, 4)
"""Vertical and horizontal stride of the backbone's feature map, pixels."""
ANCHOR_STRIDE = (16, 4)
"""Vertical and horizontal stride of the anchors, pixels."""
PADDING = 32
"""Number of pixels by which the height and width of an image must be divisible: the largest stride of the backbone."""


class Block(nn.Module):
    """Residual block of two convolutions with group normalisation.

    Attributes:
        channels: Number of output channels, a multiple of 8.
        kernel: Height and width of both kernels.
        strides: Vertical and horizontal stride of the first convolution.
        dtype: Compute dtype.
    """

    channels: int
    kernel: tuple[int, int] = (3, 3)
    strides: tuple[int, int] = (1, 1)
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Apply the block to features [N, H, W, C], and return [N, H / strides[0], W / strides[1], channels], rounded up."""
        y = nn.Conv(self.channels, self.kernel, self.strides, dtype=self.dtype, use_bias=False)(x)
        y = nn.relu(nn.GroupNorm(num_groups=None, group_size=8, dtype=self.dtype)(y))
        y = nn.Conv(self.channels, self.kernel, dtype=self.dtype, use_bias=False)(y)
        y = nn.GroupNorm(num_groups=None, group_size=8, dtype=self.dtype)(y)
        if x.shape[-1] != self.channels or self.strides != (1, 1):
            x = nn.Conv(self.channels, (1, 1), self.strides, dtype=self.dtype, use_bias=False)(x)
        return nn.relu(x + y)


class Detector(nn.Module):
    """Two-stage detector: backbone, region proposals, and the box head that classifies and refines them.

    Attributes:
        channels: Channels from the finest to the coarsest level; multiples of 8. Features have those of the third.
        hidden: Units of the box head.
        anchors: Number of anchors at each location.
        rows: Number of vertically adjacent anchor locations that are averaged to one: with sections, those of a band; else 1.
        dtype: Compute dtype of the convolutions.
    """

    channels: tuple[int, int, int, int] = (24, 48, 64, 64)
    hidden: int = 128
    anchors: int = 3
    rows: int = 1
    dtype: jnp.dtype = jnp.float32

    def setup(self) -> None:
        """Define the layers."""
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
        """Compute features [N, H / 8, W / 4, C] of images [N, H, W, 3], see `detect.normalize`."""
        x = nn.relu(self.stem(images.astype(self.dtype)))
        for block in (*self.fine, *self.middle):
            x = block(x)
        middle = x
        for block in self.coarse:
            x = block(x)
        coarse = x
        for block in self.coarsest:
            x = block(x)
        up = _upsample(self.lateral[0](x)) + self.lateral[1](coarse)
        return self.merge(middle + _upsample(up))

    def propose(self, features: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return objectness logits [N, K] and box offsets [N, K, 6], float32, of all anchors, in row-major order.

        ``features`` [N, h, w, C] are those of `features`.
        """
        x = nn.relu(self.tall(features))
        count = x.shape[0]
        if self.rows > 1:
            x = x.reshape(count, -1, self.rows, *x.shape[2:]).mean(axis=2)
        return self.objectness(x).reshape(count, -1), self.offsets(x).reshape(count, -1, 6)

    def classify(self, regions: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return logits [R] and box offsets [R, 6], float32, of pooled regions [R, h, w, C]."""
        x = regions.astype(self.dtype)
        for look in self.looks:
            x = nn.relu(look(x))
        x = nn.relu(self.dense(x.reshape(x.shape[0], -1)))
        return self.judge(x)[:, 0], self.refine(x)

    def __call__(self, images: jax.Array, regions: jax.Array) -> tuple[jax.Array, ...]:
        """Run all parts once, for initialisation, and return the outputs of `features`, `propose` and `classify`."""
        features = self.features(images)
        return (features, *self.propose(features), *self.classify(regions))


class Segmenter(nn.Module):
    """Small U-Net from stalk crops [N, H, W, 3] to logits [N, H, W] of the stalk in the centre.

    Attributes:
        channels: Channels of each level, multiples of 8.
        dtype: Compute dtype of the convolutions.
    """

    channels: tuple[int, ...] = (16, 32, 48, 64)
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, crops: jax.Array) -> jax.Array:
        """Return mask logits [N, H, W] float32 of stalk crops [N, H, W, 3], preprocessed by `stalk_crops.preprocess_crops`."""
        x = crops.astype(self.dtype)
        across = jnp.linspace(-1.0, 1.0, x.shape[2], dtype=self.dtype)
        # The horizontal distance from the centre tells the network which stalk is meant.
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


def _upsample(x: jax.Array) -> jax.Array:
    """Upsample by a factor of 2, by repeating each row and column."""
    return jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)
