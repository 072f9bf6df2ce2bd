"""Stalk crops: full-resolution crops of an image, sheared so that the stalk stands upright in the centre.

Each row of a crop is a part of an image row, shifted by a whole number of pixels: there is no interpolation, edges stay where
they are, and a mask of the crop can be pasted back exactly.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np

_AVERAGED_ROWS = 15  # rows of a full-size stalk crop that are averaged
_EXPONENT = 0.35


def crop_shape(full_shape: tuple[int, int], scale: float) -> tuple[int, int]:
    """Return the height and width of stalk crops, multiples of 8 and at least 16.

    Args:
        full_shape: Height and width of crops of a full-resolution image.
        scale: Resolution of the image relative to full resolution.
    """
    height, width = (max(round(length * scale / 8), 2) * 8 for length in full_shape)
    return height, width


def crop_positions(stalks: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of stalk crops in the image, computed on the host for both cutting out and pasting back.

    Args:
        stalks: [N, 6], boxes, and x coordinates of the axis at the top and bottom of the box, in continuous image coordinates.
        shape: Height and width of a crop.

    Returns:
        First image row of each crop [N] int32, and first image column of each of its rows [N, height] int32. Both may lie
        outside the image.
    """
    stalks = np.asarray(stalks, np.float64)
    middle = 0.5 * (stalks[:, 1] + stalks[:, 3])
    top = np.round(middle - 0.5 * shape[0]).astype(np.int32)
    tall = np.maximum(stalks[:, 3] - stalks[:, 1], 1.0)
    row = top[:, None] + np.arange(shape[0]) + 0.5
    fraction = (row - stalks[:, 1:2]) / tall[:, None]
    axis = stalks[:, 4:5] + (stalks[:, 5:6] - stalks[:, 4:5]) * fraction
    return top, np.round(axis - 0.5 * shape[1]).astype(np.int32)


def cut_crops(image: jax.Array, stalks: np.ndarray, shape: tuple[int, int]) -> jax.Array:
    """Cut stalk crops [N, height, width, ...] out of an image [H, W, ...]; 0 outside the image.

    Args:
        image: Image of any dtype, which is that of the crops.
        stalks: [N, 6]; see `crop_positions`.
        shape: Height and width of a crop.
    """
    return _cut(image, *crop_positions(stalks, shape), shape[1])


@functools.partial(jax.jit, static_argnums=3)
def _cut(image: jax.Array, top: jax.Array, left: jax.Array, width: int) -> jax.Array:
    rows = top[:, None] + jnp.arange(left.shape[1])
    columns = left[..., None] + jnp.arange(width)
    inside = ((rows >= 0) & (rows < image.shape[0]))[..., None] & (columns >= 0) & (columns < image.shape[1])
    taken = image[jnp.clip(rows, 0, image.shape[0] - 1)[..., None], jnp.clip(columns, 0, image.shape[1] - 1)]
    return jnp.where(inside.reshape(*inside.shape, *(1,) * (image.ndim - 2)), taken, jnp.zeros((), image.dtype))


def preprocess_crops(crops: jax.Array) -> jax.Array:
    """Preprocess stalk crops [N, h, w, 3] for segmentation: float32 in [-1, 1], smoothed along the stalk.

    Values are averaged over 15 rows, as edges run along a stalk and texture mostly does not, and bright tones are compressed.
    On textures not seen in training, this removes most of the bias towards narrow masks.

    Args:
        crops: Stalk crops, uint8 or float from 0 to 255.
    """
    margin = _AVERAGED_ROWS // 2
    values = jnp.pad(crops.astype(jnp.float32) / 255.0, ((0, 0), (margin, margin), (0, 0), (0, 0)), mode="edge")
    sums = jax.lax.reduce_window(values, 0.0, jax.lax.add, (1, _AVERAGED_ROWS, 1, 1), (1, 1, 1, 1), "VALID")
    return 2.0 * jnp.maximum(sums / _AVERAGED_ROWS, 0.0) ** _EXPONENT - 1.0


def paste_crop(crop: np.ndarray, stalk: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, tuple[int, int]]:
    """Paste a stalk crop back to its position in the image.

    Args:
        crop: Values [height, width] float32 of the crop, such as a mask.
        stalk: [6], stalk that the crop was cut along; see `crop_positions`.
        size: Height and width of the image.

    Returns:
        Part of the image [h, w] float32, 0 outside the crop, and the image row and column of its first pixel; empty if the crop
        lies outside the image.
    """
    top, left = (edge[0] for edge in crop_positions(stalk[None], (crop.shape[0], crop.shape[1])))
    columns = crop.shape[1]
    used = np.flatnonzero((top + np.arange(crop.shape[0]) >= 0) & (top + np.arange(crop.shape[0]) < size[0]))
    begin, end = max(int(left.min()), 0), min(int(left.max()) + columns, size[1])
    if not used.size or end <= begin:
        return np.zeros((0, 0), np.float32), (0, 0)
    pasted = np.zeros((used.size, end - begin), np.float32)
    # Rows with the same horizontal shift are copied together.
    places = left[used] - begin
    breaks = [0, *(np.flatnonzero(np.diff(places)) + 1).tolist(), used.size]
    for first, last in itertools.pairwise(breaks):
        place = int(places[first])
        low, high = max(place, 0), min(place + columns, end - begin)
        if high > low:
            pasted[first:last, low:high] = crop[used[first] : used[last - 1] + 1, low - place : high - place]
    return pasted, (int(top + used[0]), begin)
