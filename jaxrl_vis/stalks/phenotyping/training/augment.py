"""Data augmentation: random lighting, geometry and texture, to which the networks should be invariant or equivariant."""

import jax
import jax.numpy as jnp

from jaxrl_vis.stalks.phenotyping.detector.sections import ABSENT, NOTHING, STEP, UNKNOWN, WHOLE

_WELL_ROOT = 94.9  # square root of the full-well capacity (electrons at white) of the synthetic cameras
_DARK = 0.016  # signal, as a fraction of white, whose shot noise equals the read noise
_TAPS = 3  # pixels: reach of the blur


def relight(images: jax.Array, key: jax.Array) -> jax.Array:
    """Augment images [N, H, W, 3] uint8 with random lighting, colour, blur, noise and tone curve; same shape and dtype.

    Lighting, blur and noise are applied as in a camera: to linear values, before clipping.
    """
    names = ("gain", "gamma", "colour", "grey", "noise", "level", "blotch", "strength", "blur", "sharp")
    keys: dict[str, jax.Array] = dict(zip(names, jax.random.split(key, len(names))))
    count = images.shape[0]

    def per_image(name: str, low: float, high: float) -> jax.Array:
        return jax.random.uniform(keys[name], (count, 1, 1, 1), minval=low, maxval=high)

    values = (images.astype(jnp.float32) / 255.0) ** 2.2
    grey = values.mean(axis=-1, keepdims=True)
    values = jnp.maximum(grey + (values - grey) * per_image("grey", 0.2, 1.5), 0.0)
    gain = jnp.exp(per_image("gain", -1.2, 1.0)) * jnp.exp(0.2 * jax.random.normal(keys["colour"], (count, 1, 1, 3)))
    # Smooth random variations of brightness, as of other textures, on a grid of 24 x 24 cells.
    coarse = jax.random.normal(keys["blotch"], (count, 24, 24, 1))
    gain = gain * jnp.exp(per_image("strength", 0.0, 0.3) * jax.image.resize(coarse, (*images.shape[:3], 1), "linear"))
    values = _blur(values * gain, jnp.where(per_image("sharp", 0.0, 1.0) > 0.5, per_image("blur", 0.3, 1.3), 0.05))
    # Up to three times the shot and read noise of the original images, of which downscaled ones have less.
    level = 3.0 * per_image("level", 0.0, 1.0) ** 2 / _WELL_ROOT
    values = values + level * jnp.sqrt(values + _DARK) * jax.random.normal(keys["noise"], values.shape)
    curve = jnp.exp(0.15 * jax.random.normal(keys["gamma"], (count, 1, 1, 1))) / 2.2
    return jnp.round(255.0 * jnp.clip(values, 0.0, 1.0) ** curve).astype(jnp.uint8)


def _blur(values: jax.Array, deviation: jax.Array) -> jax.Array:
    """Blur values [N, H, W, C] by a Gaussian with standard deviation ``deviation`` [N, 1, 1, 1], pixels."""
    taps = jnp.exp(-0.5 * (jnp.arange(-_TAPS, _TAPS + 1) / deviation) ** 2)  # [N, 1, 1, taps]
    taps = taps / taps.sum(axis=-1, keepdims=True)
    for axis in (1, 2):
        padding = [(_TAPS, _TAPS) if index == axis else (0, 0) for index in range(4)]
        padded, size = jnp.pad(values, padding, mode="edge"), values.shape[axis]
        parts = [jax.lax.slice_in_dim(padded, k, k + size, axis=axis) * taps[..., k : k + 1] for k in range(2 * _TAPS + 1)]
        values = sum(parts[1:], parts[0])
    return values


def augment_geometry(
    images: jax.Array, stalks: jax.Array, kinds: jax.Array, sizes: jax.Array, key: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Mirror, shear, stretch and shift images and their stalks at random; a quarter of the images are mirrored at most.

    Args:
        images: [N, H, W, 3] uint8, padded at the bottom and on the right.
        stalks: [N, T, 6] float32, boxes and axes, or edges [N, T, R, 3], see `sections`.
        kinds: [N, T] int32, see `losses.assign_boxes`.
        sizes: [N, 2] int32, height and width of the images without padding.
        key: Typed key, [].

    Returns:
        Images, black where the originals did not reach; stalks; and kinds. Shapes and dtypes are those of the arguments. Boxes
        are clipped to the image, and become ``NOTHING`` if hardly anything is left. Edges are not clipped, and their kinds are
        unchanged: rows that leave the image become `ABSENT`, and rows with less than `WHOLE` left become at most `UNKNOWN`.
    """
    keys = jax.random.split(key, images.shape[0])
    return jax.vmap(_transform_stalks)(images, stalks, kinds, sizes, keys)


def _transform_stalks(image: jax.Array, stalks: jax.Array, kinds: jax.Array, shape: jax.Array, key: jax.Array):
    drawn = jax.random.uniform(key, (7,), minval=-1.0, maxval=1.0)
    height, width = shape[0], shape[1]
    still = drawn[0] > 0.5
    wide, tall = (jnp.where(still, 1.0, jnp.exp(0.12 * factor)) for factor in drawn[1:3])
    # Stalks of other fields lean by up to 20 degrees.
    shear = jnp.where(still, 0.0, 0.3 * drawn[3])
    over, down = jnp.where(still, 0.0, 0.04 * width * drawn[4]), jnp.where(still, 0.0, 0.04 * height * drawn[5])
    mirror = drawn[6] > 0.0
    # x' = wide (x - w/2) + shear (y - h/2) + w/2 + over, and then mirrored; y' = tall (y - h/2) + h/2 + down.
    row, column = jnp.meshgrid(jnp.arange(image.shape[0]) + 0.5, jnp.arange(image.shape[1]) + 0.5, indexing="ij")
    column = jnp.where(mirror, width - column, column)
    y = (row - down - height / 2) / tall + height / 2
    x = (column - over - width / 2 - shear * (y - height / 2)) / wide + width / 2
    moved = _sample(image, y - 0.5, x - 0.5, shape)

    def across(x: jax.Array, y: jax.Array) -> jax.Array:
        return wide * (x - width / 2) + shear * (y - height / 2) + width / 2 + over

    if stalks.ndim == 3:
        rows = (jnp.arange(stalks.shape[1]) + 0.5) * STEP
        source = (rows - down - height / 2) / tall + height / 2
        left, right, visible = _edges_at(stalks, source, height, width)
        left, right = across(left, source), across(right, source)
        left, right = jnp.where(mirror, width - right, left), jnp.where(mirror, width - left, right)
        return moved, jnp.stack([left, right, visible], axis=-1), kinds
    left, top, right, bottom, above, below = stalks.T
    first, last = jnp.minimum(above, below), jnp.maximum(above, below)
    above, below = across(above, top), across(below, bottom)
    begin = jnp.minimum(above, below) + wide * (left - first)
    end = jnp.maximum(above, below) + wide * (right - last)
    top, bottom = (tall * (edge - height / 2) + height / 2 + down for edge in (top, bottom))
    begin, end = jnp.where(mirror, width - end, begin), jnp.where(mirror, width - begin, end)
    above, below = (jnp.where(mirror, width - column, column) for column in (above, below))
    # Boxes are clipped to the image, and the axis is evaluated at the clipped top and bottom.
    begin, end = jnp.clip(begin, 0.0, width), jnp.clip(end, 0.0, width)
    low, high = jnp.clip(top, 0.0, height), jnp.clip(bottom, 0.0, height)
    slope = (below - above) / jnp.maximum(bottom - top, 1.0)
    above, below = above + slope * (low - top), below + slope * (high - bottom)
    kinds = jnp.where((end - begin < 3.0) | (high - low < 16.0), NOTHING, kinds)
    return moved, jnp.stack([begin, low, end, high, above, below], axis=-1), kinds


def _edges_at(edges: jax.Array, rows: jax.Array, height: jax.Array, width: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Interpolate edges [T, R, 3] at ``rows`` [K] of an image; return left, right and visible fraction, each [T, K]."""
    place = jnp.clip(rows / STEP - 0.5, 0.0, edges.shape[1] - 1.0)
    first = jnp.minimum(jnp.floor(place).astype(jnp.int32), edges.shape[1] - 2)
    part = (place - first)[:, None]
    left, right = jnp.moveaxis((edges[:, first] * (1.0 - part) + edges[:, first + 1] * part)[..., :2], -1, 0)
    visible = edges[:, jnp.round(place).astype(jnp.int32), 2]
    # What lies outside the image is black after moving.
    inside = jnp.clip(jnp.minimum(right, width) - jnp.maximum(left, 0.0), 0.0, None) / jnp.maximum(right - left, 1e-3)
    partly = jnp.where(inside > 0.0, jnp.minimum(visible, UNKNOWN), ABSENT)
    visible = jnp.where(inside >= WHOLE, visible, partly)
    return left, right, jnp.where((rows >= 0.0) & (rows < height), visible, ABSENT)


def _sample(image: jax.Array, row: jax.Array, column: jax.Array, shape: jax.Array) -> jax.Array:
    """Sample an image [H, W, 3] uint8 at ``row`` and ``column`` [h, w] by bilinear interpolation.

    Pixels outside ``shape`` [2], the height and width of the image without padding, are black.
    """
    inside = (row >= -0.5) & (row <= shape[0] - 0.5) & (column >= -0.5) & (column <= shape[1] - 0.5)
    row, column = jnp.clip(row, 0.0, shape[0] - 1.0), jnp.clip(column, 0.0, shape[1] - 1.0)
    top, left = jnp.floor(row).astype(jnp.int32), jnp.floor(column).astype(jnp.int32)
    down, over = (row - top)[..., None], (column - left)[..., None]
    below, right = jnp.minimum(top + 1, shape[0] - 1), jnp.minimum(left + 1, shape[1] - 1)
    values = image.astype(jnp.float32)
    upper = values[top, left] * (1 - over) + values[top, right] * over
    lower = values[below, left] * (1 - over) + values[below, right] * over
    return jnp.round((upper * (1 - down) + lower * down) * inside[..., None]).astype(jnp.uint8)


def augment_crops(crops: jax.Array, masks: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Augment stalk crops [N, H, W, 3] uint8 and their masks [N, H, W] bool; shapes and dtypes are unchanged.

    Width, texture, contrast, stripes along the stalk, mirroring and lighting are random; masks follow width and mirroring.
    """
    light, side, marks, size, contrast, along = jax.random.split(key, 6)
    crops, masks = _stretch(crops, masks, size)
    crops = _add_stripes(_change_contrast(_add_texture(crops, marks), masks, contrast), masks, along)
    mirror = jax.random.bernoulli(side, 0.5, (crops.shape[0],))
    crops = jnp.where(mirror[:, None, None, None], crops[:, :, ::-1], crops)
    masks = jnp.where(mirror[:, None, None], masks[:, :, ::-1], masks)
    return relight(crops, light), masks


def _stretch(crops: jax.Array, masks: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Stretch crops [N, H, W, 3] uint8 and masks [N, H, W] bool horizontally about their centres by exp(-0.3) to exp(0.3)."""
    count, _, width = crops.shape[:3]
    wider = jnp.exp(jax.random.uniform(key, (count,), minval=-0.3, maxval=0.3))
    place = (jnp.arange(width) + 0.5 - width / 2) / wider[:, None] + width / 2 - 0.5  # [N, W], source of each column
    place = jnp.clip(place, 0.0, width - 1.0)
    left = jnp.minimum(jnp.floor(place).astype(jnp.int32), width - 2)
    fraction = (place - left)[:, None, :]

    def columns(values: jax.Array, at: jax.Array) -> jax.Array:
        return jnp.take_along_axis(values, at.reshape(count, 1, width, *(1,) * (values.ndim - 3)), axis=2)

    values = crops.astype(jnp.float32)
    mixed = columns(values, left) * (1 - fraction[..., None]) + columns(values, left + 1) * fraction[..., None]
    inside = masks.astype(jnp.float32)
    return jnp.round(mixed).astype(jnp.uint8), columns(inside, left) * (1 - fraction) + columns(
        inside, left + 1
    ) * fraction >= 0.5


def _add_texture(crops: jax.Array, key: jax.Array) -> jax.Array:
    """Multiply crops [N, H, W, 3] uint8 by random speckles, fibres along the stalk and shading; same shape and dtype.

    Together they cover more than the textures of a family of synthetic plots.
    """
    count, height, width = crops.shape[:3]
    spots, fibres, shades, amounts = jax.random.split(key, 4)
    amount = jax.random.uniform(amounts, (4, count, 1, 1))

    def noise(key: jax.Array, rows: int, columns: int) -> jax.Array:
        shape = (count, max(height // rows, 1), max(width // columns, 1))
        return jax.image.resize(jax.random.normal(key, shape), (count, height, width), "linear")

    dark = jnp.where(noise(spots, 6, 3) > 2.2 - 1.4 * amount[0], 1.0 - 0.6 * amount[1], 1.0)
    grain = jnp.exp(0.25 * amount[2] * noise(fibres, 160, 2) + 0.35 * amount[3] * noise(shades, 80, 10))
    return jnp.round(jnp.clip(crops * (dark * grain)[..., None], 0.0, 255.0)).astype(jnp.uint8)


def _add_stripes(crops: jax.Array, masks: jax.Array, key: jax.Array) -> jax.Array:
    """Add light and dark stripes along the stalk to 70 % of the crops, like ribs and folded sheaths, varying by internode.

    A dark stripe looks like a gap between two stalks, but the stalk continues on its other side.

    Args:
        crops: [N, H, W, 3] uint8.
        masks: [N, H, W] bool, pixels of the stalk, which alone change.
        key: Typed key, [].

    Returns:
        Crops of the same shape and dtype.
    """
    count, height, width = crops.shape[:3]
    keys = jax.random.split(key, 5)
    # Index of the internode, out of four, that each row belongs to.
    nodes = jnp.sort(jax.random.uniform(keys[0], (3, count)), axis=0) * height
    internode = (jnp.arange(height) > nodes[..., None]).sum(axis=0)  # [N, H]
    stripes = jnp.zeros(masks.shape)
    weights = jax.nn.softmax(2.0 * jax.random.normal(keys[1], (2, count)), axis=0)
    for index, (columns, weight) in enumerate(zip((5, 12), weights)):
        drawn = jax.random.normal(keys[2 + index], (count, 4, max(width // columns, 2)))
        across = jax.image.resize(drawn, (count, 4, width), "linear")
        stripes += weight[:, None, None] * jnp.take_along_axis(across, internode[..., None], axis=1)
    amount, chance = jax.random.uniform(keys[4], (2, count, 1, 1))
    factor = jnp.where(masks & (chance < 0.7), jnp.exp(amount * jnp.tanh(4.0 * stripes)), 1.0)
    return jnp.round(jnp.clip(crops * factor[..., None], 0.0, 255.0)).astype(jnp.uint8)


def _change_contrast(crops: jax.Array, masks: jax.Array, key: jax.Array) -> jax.Array:
    """Randomise the contrast of stalks to the background, and their shading towards the edges, in half of the crops.

    The shading of a round stalk towards its edges depends on its surface and on the light. A network that overfits to it
    misplaces the edges of other stalks. The change is multiplicative, so black remains black and no edge appears where none was
    visible.

    Args:
        crops: [N, H, W, 3] uint8.
        masks: [N, H, W] bool, pixels of the stalk, which alone change.
        key: Typed key, [].

    Returns:
        Crops of the same shape and dtype.
    """
    count, _, width = crops.shape[:3]
    keys = jax.random.split(key, 6)
    inside = masks.astype(jnp.float32)
    own = jnp.exp(0.3 * jax.random.normal(keys[0], (count, 1, 1, 1)) + 0.15 * jax.random.normal(keys[1], (count, 1, 1, 3)))
    # Fraction of stalk pixels in the horizontal neighbourhood of each pixel: 1 at the centre, about a half at the edges.
    coverage = jnp.zeros_like(inside)
    weights = jax.nn.softmax(2.0 * jax.random.normal(keys[2], (3, count)), axis=0)
    for reach, weight in zip((4, 8, 16), weights):
        reach = min(reach, (width - 1) // 2)
        sums = jax.lax.reduce_window(inside, 0.0, jax.lax.add, (1, 1, 2 * reach + 1), (1, 1, 1), "SAME")
        coverage += weight[:, None, None] * sums / (2 * reach + 1)
    amount = jax.random.uniform(keys[3], (count, 1, 1), minval=-0.3, maxval=0.8)
    power = jnp.exp(0.4 * jax.random.normal(keys[4], (count, 1, 1)))
    shade = 1.0 - amount * jnp.clip(2.0 * (1.0 - coverage), 0.0, 1.0) ** power
    # Half of the crops are unchanged: in real images, the original contrast is the only cue.
    changed = jax.random.bernoulli(keys[5], 0.5, (count, 1, 1, 1)) & masks[..., None]
    factor = jnp.where(changed, own * shade[..., None], 1.0)
    return jnp.round(jnp.clip(crops * factor, 0.0, 255.0)).astype(jnp.uint8)
