"""Small versions of the networks of pix2pix (Isola et al. 2017): a U-Net generator and a PatchGAN discriminator.

The thesis's generator is trained against a discriminator; the same network with one output channel instead of three is trained
as a plain segmentation. Images are [N, H, W, C], float32 or bfloat16, normalised to -1 to 1. Group normalisation makes the
output for an image independent of the batch. There is no dropout, which pix2pix uses to randomise its output: a robot needs a
deterministic one.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp


class Generator(nn.Module):
    """U-Net from images [N, H, W, 3] to [N, H, W, outputs] float32. H and W must be multiples of 2^len(channels).

    Attributes:
        channels: Channels of each level, multiples of 8.
        outputs: Number of output channels: 3 for painted images in -1 to 1, 1 for logits of the mask.
        dtype: Compute dtype of the convolutions.
    """

    channels: tuple[int, ...] = (16, 32, 64, 96, 128, 128)
    outputs: int = 3
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, images: jax.Array) -> jax.Array:
        """Return painted images or logits of masks, depending on ``outputs``, as [N, H, W, outputs] float32."""
        x = images.astype(self.dtype)
        levels = []
        for depth, channels in enumerate(self.channels):
            x = nn.Conv(channels, (4, 4), (2, 2), dtype=self.dtype, use_bias=depth == 0)(x)
            x = _normalize(x, self.dtype) if depth else x
            x = nn.leaky_relu(x, 0.2)
            levels.append(x)
        for channels, skip in zip(reversed(self.channels[:-1]), reversed(levels[:-1])):
            x = nn.ConvTranspose(channels, (4, 4), (2, 2), dtype=self.dtype, use_bias=False)(x)
            x = nn.relu(_normalize(x, self.dtype))
            x = jnp.concatenate([x, skip], axis=-1)
        x = nn.ConvTranspose(self.outputs, (4, 4), (2, 2), dtype=self.dtype)(x).astype(jnp.float32)
        return jnp.tanh(x) if self.outputs == 3 else x


class Discriminator(nn.Module):
    """PatchGAN discriminator: classifies each patch of 70 x 70 pixels of a painted image as true or generated.

    Attributes:
        channels: Channels of the hidden layers; the last of these and the output layer keep the resolution.
        dtype: Compute dtype of the convolutions in the hidden layers.
    """

    channels: tuple[int, ...] = (32, 64, 128, 128)
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, images: jax.Array, paintings: jax.Array) -> jax.Array:
        """Return logits [N, h, w] float32 of images and paintings, both [N, H, W, 3]; positive where paintings seem true."""
        x = jnp.concatenate([images, paintings], axis=-1).astype(self.dtype)
        for depth, channels in enumerate(self.channels):
            strides = (2, 2) if depth < len(self.channels) - 1 else (1, 1)
            x = nn.Conv(channels, (4, 4), strides, dtype=self.dtype, use_bias=depth == 0)(x)
            x = _normalize(x, self.dtype) if depth else x
            x = nn.leaky_relu(x, 0.2)
        return nn.Conv(1, (4, 4), dtype=jnp.float32)(x)[..., 0]


def _normalize(x: jax.Array, dtype: jnp.dtype) -> jax.Array:
    return nn.GroupNorm(num_groups=None, group_size=8, dtype=dtype)(x)
