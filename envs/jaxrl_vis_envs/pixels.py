"""What the agent sees: which channels, in which order, at which size, and how a depth becomes a byte.

An image is planar, [C, H, W] uint8, with the channels R, G, B, D, as many of them as ``pixels`` asks for. Depth is
planar (along the camera's axis) and metric: 0 is the near end of the task's depth range, 255 the far end, linear between,
clipped outside. With ``depth_encoding="zbuffer"`` it is what OpenGL's buffer holds, which mujoco-py handed out.

``frame_stack`` images, of this control step and those before it, may be stacked along the channels, the newest first. What came
before is kept as joint positions (`State.history`), a few numbers, and drawn again: an image costs less than the physics
that leads to it, and no image has to travel with the state.
"""

import dataclasses
from collections.abc import Callable
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import mujoco

from jaxrl_vis_envs import checks
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.randomization import Domain, varied_scene
from jaxrl_vis_envs.render import Scene, render_planes

CHANNELS = {"rgbd": 4, "rgb": 3, "depth": 1}
DepthEncoding = Literal["metric", "zbuffer"]


@dataclasses.dataclass(frozen=True)
class PixelsConfig(checks.CheckedConfig):
    """Settings of the images."""

    image_size: int = 64
    """Height and width, in pixels."""
    pixels: Literal["rgbd", "rgb", "depth"] = "rgbd"
    """Channels."""
    depth_range: tuple[float, float] = (0.1, 10.0)
    """Depths that bytes 0 and 255 stand for, m. Tasks choose it as tight as what moves allows."""
    frame_stack: int = 1
    """Images of the latest control steps that an observation stacks. With one, velocities are hidden."""
    depth_encoding: DepthEncoding = "metric"
    """What bytes of depth stand for: metres, linear over ``depth_range``; or OpenGL's z-buffer from 0 to 1, as in mujoco-py."""
    clip_range: tuple[float, float] = (0.01, 50.0)
    """The camera's near and far clipping planes, m, where z is 0 and 1. Only for ``depth_encoding="zbuffer"``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.whole(self, "image_size", "frame_stack")
        checks.one_of(self, "pixels", CHANNELS)
        checks.one_of(self, "depth_encoding", get_args(DepthEncoding))
        for field, least in (("depth_range", 0.0), ("clip_range", 1e-6)):
            near, far = checks.vector(self, field, 2)
            if not least <= near < far:
                raise ValueError(f"{field} must be (near, far) with {least:g} <= near < far, got {getattr(self, field)}")


Observer = Callable[..., jax.Array]
"""observer(data, history=None, domain=None): an observation of the poses in ``data``, after those in ``history``, under the
appearance in ``domain`` (see `State`)."""


class ImageObserver:
    """A function from the poses of one environment to its images [frame_stack * channels, H, W] uint8.

    Attributes:
        scene: What is drawn, before randomisation.
        spec: Shape and dtype of what it returns.
    """

    def __init__(self, mj_model: mujoco.MjModel, camera: str, config: PixelsConfig) -> None:
        """Reads the scene; see `image_observer`."""
        size = config.image_size
        self.scene = Scene.from_mjmodel(mj_model, camera=camera, height=size, width=size)
        self.spec = jax.ShapeDtypeStruct((config.frame_stack * CHANNELS[config.pixels], size, size), jnp.uint8)
        self._config = config
        self._model = mjx_model.put_model(mj_model)

    def __call__(self, data: mjx.Data, history: jax.Array | None = None, domain: Domain | None = None) -> jax.Array:
        """Draws.

        Args:
            data: Poses, up to date.
            history: [frame_stack - 1, nq] float32, joint positions one, two, ... control steps ago. Without, all has stood
                still, and one image is repeated.
            domain: The appearance of the episode (`randomization`), which holds for all images.
        """
        scene = varied_scene(self.scene, domain)
        if self._config.frame_stack == 1 or history is None:
            return jnp.tile(self._draw(scene, data), (self._config.frame_stack, 1, 1))

        def draw_at(qpos: jax.Array) -> jax.Array:
            with jax.default_matmul_precision("highest"):
                return self._draw(scene, mjx_model.kinematics(self._model, data.replace(qpos=qpos)))

        images = jax.vmap(draw_at)(jnp.concatenate([data.qpos[None], history]))
        return images.reshape(-1, *images.shape[2:])

    def _draw(self, scene: Scene, data: mjx.Data) -> jax.Array:
        """One image [channels, H, W]."""
        wants_colour, wants_depth = self._config.pixels != "depth", self._config.pixels != "rgb"
        planes = render_planes(scene, data, rgb=wants_colour, depth=wants_depth, quantized=True)
        channels = []
        if planes.rgb is not None:
            channels.append(planes.rgb)
        if planes.depth is not None:
            channels.append(self._encode(planes.depth)[None])
        return jnp.concatenate(channels)

    def _encode(self, depth: jax.Array) -> jax.Array:
        if self._config.depth_encoding == "zbuffer":
            return encode_zbuffer(depth, self._config.clip_range)
        return encode_depth(depth, self._config.depth_range)


def image_observer(mj_model: mujoco.MjModel, camera: str, config: PixelsConfig) -> ImageObserver:
    """What an image task sees with, for `MjxGoalEnv`.

    Args:
        mj_model: The model.
        camera: The name of one of its cameras.
        config: Size, channels, depth range, frame stack.

    Raises:
        ValueError: There is no such camera, or something in its view cannot be drawn.
    """
    return ImageObserver(mj_model, camera, config)


def encode_depth(depth: jax.Array, depth_range: tuple[float, float]) -> jax.Array:
    """Bytes of depths ``[...]`` (m): 0 at the near end of ``depth_range`` (m) or before, 255 at the far end or beyond."""
    near, far = depth_range
    share = jnp.clip((depth - near) / (far - near), 0.0, 1.0)
    return jnp.round(255.0 * share).astype(jnp.uint8)


def encode_zbuffer(depth: jax.Array, clip_range: tuple[float, float]) -> jax.Array:
    """Bytes of OpenGL's z for depths ``[...]`` (m): 0 on the near plane of ``clip_range`` (m), 255 on the far one or beyond."""
    near, far = clip_range
    z = jnp.clip(far / (far - near) * (1.0 - near / depth), 0.0, 1.0)
    return jnp.round(255.0 * z).astype(jnp.uint8)


def decode_depth(encoded: jax.Array, depth_range: tuple[float, float]) -> jax.Array:
    """Depths (m, float32) that bytes ``[...]`` of `encode_depth` stand for; exact to half a step of (far - near) / 255."""
    near, far = depth_range
    return near + encoded.astype(jnp.float32) * ((far - near) / 255.0)
