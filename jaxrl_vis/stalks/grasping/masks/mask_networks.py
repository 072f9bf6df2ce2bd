"""The networks of pix2pix (Isola et al. 2017), small: a U-Net that paints, and a PatchGAN that judges what it painted.

The thesis's generator learns against a discriminator; the same generator with one output in place of three learns as a plain
segmentation. Images are [N, H, W, C], float32 or bfloat16, around 0. Normalisation is by groups, so that an image is treated
alike alone and in a batch, and no features are dropped: pix2pix does that to paint differently each time, but a robot needs one
answer.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp


class Generator(nn.Module):
    """A U-Net: images [N, H, W, 3] to [N, H, W, outputs]. H and W: multiples of 2 to the number of its levels.

    Attributes:
        channels: Channels of each level; all but the first are multiples of 8.
        outputs: 3 to paint (then between -1 and 1), 1 for logits.
        dtype: In which convolutions are computed.
    """

    channels: tuple[int, ...] = (16, 32, 64, 96, 128, 128)
    outputs: int = 3
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, images: jax.Array) -> jax.Array:
        """Paints, or gives logits."""
        x = images.astype(self.dtype)
        levels = []
        for depth, channels in enumerate(self.channels):
            x = nn.Conv(channels, (4, 4), (2, 2), dtype=self.dtype, use_bias=depth == 0)(x)
            x = _normalised(x, self.dtype) if depth else x
            x = nn.leaky_relu(x, 0.2)
            levels.append(x)
        for channels, skip in zip(reversed(self.channels[:-1]), reversed(levels[:-1])):
            x = nn.ConvTranspose(channels, (4, 4), (2, 2), dtype=self.dtype, use_bias=False)(x)
            x = nn.relu(_normalised(x, self.dtype))
            x = jnp.concatenate([x, skip], axis=-1)
        x = nn.ConvTranspose(self.outputs, (4, 4), (2, 2), dtype=self.dtype)(x).astype(jnp.float32)
        return jnp.tanh(x) if self.outputs == 3 else x


class Discriminator(nn.Module):
    """PatchGAN: for each patch of 70 x 70 pixels, whether a painting belongs to its image. Logits [N, h, w].

    Attributes:
        channels: Channels of each layer; the last two keep the resolution.
        dtype: In which convolutions are computed.
    """

    channels: tuple[int, ...] = (32, 64, 128, 128)
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, images: jax.Array, paintings: jax.Array) -> jax.Array:
        """Logits, above 0 for paintings that look true."""
        x = jnp.concatenate([images, paintings], axis=-1).astype(self.dtype)
        for depth, channels in enumerate(self.channels):
            strides = (2, 2) if depth < len(self.channels) - 1 else (1, 1)
            x = nn.Conv(channels, (4, 4), strides, dtype=self.dtype, use_bias=depth == 0)(x)
            x = _normalised(x, self.dtype) if depth else x
            x = nn.leaky_relu(x, 0.2)
        return nn.Conv(1, (4, 4), dtype=jnp.float32)(x)[..., 0]


def _normalised(x: jax.Array, dtype: jnp.dtype) -> jax.Array:
    return nn.GroupNorm(num_groups=None, group_size=8, dtype=dtype)(x)
