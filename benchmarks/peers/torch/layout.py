"""Layouts of images and kernels for the encoder of `learner`.

There are two:

    blocks          nested 2x2 blocks, as in `blocks.to_blocks`: every layer is a matrix product
    convolutions    [H, W, C], PyTorch's channels_last: every layer is a convolution of 2x2 pixels with stride 2
"""

from typing import Any, Literal

import torch  # pyright: ignore[reportMissingImports]

Encoder = Literal["blocks", "convolutions"]
ENCODERS: tuple[Encoder, ...] = ("blocks", "convolutions")


def to_layout(images: Any, encoder: Encoder, levels: int) -> Any:
    """Convert planar images [..., C, H, W] to [..., blocks, 4^levels * C], without incomplete blocks, or [..., H, W, C]."""
    if encoder == "convolutions":
        return images.movedim(-3, -1).contiguous()
    *batch, channels, height, width = images.shape
    rows, columns = height >> levels, width >> levels
    images = images[..., : rows << levels, : columns << levels]
    twos = (2,) * levels
    first = len(batch)
    row_axis, column_axis = first + 1, first + 2 + levels
    pairs = [axis for level in range(1, levels + 1) for axis in (row_axis + level, column_axis + level)]
    images = images.reshape(*batch, channels, rows, *twos, columns, *twos)
    return images.permute(*range(first), row_axis, column_axis, *pairs, first).reshape(*batch, rows * columns, -1)


def from_ours(name: str, parameter: Any, encoder: Encoder) -> Any:
    """Convert one of our parameters to a layout: kernels of convolutions are [outputs, inputs, 2, 2] in channels_last."""
    if encoder == "blocks" or not name.startswith("encoder/kernel_"):
        return parameter.clone()
    rows, outputs = parameter.shape
    kernel = parameter.reshape(2, 2, rows // 4, outputs).permute(3, 2, 0, 1)
    return kernel.contiguous(memory_format=torch.channels_last)


def to_ours(name: str, parameter: Any, encoder: Encoder) -> Any:
    """Invert `from_ours` for a parameter or its gradient."""
    if encoder == "blocks" or not name.startswith("encoder/kernel_"):
        return parameter
    return parameter.permute(2, 3, 1, 0).reshape(-1, parameter.shape[0])
