"""Dense optical flow by polynomial expansion (Farnebäck, "Two-frame motion estimation based on polynomial expansion", 2003).

Around every pixel, an image is fitted by a quadratic f(x) = x'Ax + b'x + c under a Gaussian weight. Where the next image is the
same surface displaced by d, its coefficients are A and b - 2Ad, so that

    A d = (b_t - b_t+1) / 2

which is solved in the least-squares sense over a window around the pixel, with the coefficients of the next image read at the
displacement that was found before; from coarse images to fine ones, several times at each.

Every linear step (smoothing, resizing, the fit, the window's mean, borders) is the same for all rows and for all columns. It is
therefore two products with small constant matrices, L @ image @ R, into which successive steps are multiplied beforehand: an
image is smoothed, resized and expanded at once. Images are small, so the zeros of these matrices cost less than kernels would.

Where the paper leaves a choice, it is that of OpenCV's ``calcOpticalFlowFarneback``, whose flow this agrees with: an image is
reflected at its borders when it is smoothed and repeated when it is fitted, pixels near a border count less, no level of the
pyramid is smaller than 32 pixels, and the determinant of the equations is regularised by 0.001. What that does depends on the
unit of the grey levels: with 0 to 255 next to nothing; with 0 to 1 it leaves less than 0.001 pixels of the flow in our images.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.learner.auxtasks.images import read_between

_SMALLEST_LEVEL = 32  # pixels
_REGULARIZATION = 1e-3  # of a determinant, in grey levels to the fourth power
_BORDER_WEIGHTS = (0.14, 0.14, 0.4472, 0.4472, 0.4472)  # of the outermost pixels, from the border inwards


@dataclasses.dataclass(frozen=True)
class Settings:
    """What OpenCV calls pyr_scale, levels, winsize, iterations, poly_n and poly_sigma; by default as in the authors' release.

    Attributes:
        scale: Size of a level of the pyramid over that of the next finer one.
        levels: The most levels above the image itself; those that would be too small are left out.
        window: Width of the window that shares one displacement, pixels; odd.
        iterations: At each level.
        radius: Of the neighbourhood that is fitted, pixels.
        sigma: Deviation of its Gaussian weight, pixels.
    """

    scale: float = 0.5
    levels: int = 3
    window: int = 15
    iterations: int = 3
    radius: int = 5
    sigma: float = 1.2


def flow(images_t: jax.Array, images_tp1: jax.Array, settings: Settings = Settings()) -> jax.Array:
    """Displacements [B, H, W, 2] float32, (right, down) in pixels, of what is seen at each pixel of the first images.

    Args:
        images_t: [B, H, W] grey levels, 0 to 255, of any dtype.
        images_tp1: The same, one step later.
        settings: Window, pyramid, iterations.
    """
    pair_flow = functools.partial(_pair_flow, settings=settings)
    return jax.vmap(pair_flow)(images_t.astype(jnp.float32), images_tp1.astype(jnp.float32))


def _pair_flow(image_t: jax.Array, image_tp1: jax.Array, settings: Settings) -> jax.Array:
    height, width = image_t.shape
    images, found = jnp.stack([image_t, image_tp1]), None
    for scale in reversed(_scales(height, width, settings)):
        rows, columns = round(height * scale), round(width * scale)
        if found is None:
            found = jnp.zeros((2, rows, columns))
        else:
            resize_rows, resize_columns = (_resizing(new, old) for new, old in zip((rows, columns), found.shape[1:]))
            found = _product(resize_rows, found, resize_columns.T) / settings.scale
        expansion_t, expansion_tp1 = _expand(images, scale, rows, columns, settings)
        averages = [_filter(size, np.full(settings.window, 1.0 / settings.window), "edge") for size in (rows, columns)]
        for _ in range(settings.iterations):
            equations = _equations(expansion_t, expansion_tp1, found)
            found = _solve(_product(averages[0], equations, averages[1].T))
    assert found is not None
    return jnp.moveaxis(found, 0, -1)


def _product(left: np.ndarray, planes: jax.Array, right: np.ndarray) -> jax.Array:
    """``left @ plane @ right`` of each plane [..., H, W], in full float32: determinants are differences of large numbers."""
    left, right = left.astype(np.float32), right.astype(np.float32)
    planes = jnp.matmul(planes, right, precision=jax.lax.Precision.HIGHEST)
    return jnp.matmul(left, planes, precision=jax.lax.Precision.HIGHEST)


def _scales(height: int, width: int, settings: Settings) -> list[float]:
    """Sizes of the pyramid's levels over that of the image, the finest first."""
    scales = [settings.scale**level for level in range(settings.levels + 1)]
    return [1.0, *(scale for scale in scales[1:] if min(height, width) * scale >= _SMALLEST_LEVEL)]


def _filter(size: int, taps: np.ndarray, border: str) -> np.ndarray:
    """The matrix [size, size] of a correlation with ``taps``, an odd number of them; ``border`` as of `np.pad`."""
    source = np.pad(np.arange(size), len(taps) // 2, mode=border)  # type: ignore[call-overload]
    matrix = np.zeros((size, size))
    for tap, weight in enumerate(taps):
        np.add.at(matrix, (np.arange(size), source[tap : tap + size]), weight)
    return matrix


def _gaussian(radius: int, sigma: float) -> np.ndarray:
    """Weights at -radius, ..., radius, whose sum is 1."""
    weights = np.exp(-0.5 * np.square(np.arange(-radius, radius + 1) / sigma))
    return weights / weights.sum()


def _smoothing(size: int, scale: float) -> np.ndarray:
    """The matrix [size, size] of the Gaussian filter that comes before an image is resized to ``scale``."""
    if scale == 1.0:
        return _filter(size, np.array([0.25, 0.5, 0.25]), "reflect")
    sigma = (1.0 / scale - 1.0) / 2.0
    return _filter(size, _gaussian(max(round(5.0 * sigma) // 2, 1), sigma), "reflect")


def _resizing(new: int, old: int) -> np.ndarray:
    """The matrix [new, old] of linear interpolation between pixels' centres, with what is outside as at the border."""
    position = (np.arange(new) + 0.5) * old / new - 0.5
    below = np.floor(position).astype(int)
    matrix = np.zeros((new, old))
    for pixel, weight in ((below, 1.0 - (position - below)), (below + 1, position - below)):
        np.add.at(matrix, (np.arange(new), np.clip(pixel, 0, old - 1)), weight)
    return matrix


@functools.cache
def _fits(new: int, old: int, scale: float, radius: int, sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrices [new, old] that smooth and resize a line of pixels, and fit it at each by value, slope and curvature.

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


def _expand(images: jax.Array, scale: float, rows: int, columns: int, settings: Settings) -> jax.Array:
    """Coefficients [2, rows, columns, 5] of images [2, H, W] at one level: b (right, down), then A's (xx, yy, xy)."""
    (height, width), shape = images.shape[1:], (settings.radius, settings.sigma)
    value_y, slope_y, curvature_y = _fits(rows, height, scale, *shape)
    value_x, slope_x, curvature_x = _fits(columns, width, scale, *shape)

    def fitted(of_rows: list[np.ndarray], of_columns: np.ndarray) -> list[jax.Array]:
        planes = _product(np.concatenate(of_rows), images, of_columns.T)
        return [planes[:, part * rows : (part + 1) * rows] for part in range(len(of_rows))]

    down, yy = fitted([slope_y, curvature_y], value_x)
    right, xy = fitted([value_y, slope_y], slope_x)
    (xx,) = fitted([value_y], curvature_x)
    return jnp.stack([right, down, xx, yy, 0.5 * xy], axis=-1)


def _equations(expansion_t: jax.Array, expansion_tp1: jax.Array, found: jax.Array) -> jax.Array:
    """A'A (xx, xy, yy) and A'(b_t - b_t+1)/2 (x, y) at each pixel: [5, rows, columns].

    Args:
        expansion_t, expansion_tp1: [rows, columns, 5] from `_expand`.
        found: [2, rows, columns], the displacements so far.
    """
    rows, columns, _ = expansion_t.shape
    x, y = jnp.arange(columns) + found[0], jnp.arange(rows)[:, None] + found[1]
    is_inside = (x >= 0) & (x < columns - 1) & (y >= 0) & (y < rows - 1)
    warped = read_between(expansion_tp1, x, y)
    # What has left the image says nothing about curvature, and its slope counts as 0.
    warped = jnp.where(is_inside[..., None], warped, expansion_t * np.array([0, 0, 1, 1, 1], np.float32))
    mean = jnp.moveaxis(0.5 * (expansion_t + warped), -1, 0)
    change = jnp.moveaxis(0.5 * (expansion_t - warped), -1, 0)
    weight = np.outer(_border_weights(rows), _border_weights(columns)).astype(np.float32)
    xx, yy, xy = weight * mean[2:]
    # The coefficients were read at the displacement so far, so what is missing is measured from there.
    right = weight * change[0] + xx * found[0] + xy * found[1]
    down = weight * change[1] + xy * found[0] + yy * found[1]
    return jnp.stack([xx * xx + xy * xy, (xx + yy) * xy, yy * yy + xy * xy, xx * right + xy * down, xy * right + yy * down])


def _border_weights(size: int) -> np.ndarray:
    """Weights [size] of pixels along one axis."""
    weights, border = np.ones(size), len(_BORDER_WEIGHTS)
    weights[:border] *= _BORDER_WEIGHTS
    weights[-border:] *= _BORDER_WEIGHTS[::-1]
    return weights


def _solve(equations: jax.Array) -> jax.Array:
    """Displacements [2, rows, columns] that solve the equations of each pixel, [5, rows, columns] from `_equations`."""
    xx, xy, yy, right, down = equations
    # Nothing moves farther than the image is wide. Along a straight edge, the determinant is rounding and nothing else.
    limit = max(equations.shape[1:])
    determinant = jnp.maximum(xx * yy - xy * xy, 0.0) + _REGULARIZATION
    return jnp.clip(jnp.stack([yy * right - xy * down, xx * down - xy * right]) / determinant, -limit, limit)
