"""Image observations: channels, their order, image size and depth encoding.

An image is planar, [C, H, W] uint8, with the channels R, G, B, D or the subset selected by ``pixels``. Depth is planar (along
the camera's axis) and metric: 0 is the near end of the task's depth range, 255 the far end, linear in between and clipped
outside. With ``depth_encoding="zbuffer"`` it is OpenGL's depth buffer, as returned by mujoco-py, times 255.

``frame_stack`` images, of this control step and the preceding ones, can be stacked along the channels, newest first. Past
states are stored as joint positions (`State.history`) and rendered again: rendering is cheaper than the physics, and the state
contains no images.

If an object is marked, the lowest bit of the first channel is 1 in its pixels and 0 elsewhere (`goals.object_mask`). The shape
of an observation and the size of a replay thus stay the same, and no pixel changes by more than one grey level.
"""

import dataclasses
from collections.abc import Callable
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs import checks
from jaxrl_vis_envs.goals import mark_object
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.randomization import Domain, varied_scene
from jaxrl_vis_envs.render import Scene, render_planes

CHANNELS = {"rgbd": 4, "rgb": 3, "depth": 1}
DepthEncoding = Literal["metric", "zbuffer"]


@dataclasses.dataclass(frozen=True)
class PixelsConfig(checks.CheckedConfig):
    """Settings of image observations."""

    image_size: int = 64
    """Height and width, in pixels."""
    pixels: Literal["rgbd", "rgb", "depth"] = "rgbd"
    """Channels of an image: colours, depth, or both (``rgbd``)."""
    depth_range: tuple[float, float] = (0.1, 10.0)
    """Depths encoded as 0 and 255, m. Task defaults are as tight as their moving parts allow. Only for
    ``depth_encoding="metric"``."""
    frame_stack: int = 1
    """Number of most recent images stacked in an observation. With one, velocities are not observable."""
    depth_encoding: DepthEncoding = "metric"
    """Encoding of depth: metres, linear over ``depth_range``, or OpenGL's z-buffer from 0 to 1, as in mujoco-py."""
    clip_range: tuple[float, float] = (0.01, 50.0)
    """Near and far clipping planes of the camera (z = 0 and 1), m. Only for ``depth_encoding="zbuffer"``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.integers(self, "image_size", "frame_stack")
        checks.choice(self, "pixels", CHANNELS)
        checks.choice(self, "depth_encoding", get_args(DepthEncoding))
        for field, minimum in (("depth_range", 0.0), ("clip_range", 1e-6)):
            near, far = checks.vector(self, field, 2)
            if not minimum <= near < far:
                raise ValueError(f"{field} must be (near, far) with {minimum:g} <= near < far, got {getattr(self, field)}")


Observer = Callable[..., jax.Array]
"""Function ``observer(data, history=None, domain=None)`` that renders the poses in ``data`` and the past ones in ``history``,
with the appearance in ``domain`` (see `State`), as one observation: an `ImageObserver`, or a function of the same form."""


class ImageObserver:
    """Function from the poses of one environment to its images [frame_stack * channels, H, W] uint8.

    Attributes:
        scene: Scene before randomisation.
        spec: Shape and dtype of an observation.
    """

    def __init__(self, mj_model: mujoco.MjModel, camera: str, config: PixelsConfig, marked: str | None = None) -> None:
        """Build the scene; see `image_observer`."""
        size = config.image_size
        self.scene = Scene.from_mjmodel(mj_model, camera=camera, height=size, width=size)
        self.spec = jax.ShapeDtypeStruct((config.frame_stack * CHANNELS[config.pixels], size, size), jnp.uint8)
        self._config = config
        self._model = mjx_model.put_model(mj_model)
        self._marked = None if marked is None else np.flatnonzero(mj_model.geom_bodyid == mj_model.body(marked).id)

    def __call__(self, data: mjx.Data, history: jax.Array | None = None, domain: Domain | None = None) -> jax.Array:
        """Render an observation: [frame_stack * channels, H, W] uint8, newest image first.

        Args:
            data: Physics state with up-to-date poses.
            history: [frame_stack - 1, nq] float32, joint positions one, two, ... control steps ago. If None, nothing has moved,
                and one image is repeated.
            domain: Appearance of the episode (see `randomization`), the same for all images; None for the model's.
        """
        scene = varied_scene(self.scene, domain)
        if self._config.frame_stack == 1 or history is None:
            return jnp.tile(self._render(scene, data), (self._config.frame_stack, 1, 1))

        def render_at(qpos: jax.Array) -> jax.Array:
            with jax.default_matmul_precision("highest"):
                return self._render(scene, mjx_model.kinematics(self._model, data.replace(qpos=qpos)))

        images = jax.vmap(render_at)(jnp.concatenate([data.qpos[None], history]))
        return images.reshape(-1, *images.shape[2:])

    def _render(self, scene: Scene, data: mjx.Data) -> jax.Array:
        """Render one image [channels, H, W]."""
        wants_colour, wants_depth = self._config.pixels != "depth", self._config.pixels != "rgb"
        marks = self._marked is not None
        planes = render_planes(scene, data, rgb=wants_colour, depth=wants_depth, segmentation=marks, quantized=True)
        channels = []
        if planes.rgb is not None:
            channels.append(planes.rgb)
        if planes.depth is not None:
            channels.append(self._encode(planes.depth)[None])
        image = jnp.concatenate(channels)
        if planes.segmentation is None:
            return image
        return mark_object(image, jnp.isin(planes.segmentation, jnp.asarray(self._marked)))

    def _encode(self, depth: jax.Array) -> jax.Array:
        if self._config.depth_encoding == "zbuffer":
            return encode_zbuffer(depth, self._config.clip_range)
        return encode_depth(depth, self._config.depth_range)


def image_observer(mj_model: mujoco.MjModel, camera: str, config: PixelsConfig, marked: str | None = None) -> ImageObserver:
    """Build the observer of an image task, for `MjxGoalEnv`.

    Args:
        mj_model: MuJoCo model.
        camera: Name of one of its cameras.
        config: Size, channels, depth range, frame stack.
        marked: Name of the body whose pixels are marked (`goals.object_mask`); None for none.

    Raises:
        ValueError: There is no such camera, or something in its view cannot be rendered.
    """
    return ImageObserver(mj_model, camera, config, marked)


def encode_depth(depth: jax.Array, depth_range: tuple[float, float]) -> jax.Array:
    """Encode depths ``[...]`` (m) as uint8: 0 up to the near end of ``depth_range`` (m), 255 from the far end on."""
    near, far = depth_range
    fraction = jnp.clip((depth - near) / (far - near), 0.0, 1.0)
    return jnp.round(255.0 * fraction).astype(jnp.uint8)


def encode_zbuffer(depth: jax.Array, clip_range: tuple[float, float]) -> jax.Array:
    """Encode depths ``[...]`` (m) as OpenGL z in uint8: 0 at the near plane of ``clip_range`` (m), 255 at the far one or
    beyond.
    """
    near, far = clip_range
    z = jnp.clip(far / (far - near) * (1.0 - near / depth), 0.0, 1.0)
    return jnp.round(255.0 * z).astype(jnp.uint8)


def decode_depth(encoded: jax.Array, depth_range: tuple[float, float]) -> jax.Array:
    """Decode uint8 depths ``[...]`` of `encode_depth` to float32 (m), exact to half a quantization step of (far - near) / 255
    within ``depth_range`` (m).
    """
    near, far = depth_range
    return near + encoded.astype(jnp.float32) * ((far - near) / 255.0)
