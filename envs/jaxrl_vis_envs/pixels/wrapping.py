"""Images for environments of other libraries: `wrap`.

env = wrap(brax.envs.get_environment("ant"), cameras="track")
state = jax.jit(env.reset)(jax.random.PRNGKey(0))
state.obs["pixels/track"]  # [64, 64, 3] float32 from 0 to 1
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.pixels import formats, poses
from jaxrl_vis_envs.pixels.formats import Dtype, Format, GoalImage, Layout
from jaxrl_vis_envs.pixels.views import Cameras, ImageSize, Output, Views

STATE = "state"
"""Key of the environment's own observation, if that is an array."""
UNWRAPPED_OBS = "unwrapped_obs"
"""Key in ``state.info`` of the environment's own observation, if it is not part of the observation."""


def wrap(
    env: Any,
    cameras: Cameras = None,
    image_size: ImageSize | Mapping[str, ImageSize] = 64,
    outputs: Output | Iterable[Output] | Mapping[str, Output | Iterable[Output]] = "rgb",
    goal_image: GoalImage = None,
    *,
    frames: int = 1,
    layout: Layout = "dict",
    dtype: Dtype | None = None,
    depth_range: tuple[float, float] | None = None,
    clip_range: tuple[float, float] | Mapping[str, tuple[float, float] | None] | None = None,
    step: Callable[[Any, jax.Array], Any] | None = None,
    **scene_options: Any,
) -> Any:
    """Wrap an environment that has a MuJoCo model, so that its observations are, or contain, images.

    Args:
        env: An environment of brax (any of its physics engines) or of MuJoCo Playground, or any other with pure functions
            ``reset(key)`` and ``step(state, action)`` and a model; a `mujoco.MjModel`; or a Gymnasium environment of MuJoCo,
            which stays on the host.
        cameras: Name or index of a camera, several of them, or a dictionary of cameras by name; MuJoCo's free camera if None.
        image_size: Height and width in pixels: one number, a pair, or a dictionary of these by camera.
        outputs: ``rgb``, ``depth``, ``segmentation`` (geom ids), ``bodies`` (body ids), ``normals``: one or several, or a
            dictionary of these by camera. See `Views`.
        goal_image: Joint positions [nq] of a goal, or a function from the state after a reset (for Gymnasium: from the
            unwrapped environment) to joint positions. Its images are rendered at the reset and kept for the episode. If None,
            there are no goal images.
        frames: Number of most recent images of each kind in an observation, stacked along the channels, newest last. One image
            shows positions, several show velocities. A reset repeats its image. Goals have one image.
        layout: ``dict``: the environment's own observation (as ``state``, if it is an array) and the images ``pixels/CAMERA``
            (colours), ``pixels/CAMERA/OUTPUT`` and, for goals, ``.../goal``. ``images``: only the images. ``image``: one array
            [H, W, C].
        dtype: ``float32`` (colours from 0 to 1, as brax's agents expect them) or ``uint8``. If None, uint8 for Gymnasium, else
            float32.
        depth_range: Depths (m) encoded as 0 and 1, or as 0 and 255 for uint8. If None, depths are in m, float32.
        clip_range: Near and far clipping planes of the cameras (m), or a dictionary of these by camera; the model's if None.
        step: For a `mujoco.MjModel`, function ``step(data, action)`` from `mjx.Data` to `mjx.Data`. If None, one `mjx.step`
            with the action as ``ctrl``.
        **scene_options: Further options of `jaxrl_vis_envs.render.Scene.from_mjmodel`.

    Returns:
        A `PixelEnv`, whose states have the class of those of the wrapped environment, or a Gymnasium wrapper.

    Raises:
        ValueError: ``env`` is none of these, or an option is invalid.
        ImportError: ``env`` is a Gymnasium environment, and Gymnasium is not installed.
    """
    if isinstance(env, type):
        raise ValueError(f"env must be an environment, got the class {env.__name__}: make one of it first")
    if isinstance(env, GoalEnv):
        raise ValueError(f"{type(env).__name__} renders itself: see image_observer, and make('Visual...') for built-in tasks")
    if step is not None and not isinstance(env, mujoco.MjModel):
        raise ValueError(f"step is for a mujoco.MjModel; {type(env).__name__} has its own")
    if not isinstance(frames, int) or frames < 1:
        raise ValueError(f"frames must be a whole number, at least 1, got {frames!r}")
    is_model = isinstance(env, mujoco.MjModel)
    mj_model = env if is_model else poses.find_model(env)
    options = dict(cameras=cameras, image_size=image_size, outputs=outputs, clip_range=clip_range, **scene_options)
    if not is_model and isinstance(getattr(getattr(env, "unwrapped", None), "data", None), mujoco.MjData):
        from jaxrl_vis_envs.pixels.host import GymnasiumPixels

        if frames > 1:
            raise ValueError("frames is for pure functions: put gymnasium.wrappers.FrameStackObservation around this wrapper")
        return GymnasiumPixels(env, goal_image, dict(layout=layout, dtype=dtype or "uint8", depth_range=depth_range), **options)
    views = Views(mj_model, **options)
    if is_model:
        from jaxrl_vis_envs.pixels.model_env import ModelEnv

        env = ModelEnv(env, step)
    return PixelEnv(env, views, Format(layout, dtype or "float32", depth_range), goal_image, frames)


class PixelEnv:
    """Environment whose observations are, or contain, images; made by `wrap`.

    States are those of the wrapped environment, with another ``obs``. `reset` and `step` are pure functions of one environment:
    brax's and Playground's wrappers vmap them. All other attributes are read from and written to the wrapped environment,
    except ``unwrapped``, which is this environment: wrappers for domain randomisation replace the model of ``unwrapped``, and
    step that.

    Attributes:
        env: The wrapped environment.
        views: Cameras, outputs and scenes.
    """

    _frames: int

    def __init__(self, env: Any, views: Views, form: Format, goal_image: GoalImage = None, frames: int = 1) -> None:
        """See `wrap`."""
        own = dict(
            env=env,
            views=views,
            _form=form,
            _goal_image=goal_image,
            _frames=frames,
            _poses=poses.Poses(views.mj_model),
            _model=poses.traced_model(env),
            _names=formats.image_names(views.outputs),
        )
        vars(self).update(own)

    def reset(self, rng: jax.Array) -> Any:
        """Start an episode from a key; the state's ``obs`` is as described in `wrap`."""
        state = self.env.reset(rng)
        goals = {}
        if self._goal_image is not None:
            source = formats.goal_poses(self._goal_image, state)
            goals = self._form.images(self._render(source), formats.GOAL_SUFFIX)
        return self._with_images(state, None, goals)

    def step(self, state: Any, action: jax.Array) -> Any:
        """Step the wrapped environment with an ``action`` [A], and render."""
        own, earlier, goals = self._split(state)
        changes: dict[str, Any] = {"obs": own}
        if self._form.layout != "dict":
            changes["info"] = {name: value for name, value in state.info.items() if name != UNWRAPPED_OBS}
        return self._with_images(self.env.step(_replace(state, **changes), action), earlier, goals)

    @property
    def observation_size(self) -> Any:
        """Shape of the image for the layout ``image``, else shapes by key of the observation."""
        obs = jax.eval_shape(self.reset, jax.random.PRNGKey(0)).obs
        return obs.shape if self._form.layout == "image" else {name: leaf.shape for name, leaf in obs.items()}

    @property
    def unwrapped(self) -> Any:
        """This environment."""
        return self

    def render_views(self, state: Any) -> dict[str, dict[str, jax.Array]]:
        """Render a state of this environment: images by camera and output, as from `Views`, before any encoding."""
        return self._render(state)

    def _render(self, source: Any) -> dict[str, dict[str, jax.Array]]:
        model = poses.traced_model(self.env)
        if model is self._model:
            return self.views(self._poses(source))
        mj_model = self.views.mj_model
        scenes = {name: poses.randomized_scene(scene, model, mj_model) for name, scene in self.views.scenes.items()}
        return self.views(self._poses(source, model), scenes)

    def _with_images(self, state: Any, earlier: Any, goals: Any) -> Any:
        """Return ``state`` with its images in the observation.

        Args:
            state: State of the wrapped environment.
            earlier: Images of the previous observation, by name or as channels of one image; None at the start of an episode.
            goals: Goal images, in the same form or by name.
        """
        layout, own = self._form.layout, state.obs
        images: Any = self._form.images(self._render(state))
        if layout == "image":
            images = self._form.concatenate_images(images)
            goals = self._form.concatenate_images(goals) if isinstance(goals, dict) and goals else goals
        if self._frames > 1:
            images = jax.tree.map(
                self._repeat_frames if earlier is None else _push_frame, images, images if earlier is None else earlier
            )
        if layout == "image":
            obs = images if isinstance(goals, dict) else jnp.concatenate([images, goals], axis=-1)
        elif layout == "images":
            obs = images | goals
        else:
            named = dict(own) if isinstance(own, Mapping) else {STATE: own}
            if clash := set(named) & {*images, *goals}:
                raise ValueError(f"the environment has observations of the same name: {', '.join(clash)}")
            return _replace(state, obs=named | images | goals)
        return _replace(state, obs=obs, info={**state.info, UNWRAPPED_OBS: own})

    def _repeat_frames(self, image: jax.Array, _: jax.Array) -> jax.Array:
        """Stack an image with copies of itself along the channels, at the start of an episode."""
        return jnp.concatenate([image] * self._frames, axis=-1)

    def _split(self, state: Any) -> tuple[Any, Any, Any]:
        """Split a state of this environment into the wrapped environment's observation, the images and the goal images."""
        layout, obs = self._form.layout, state.obs
        has_goals = self._goal_image is not None
        if layout == "image":
            # Goal images have as many channels as one frame of the images.
            end = obs.shape[-1] // (self._frames + has_goals) * self._frames
            return state.info[UNWRAPPED_OBS], obs[:, :, :end], obs[:, :, end:] if has_goals else {}
        images = {name: obs[name] for name in self._names}
        goals = {name + formats.GOAL_SUFFIX: obs[name + formats.GOAL_SUFFIX] for name in self._names if has_goals}
        if layout == "images":
            return state.info[UNWRAPPED_OBS], images, goals
        own = {name: leaf for name, leaf in obs.items() if name not in images and name not in goals}
        return own if self._observes_mapping else own[STATE], images, goals

    @functools.cached_property
    def _observes_mapping(self) -> bool:
        """True if the wrapped environment's own observation is a dictionary."""
        return isinstance(jax.eval_shape(self.env.reset, jax.random.PRNGKey(0)).obs, Mapping)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "env" not in vars(self):
            raise AttributeError(name)
        return getattr(self.env, name)

    def __setattr__(self, name: str, value: Any) -> None:
        # Set on the innermost environment, which reads it in `step`, not on a wrapper around it.
        setattr(self if name in vars(self) else getattr(self.env, "unwrapped", self.env), name, value)


def _replace(state: Any, **changes: Any) -> Any:
    """Return a copy of a state of any library with some fields changed."""
    return state.replace(**changes) if hasattr(state, "replace") else dataclasses.replace(state, **changes)


def _push_frame(image: jax.Array, earlier: jax.Array) -> jax.Array:
    """Append an image to the ``earlier`` ones along the channels, and drop the oldest."""
    return jnp.concatenate([earlier[..., image.shape[-1] :], image], axis=-1)
