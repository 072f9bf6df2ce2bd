"""What is asked of an image, and what comes back: `Outputs`, and `Frame` or `Planes`."""

from typing import NamedTuple

import jax


class Frame(NamedTuple):
    """An image as people and files want it.

    Attributes:
        rgb: [H, W, 3] uint8.
        depth: [H, W] float32, planar metres (distance along the camera's axis), the scene's ``zfar`` for the sky.
        segmentation: [H, W] int32: geom id, ngeom + site id for a site, -1 for the sky.
        normals: [H, W, 3] float32, unit, in the camera's frame (x right, y up, z towards the viewer), 0 for the sky; or None.
        distance: [H, W] float32, metres along the ray, ``zfar`` for the sky; or None.
    """

    rgb: jax.Array
    depth: jax.Array
    segmentation: jax.Array
    normals: jax.Array | None = None
    distance: jax.Array | None = None


class Planes(NamedTuple):
    """An image as the hot path wants it: planes, not quantised, and only those that were asked for.

    Attributes:
        rgb: [3, H, W] float32 in [0, 1], or uint8 where that was asked for; or None.
        depth: [H, W] float32 as in `Frame`, or None.
        segmentation: [H, W] int32 as in `Frame`, or None.
        normals: [3, H, W] float32 as in `Frame`, or None.
        distance: [H, W] float32 as in `Frame`, or None.
    """

    rgb: jax.Array | None
    depth: jax.Array | None
    segmentation: jax.Array | None
    normals: jax.Array | None = None
    distance: jax.Array | None = None


class Outputs(NamedTuple):
    """Which planes are asked for, as `render_planes` takes them; ``quantized``: colours as bytes. Hashable, so static."""

    rgb: bool
    depth: bool
    segmentation: bool = False
    normals: bool = False
    distance: bool = False
    quantized: bool = False
