"""Images as observations: names, dtypes and shapes, and concatenation of all channels into one array."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis_envs.pixels.observations import encode_depth

Dtype = Literal["float32", "uint8"]
Layout = Literal["dict", "images", "image"]
PREFIX = "pixels/"
GOAL_SUFFIX = "/goal"


@dataclasses.dataclass(frozen=True)
class Format:
    """Form of image observations.

    Attributes:
        layout: ``dict``: the environment's own observation and the images. ``images``: only the images. ``image``: one array
            [H, W, C], the channels of all images in order, then those of all goal images.
        dtype: ``float32``: colours from 0 to 1. ``uint8``: colours from 0 to 255. Depths have the same dtype and range if there
            is a ``depth_range``; other outputs keep their dtypes.
        depth_range: Depths (m) encoded as the ends of that range, linear in between and clipped. If None, depths are float32,
            in m.

    Raises:
        ValueError: There is no such layout or dtype, or ``depth_range`` is not (near, far) with 0 <= near < far.
    """

    layout: Layout = "dict"
    dtype: Dtype = "float32"
    depth_range: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name, choices in (("layout", get_args(Layout)), ("dtype", get_args(Dtype))):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}")
        if self.depth_range is not None and not 0.0 <= self.depth_range[0] < self.depth_range[1]:
            raise ValueError(f"depth_range must be (near, far) with 0 <= near < far, got {self.depth_range}")

    def images(self, views: dict[str, dict[str, jax.Array]], suffix: str = "") -> dict[str, jax.Array]:
        """Return images in the format's dtype and depth encoding, by their names in an observation.

        Args:
            views: Images from `Views`.
            suffix: End of the names: `GOAL_SUFFIX` for goal images.

        Returns:
            ``pixels/CAMERA`` for colours, ``pixels/CAMERA/OUTPUT`` for other outputs, each [H, W, C].
        """
        observation = {}
        for camera, images in views.items():
            for output, image in images.items():
                observation[_name(camera, output) + suffix] = self._encode(output, image)
        return observation

    def concatenate_images(self, images: dict[str, jax.Array]) -> jax.Array:
        """Concatenate the channels of images [H, W, ...] in the format's dtype: [H, W, C].

        Raises:
            ValueError: The images differ in size, or one of them cannot be converted to the dtype.
        """
        sizes = {name: image.shape[:2] for name, image in images.items()}
        if len(set(sizes.values())) > 1:
            raise ValueError(f"images of several sizes cannot be one array: {sizes}; use layout='images'")
        for name, image in images.items():
            if self.dtype == "uint8" and image.dtype != jnp.uint8:
                raise ValueError(f"{name} cannot be uint8: choose dtype='float32', or a depth_range for depths")
        return jnp.concatenate([image.astype(self.dtype) for image in images.values()], axis=-1)

    def _encode(self, output: str, image: Any) -> jax.Array:
        if image.ndim == 2:
            image = image[:, :, None]
        if output == "depth" and self.depth_range is not None:
            if self.dtype == "uint8":
                return encode_depth(image, self.depth_range)
            near, far = self.depth_range
            return jnp.clip((image - near) / (far - near), 0.0, 1.0)
        if output == "rgb" and self.dtype == "float32":
            return image.astype(jnp.float32) / 255.0
        return image


def image_names(outputs: Mapping[str, tuple[str, ...]]) -> list[str]:
    """Return the names of all images in an observation except goal images.

    Args:
        outputs: Outputs by camera, see `Views`.

    Raises:
        ValueError: Two images have the same name.
    """
    names = [_name(camera, output) for camera, chosen in outputs.items() for output in chosen]
    if len(set(names)) < len(names) or any(name + GOAL_SUFFIX in names for name in names):
        raise ValueError(f"two images have the same name among {', '.join(names)}: name the cameras in a dictionary")
    return names


def _name(camera: str, output: str) -> str:
    return PREFIX + camera + ("" if output == "rgb" else f"/{output}")


GoalImage = Callable[[Any], Any] | jax.Array | np.ndarray | None
"""Source of goal images: joint positions [nq], or a function from the state after a reset (on the host: the environment) to
joint positions, physics data or a state; None for no goal images."""


def goal_poses(goal_image: GoalImage, state: Any) -> Any:
    """Return the source of the goal's poses for an episode that starts in ``state``: ``goal_image``, or its result."""
    return goal_image(state) if callable(goal_image) else goal_image
