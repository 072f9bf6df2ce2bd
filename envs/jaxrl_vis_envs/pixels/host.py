"""Images for Gymnasium environments of MuJoCo, which run on the host; made by `jaxrl_vis_envs.pixels.wrap`."""

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import mujoco
import numpy as np

try:
    import gymnasium
except ImportError as error:
    raise ImportError("images for Gymnasium's environments need it: pip install 'jaxrl-vis[gymnasium]'") from error

from jaxrl_vis_envs.pixels import formats, poses
from jaxrl_vis_envs.pixels.formats import Format, GoalImage
from jaxrl_vis_envs.pixels.views import Views

_POSES = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "xpos", "xmat", "xipos")
# Bounds of observations other than colours and encoded depths.
_BOUNDS = {"segmentation": (-1, np.iinfo(np.int32).max), "bodies": (-2, np.iinfo(np.int32).max), "normals": (-1.0, 1.0)}


class _PoseData:
    """Container of poses as attributes, as the renderer reads them."""

    def __init__(self, arrays: dict[str, jax.Array]) -> None:
        vars(self).update(arrays)


class GymnasiumPixels(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """Gymnasium wrapper whose observations are, or contain, images of a MuJoCo environment; see `wrap`.

    Poses are computed from the joint positions, since those in the environment's data are stale by one physics step. Targets
    are rendered where the environment's own ``render`` shows them.

    Args:
        env: Environment to wrap.
        goal_image: Source of goal images, see `wrap`.
        form: Fields of `Format`.
        **options: Arguments of `Views`.

    Attributes:
        views: Cameras, outputs and scenes.
    """

    def __init__(self, env: gymnasium.Env, goal_image: GoalImage, form: dict[str, Any], **options: Any) -> None:
        # Pass arguments instead of objects built from them: Gymnasium stores them in the spec, to rebuild the environment.
        gymnasium.utils.RecordConstructorArgs.__init__(self, goal_image=goal_image, form=form, **options)
        gymnasium.Wrapper.__init__(self, env)
        self.views = views = Views(poses.find_model(env), **options)
        self._unwrapped_env: Any = env.unwrapped
        self._form, self._goal_image = Format(**form), goal_image
        self._names = formats.image_names(views.outputs)
        self._posed_data = mujoco.MjData(views.mj_model)
        self._goals: dict[str, np.ndarray] = {}
        self._draw = jax.jit(lambda arrays: self._form.images(views(_PoseData(arrays))))
        self.observation_space = self._build_space()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode, and render its goal images, if any; return the observation and the wrapped environment's info."""
        own, info = self.env.reset(seed=seed, options=options)
        if self._goal_image is not None:
            goal = poses.joint_positions(poses.physics_data(formats.goal_poses(self._goal_image, self.unwrapped)))
            self._goals = {name + formats.GOAL_SUFFIX: image for name, image in self._render(np.asarray(goal)).items()}
        return self._observe(own), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the wrapped environment and render; return its results, with the observation replaced."""
        own, reward, terminated, truncated, info = self.env.step(action)
        return self._observe(own), reward, terminated, truncated, info

    def _observe(self, observation: Any) -> Any:
        # Copy the goal images: callers may keep and modify the arrays of an observation.
        images = self._render() | {name: image.copy() for name, image in self._goals.items()}
        layout = self._form.layout
        if layout == "image":
            return np.array(self._form.concatenate_images(images))  # type: ignore[arg-type]
        if layout == "images":
            return images
        return (dict(observation) if isinstance(observation, Mapping) else {"state": observation}) | images

    def _render(self, qpos: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Render the images at joint positions ``qpos`` [nq] (None for the current ones) and the current mocap poses."""
        model, drawn = self.views.mj_model, self._posed_data
        with self._targets() as data:
            drawn.qpos[:] = data.qpos if qpos is None else qpos
            drawn.mocap_pos[:], drawn.mocap_quat[:] = data.mocap_pos, data.mocap_quat
            mujoco.mj_kinematics(model, drawn)
        images = self._draw(self._poses())
        return {name: np.array(image) for name, image in images.items()}

    def _poses(self) -> dict[str, np.ndarray]:
        return {name: np.asarray(getattr(self._posed_data, name), np.float32) for name in _POSES}

    @contextlib.contextmanager
    def _targets(self) -> Iterator[mujoco.MjData]:
        """Yield physics data with the targets at their positions, in the model too until the context ends.

        Gymnasium-Robotics moves sites and bodies of targets only in a callback of its ``render``. The callback also computes
        poses, on which the next action depends, so it is called with a copy of the data.
        """
        inner, own, model = self._unwrapped_env, self._unwrapped_env.data, self.views.mj_model
        if not hasattr(inner, "_render_callback"):
            yield own
            return
        sites = model.site_pos.copy()
        mujoco.mj_copyData(self._posed_data, model, own)
        inner.data = self._posed_data
        try:
            inner._render_callback()
            yield self._posed_data
        finally:
            inner.data, model.site_pos[:] = own, sites

    def _build_space(self) -> gymnasium.Space:
        """Return the observation space: a Box for the layout ``image``, else a Dict."""
        images = jax.eval_shape(self._draw, self._poses())
        spaces: dict[str, gymnasium.Space] = {}
        chosen = [output for outputs in self.views.outputs.values() for output in outputs]
        far = {name: float(scene.zfar) for name, scene in self.views.scenes.items()}
        cameras = [name for name, outputs in self.views.outputs.items() for _ in outputs]
        for name, output, camera in zip(self._names, chosen, cameras, strict=True):
            image = images[name]
            is_scaled = output == "rgb" or (output == "depth" and self._form.depth_range is not None)
            low, high = (0, 255 if image.dtype == np.uint8 else 1) if is_scaled else _BOUNDS.get(output, (0.0, far[camera]))
            spaces[name] = gymnasium.spaces.Box(low, high, image.shape, image.dtype.type)
        if self._goal_image is not None:
            spaces |= {name + formats.GOAL_SUFFIX: space for name, space in spaces.items()}
        if self._form.layout == "image":
            low, high = (
                self._form.concatenate_images({name: getattr(box, end) for name, box in spaces.items()})
                for end in ("low", "high")
            )
            return gymnasium.spaces.Box(np.asarray(low), np.asarray(high), dtype=np.dtype(self._form.dtype).type)
        if self._form.layout == "dict":
            own = self.env.observation_space
            spaces = (dict(own.spaces) if isinstance(own, gymnasium.spaces.Dict) else {"state": own}) | spaces
        return gymnasium.spaces.Dict(spaces)
