"""Images: observations of the image tasks, and `wrap`, which adds images to environments of other libraries.

observations   channels, image size and encoding of depth of image tasks (`PixelsConfig`, `image_observer`)
labels         names of the objects in a segmentation
views          `Views`: several cameras and outputs in one call
formats        images as observations: names, dtypes, shapes
poses          poses from the states of brax, MuJoCo Playground and others
model_env      environment of a plain MuJoCo model
host           wrapper for Gymnasium's environments; imported on use
wrapping       `wrap`
"""

from jaxrl_vis_envs.pixels.observations import (
    CHANNELS,
    DepthEncoding,
    ImageObserver,
    Observer,
    PixelsConfig,
    decode_depth,
    encode_depth,
    encode_zbuffer,
    image_observer,
)
from jaxrl_vis_envs.pixels.views import OUTPUTS, Views
from jaxrl_vis_envs.pixels.wrapping import PixelEnv, wrap

__all__ = [
    "CHANNELS",
    "OUTPUTS",
    "DepthEncoding",
    "ImageObserver",
    "Observer",
    "PixelEnv",
    "PixelsConfig",
    "Views",
    "decode_depth",
    "encode_depth",
    "encode_zbuffer",
    "image_observer",
    "wrap",
]
