"""Dense optical flow by polynomial expansion (Farnebäck, "Two-frame motion estimation based on polynomial expansion", 2003).

Around every pixel, an image is fitted by a quadratic f(x) = x'Ax + b'x + c under a Gaussian weight. If the next image is the
same surface displaced by d, its coefficients are A and b - 2Ad, so that

    A d = (b_t - b_t+1) / 2

which is solved in the least-squares sense over a window around the pixel, with the coefficients of the next image sampled at
the previous estimate of the displacement; from coarse levels to fine ones, with several iterations at each.

Smoothing, resizing and the fit, borders included, are the same for all rows and for all columns. They are therefore two
products with small constant matrices, L @ image @ R, into which successive steps are multiplied beforehand: an image is
smoothed, resized and expanded at once. Images are small, so multiplying the zeros of these matrices is cheaper than convolving.

Details that the paper leaves open follow OpenCV's ``calcOpticalFlowFarneback``, with whose flow this agrees: borders are
reflected for smoothing and replicated for the fit, pixels near a border get lower weights, pyramid levels below 32 pixels are
omitted, and the determinant of the equations is regularised by 0.001. The effect of this depends on the unit of the grey
levels: negligible for 0 to 255; for 0 to 1, less than 0.001 pixels of the flow remain in our images.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.learner.auxtasks.images import read_planes_between

_SMALLEST_LEVEL = 32  # pixels
_REGULARIZATION = 1e-3  # of a determinant, in grey levels to the fourth power
_BORDER_WEIGHTS = (0.14, 0.14, 0.4472, 0.4472, 0.4472)  # of the outermost pixels, from the border inwards


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings, called pyr_scale, levels, winsize, iterations, poly_n and poly_sigma in OpenCV; defaults as in the release.

    Attributes:
        scale: Size of a pyramid level relative to the next finer one.
        levels: Maximum number of levels above the image itself; levels that would be too small are omitted.
        window: Width in pixels of the window that shares one displacement; odd.
        iterations: Number of iterations at each level.
        radius: Radius in pixels of the neighbourhood that is fitted.
        sigma: Standard deviation of its Gaussian weight in pixels.
    """

    scale: float = 0.5
    levels: int = 3
    window: int = 15
    iterations: int = 3
    radius: int = 5
    sigma: float = 1.2


Planes = tuple[Any, ...]
"""Quantities of each pixel, as separate images [rows, columns]: stacking them in one array would cost a copy."""


def flow(images: jax.Array, settings: Settings = Settings()) -> jax.Array:
    """Compute the flow from each pixel of images to the next image: [T, H, W, 2] float32, (right, down) in pixels.

    Args:
        images: [T + 1, H, W] grey levels, 0 to 255, of any dtype. Each is expanded only once.
        settings: Window, pyramid, iterations.
    """
    expansions = jax.vmap(functools.partial(_expansions, settings=settings))(images)
    before, after = (jax.tree.map(lambda plane, part=part: plane[part], expansions) for part in (slice(-1), slice(1, None)))
    displace = functools.partial(_displacements, settings=settings)
    return jnp.stack(jax.vmap(displace)(before, after), axis=-1)


def _displacements(before: list[Planes], after: list[Planes], settings: Settings) -> Planes:
    """Compute displacements (right, down) from the expansions of two images, coarsest level first."""
    displacements: Planes = ()
    for expansion_t, expansion_tp1 in zip(before, after, strict=True):
        rows, columns = expansion_t[0].shape
        if not displacements:
            displacements = (jnp.zeros((rows, columns)),) * 2
        else:
            resize_rows, resize_columns = (_resizing(new, old) for new, old in zip((rows, columns), displacements[0].shape))
            displacements = tuple(
                _multiply_planes(resize_rows, plane, resize_columns.T) / settings.scale for plane in displacements
            )
        for _ in range(settings.iterations):
            equations = _equations(expansion_t, expansion_tp1, *displacements)
            displacements = _solve(tuple(_mean_in_window(plane, settings.window) for plane in equations))
    return displacements


def _mean_in_window(plane: jax.Array, window: int) -> jax.Array:
    """Average a plane [H, W] over a square window around each pixel; borders are replicated."""
    rows, columns = (_filter(size, np.full(window, 1.0 / window), "edge") for size in plane.shape)
    return _multiply_planes(rows, plane, columns.T)


def _multiply_planes(left: np.ndarray, plane: jax.Array, right: np.ndarray) -> jax.Array:
    """Compute ``left @ plane @ right`` for a plane [H, W]."""
    return _multiply_left(left, _multiply_right(plane, right))


# In full float32: determinants are differences of large numbers.
def _multiply_right(plane: jax.Array, right: np.ndarray) -> jax.Array:
    return jnp.matmul(plane, right.astype(np.float32), precision=jax.lax.Precision.HIGHEST)


def _multiply_left(left: np.ndarray, plane: jax.Array) -> jax.Array:
    return jnp.matmul(left.astype(np.float32), plane, precision=jax.lax.Precision.HIGHEST)


def _scales(height: int, width: int, settings: Settings) -> list[float]:
    """Return the scales of the pyramid's levels relative to the image, coarsest first."""
    scales = [settings.scale**level for level in range(settings.levels, 0, -1)]
    return [*(scale for scale in scales if min(height, width) * scale >= _SMALLEST_LEVEL), 1.0]


def _filter(size: int, taps: np.ndarray, border: str) -> np.ndarray:
    """Return the matrix [size, size] of the correlation with an odd number of ``taps``; ``border`` as in `np.pad`."""
    source = np.pad(np.arange(size), len(taps) // 2, mode=border)  # type: ignore[call-overload]
    matrix = np.zeros((size, size))
    for tap, weight in enumerate(taps):
        np.add.at(matrix, (np.arange(size), source[tap : tap + size]), weight)
    return matrix


def _gaussian(radius: int, sigma: float) -> np.ndarray:
    """Return Gaussian weights [2 radius + 1] at -radius, ..., radius, normalised to a sum of 1."""
    weights = np.exp(-0.5 * np.square(np.arange(-radius, radius + 1) / sigma))
    return weights / weights.sum()


def _smoothing(size: int, scale: float) -> np.ndarray:
    """Return the matrix [size, size] of the Gaussian filter applied before resizing to ``scale``."""
    if scale == 1.0:
        return _filter(size, np.array([0.25, 0.5, 0.25]), "reflect")
    sigma = (1.0 / scale - 1.0) / 2.0
    return _filter(size, _gaussian(max(round(5.0 * sigma) // 2, 1), sigma), "reflect")


def _resizing(new: int, old: int) -> np.ndarray:
    """Return the matrix [new, old] of linear interpolation between pixel centres, with replicated borders."""
    position = (np.arange(new) + 0.5) * old / new - 0.5
    below = np.floor(position).astype(int)
    matrix = np.zeros((new, old))
    for pixel, weight in ((below, 1.0 - (position - below)), (below + 1, position - below)):
        np.add.at(matrix, (np.arange(new), np.clip(pixel, 0, old - 1)), weight)
    return matrix


@functools.cache
def _fits(new: int, old: int, scale: float, radius: int, sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return matrices [new, old] that smooth and resize a row of pixels, and fit value, slope and curvature at each pixel.

    The fit's normal equations separate: with g the Gaussian and m2, m4 its moments, the weights at distance x from the pixel
    are g, x g / m2 and (x^2 - m2) g / (m4 - m2^2). Those of a quadratic in two dimensions are products of these.
    """
    offsets, weights = np.arange(-radius, radius + 1), _gaussian(radius, sigma)
    second, fourth = np.sum(weights * offsets**2), np.sum(weights * offsets**4)
    slope = weights * offsets / second
    curvature = weights * (offsets**2 - second) / (fourth - second**2)
    before = _resizing(new, old) @ _smoothing(old, scale)
    value_fit, slope_fit, curvature_fit = (_filter(new, taps, "edge") @ before for taps in (weights, slope, curvature))
    return value_fit, slope_fit, curvature_fit


def _expansions(image: jax.Array, settings: Settings) -> list[Planes]:
    """Compute the expansion of an image [H, W] at each level, coarsest first: b (right, down), then A (xx, yy, xy)."""
    (height, width), shape = image.shape, (settings.radius, settings.sigma)
    image, expansions = image.astype(jnp.float32), []
    for scale in _scales(height, width, settings):
        value_y, slope_y, curvature_y = _fits(round(height * scale), height, scale, *shape)
        value_x, slope_x, curvature_x = _fits(round(width * scale), width, scale, *shape)
        value, slope, curvature = (_multiply_right(image, fit.T) for fit in (value_x, slope_x, curvature_x))
        pairs = (value_y, slope), (slope_y, value), (value_y, curvature), (curvature_y, value), (0.5 * slope_y, slope)
        expansions.append(tuple(_multiply_left(of_rows, planes) for of_rows, planes in pairs))
    return expansions


def _equations(expansion_t: Planes, expansion_tp1: Planes, found_right: jax.Array, found_down: jax.Array) -> Planes:
    """Compute A'A (xx, xy, yy) and A'(b_t - b_t+1)/2 (x, y) at each pixel, [rows, columns] each.

    Args:
        expansion_t, expansion_tp1: Expansions from `_expansions`.
        found_right, found_down: [rows, columns], current estimate of the displacements in pixels.
    """
    rows, columns = found_right.shape
    x, y = jnp.arange(columns) + found_right, jnp.arange(rows)[:, None] + found_down
    is_inside = (x >= 0) & (x < columns - 1) & (y >= 0) & (y < rows - 1)
    weight = np.outer(_border_weights(rows), _border_weights(columns)).astype(np.float32)
    # For points that have left the image, use a slope of 0 and the curvature of the first image.
    outside = (0.0, 0.0, *expansion_t[2:])
    warped = [jnp.where(is_inside, there, other) for there, other in zip(read_planes_between(expansion_tp1, x, y), outside)]
    right, down = (0.5 * weight * (here - there) for here, there in zip(expansion_t[:2], warped[:2]))
    xx, yy, xy = (0.5 * weight * (here + there) for here, there in zip(expansion_t[2:], warped[2:]))
    # The coefficients were sampled at the current displacement, so add its contribution.
    right, down = right + xx * found_right + xy * found_down, down + xy * found_right + yy * found_down
    return xx * xx + xy * xy, (xx + yy) * xy, yy * yy + xy * xy, xx * right + xy * down, xy * right + yy * down


def _border_weights(size: int) -> np.ndarray:
    """Return the weights [size] of pixels along one axis."""
    weights, border = np.ones(size), len(_BORDER_WEIGHTS)
    weights[:border] *= _BORDER_WEIGHTS
    weights[-border:] *= _BORDER_WEIGHTS[::-1]
    return weights


def _solve(equations: Planes) -> Planes:
    """Solve the equations of each pixel, from `_equations`, for displacements (right, down)."""
    xx, xy, yy, right, down = equations
    # Bound displacements by the size of the image. Along a straight edge, the determinant is nothing but rounding error.
    limit = max(xx.shape)
    determinant = jnp.maximum(xx * yy - xy * xy, 0.0) + _REGULARIZATION
    numerators = yy * right - xy * down, xx * down - xy * right
    return tuple(jnp.clip(numerator / determinant, -limit, limit) for numerator in numerators)
