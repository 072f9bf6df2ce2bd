"""Requested planes, `Outputs`, and the rendered image, `Frame` or `Planes`."""

from typing import NamedTuple

import jax


class Frame(NamedTuple):
    """Image with channels last, for viewing and for files.

    Attributes:
        rgb: [H, W, 3] uint8.
        depth: [H, W] float32, planar depth in metres (along the camera's axis); the scene's ``zfar`` for the sky.
        segmentation: [H, W] int32, geom id, ngeom + site id for a site, ngeom + nsite + tendon id for a tendon, -1 for the sky.
        normals: [H, W, 3] float32, unit vectors in the camera's frame (x right, y up, z towards the viewer), 0 for the sky;
            None if not requested.
        distance: [H, W] float32, metres along the ray, ``zfar`` for the sky; None if not requested.
    """

    rgb: jax.Array
    depth: jax.Array
    segmentation: jax.Array
    normals: jax.Array | None = None
    distance: jax.Array | None = None


class Planes(NamedTuple):
    """Image as planes, for the hot path: not quantised by default. Planes that were not requested are None.

    Attributes:
        rgb: [3, H, W] float32 in [0, 1], or uint8 if quantised.
        depth: [H, W] float32 as in `Frame`.
        segmentation: [H, W] int32 as in `Frame`.
        normals: [3, H, W] float32 as in `Frame`.
        distance: [H, W] float32 as in `Frame`.
    """

    rgb: jax.Array | None
    depth: jax.Array | None
    segmentation: jax.Array | None
    normals: jax.Array | None = None
    distance: jax.Array | None = None


class Outputs(NamedTuple):
    """Requested planes, as in `render_planes`; ``quantized`` selects uint8 colours. Hashable, hence usable as a static
    argument.
    """

    rgb: bool
    depth: bool
    segmentation: bool = False
    normals: bool = False
    distance: bool = False
    quantized: bool = False
