"""Snips: strips of an image that follow a stalk, so that it stands upright in the middle, at full resolution.

Each line of a snip is a line of the image, moved by a whole number of pixels: nothing is interpolated, edges stay where they
are, and a mask of the snip is put back exactly.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np

_ALONG = 15  # lines of a snip of full size
_EXPONENT = 0.35


def snip_shape(full: tuple[int, int], share: float) -> tuple[int, int]:
    """Lines and columns of snips: multiples of 8.

    Args:
        full: Shape of the snips of an image of full resolution.
        share: Resolution of the image, of the full one.
    """
    lines, columns = (max(round(length * share / 8), 2) * 8 for length in full)
    return lines, columns


def crop_places(stalks: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels of the image that crops hold. Computed on the host, once for cutting out and for putting back.

    Args:
        stalks: [N, 6], box and columns of the axis at its top and bottom, continuous coordinates of the image.
        shape: Lines and columns of a snip.

    Returns:
        First line of each snip [N] int32, and the first column of each of its lines [N, lines] int32; also beyond the image.
    """
    stalks = np.asarray(stalks, np.float64)
    middle = 0.5 * (stalks[:, 1] + stalks[:, 3])
    top = np.round(middle - 0.5 * shape[0]).astype(np.int32)
    tall = np.maximum(stalks[:, 3] - stalks[:, 1], 1.0)
    line = top[:, None] + np.arange(shape[0]) + 0.5
    share = (line - stalks[:, 1:2]) / tall[:, None]
    axis = stalks[:, 4:5] + (stalks[:, 5:6] - stalks[:, 4:5]) * share
    return top, np.round(axis - 0.5 * shape[1]).astype(np.int32)


def cut(image: jax.Array, stalks: np.ndarray, shape: tuple[int, int]) -> jax.Array:
    """Snips [N, lines, columns, ...] of an image [H, W, ...]; 0 beyond the image.

    Args:
        image: Image of any type.
        stalks: [N, 6]; see `crop_places`.
        shape: Lines and columns of a snip.
    """
    return _cut(image, *crop_places(stalks, shape), shape[1])


@functools.partial(jax.jit, static_argnums=3)
def _cut(image: jax.Array, top: jax.Array, left: jax.Array, across: int) -> jax.Array:
    lines = top[:, None] + jnp.arange(left.shape[1])
    columns = left[..., None] + jnp.arange(across)
    inside = ((lines >= 0) & (lines < image.shape[0]))[..., None] & (columns >= 0) & (columns < image.shape[1])
    taken = image[jnp.clip(lines, 0, image.shape[0] - 1)[..., None], jnp.clip(columns, 0, image.shape[1] - 1)]
    return jnp.where(inside.reshape(*inside.shape, *(1,) * (image.ndim - 2)), taken, jnp.zeros((), image.dtype))


def smoothed(snips: jax.Array) -> jax.Array:
    """Snips [N, h, w, 3] uint8 as the segmentation sees them: float32 around 0, with less of their texture.

    Edges run along a stalk and its texture mostly does not, so each line is the mean of 15; and the contrast of what is bright
    is lowered. On textures that the networks never saw, that takes away most of what makes masks too narrow.
    """
    beside = _ALONG // 2
    values = jnp.pad(snips.astype(jnp.float32) / 255.0, ((0, 0), (beside, beside), (0, 0), (0, 0)), mode="edge")
    sums = jax.lax.reduce_window(values, 0.0, jax.lax.add, (1, _ALONG, 1, 1), (1, 1, 1, 1), "VALID")
    return 2.0 * jnp.maximum(sums / _ALONG, 0.0) ** _EXPONENT - 1.0


def put_back(snip: np.ndarray, stalk: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, tuple[int, int]]:
    """A snip's values where they are in the image.

    Args:
        snip: [lines, columns] float32.
        stalk: [6] of its stalk.
        size: Height and width of the image.

    Returns:
        [h, w] float32, 0 where the snip holds nothing, and line and column of its first pixel in the image.
    """
    top, left = (edge[0] for edge in crop_places(stalk[None], (snip.shape[0], snip.shape[1])))
    columns = snip.shape[1]
    used = np.flatnonzero((top + np.arange(snip.shape[0]) >= 0) & (top + np.arange(snip.shape[0]) < size[0]))
    begin, end = max(int(left.min()), 0), min(int(left.max()) + columns, size[1])
    if not used.size or end <= begin:
        return np.zeros((0, 0), np.float32), (0, 0)
    whole = np.zeros((used.size, end - begin), np.float32)
    # Lines that lie equally far to the right go together.
    places = left[used] - begin
    breaks = [0, *(np.flatnonzero(np.diff(places)) + 1).tolist(), used.size]
    for first, last in itertools.pairwise(breaks):
        place = int(places[first])
        low, high = max(place, 0), min(place + columns, end - begin)
        if high > low:
            whole[first:last, low:high] = snip[used[first] : used[last - 1] + 1, low - place : high - place]
    return whole, (int(top + used[0]), begin)
