"""Colour maps for depth and geom ids, in videos and in the gallery.

Matplotlib is imported lazily: a run imports this module even if it draws nothing.
"""

import numpy as np


def depth_colours(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Map depth to perceptually uniform colours; near is bright.

    Args:
        depth: [H, W], in any unit: metres, or the grey levels of an observation.
        near, far: Depths of the brightest and the darkest colour, in the same unit; depths beyond are clipped.

    Returns:
        [H, W, 3] uint8.
    """
    import matplotlib

    fraction = np.clip((depth.astype(np.float32) - near) / (far - near), 0.0, 1.0)
    return (matplotlib.colormaps["magma"](0.97 - 0.92 * fraction)[..., :3] * 255).round().astype(np.uint8)


def label_colours(labels: np.ndarray, geoms: int, sky: tuple[int, int, int]) -> np.ndarray:
    """Map geom ids to colours. Hues are spaced by the golden ratio, so that consecutive ids are easy to tell apart.

    Args:
        labels: [H, W] int; ids below 0 and from ``geoms`` on are sky.
        geoms: Number of geoms.
        sky: Colour of the sky.

    Returns:
        [H, W, 3] uint8.
    """
    import matplotlib.colors

    hues = (np.arange(geoms) * 0.61803399) % 1.0
    values = np.where(np.arange(geoms) % 2 == 0, 0.95, 0.65)
    palette = matplotlib.colors.hsv_to_rgb(np.stack([hues, np.full(geoms, 0.65), values], axis=-1))
    palette = np.concatenate([(palette * 255).round(), [sky]]).astype(np.uint8)
    return palette[np.where((labels >= 0) & (labels < geoms), labels, geoms)]
