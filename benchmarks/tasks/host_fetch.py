"""FetchReach of Gymnasium-Robotics on the host: stepped and rendered by MuJoCo, without MJX and without our renderer.

Images are 32x32 depth from MuJoCo's OpenGL renderer (``MUJOCO_GL=egl`` or ``osmesa`` without a screen), in the view of
``contrastive_rl``, with 8 bits for 0.25 to 1.25 m: colours of so few pixels hardly show how far the gripper is from the camera.
Goal images show the arm after ten actions of a proportional controller. Success means a distance of at most 5 cm at the last
step.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np

from jaxrl_vis.errors import RequestError

ENV, HORIZON, THRESHOLD, ACTION_SIZE = "FetchReach-v4", 50, 0.05, 4
SHAPE = (32, 32, 1)
_NEAR, _FAR = 0.25, 1.25

# Their triangles are half of all, and out of the camera's sight.
_HIDDEN = ("robot0:estop_link", "robot0:laser_link")

Policy = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Function (image, goal image, true displacement [3] to the goal, m) -> action [4]; learners ignore the displacement."""


class Episode(NamedTuple):
    """One episode of T steps.

    Attributes:
        observations: [T+1, 32, 32, 1] uint8.
        actions: [T, 4] float32.
        goal: [32, 32, 1] uint8.
        states: [T+2, 3] float32, positions of the grip, and last the goal's, m.
        is_reached: True if the last position is within the threshold.
    """

    observations: np.ndarray
    actions: np.ndarray
    goal: np.ndarray
    states: np.ndarray
    is_reached: bool


def add_noise(image: np.ndarray, noise: float, draw: np.random.Generator) -> np.ndarray:
    """Return images [...] uint8 with Gaussian noise added, rounded and clipped to 0 to 255.

    Args:
        image: [...] uint8.
        noise: Standard deviation, grey levels; 0 draws nothing.
        draw: Source of the noise.
    """
    noisy = image + np.float32(noise) * draw.standard_normal(image.shape, np.float32) if noise else image
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def make_env() -> Any:
    """Make the environment, without its time limit.

    Raises:
        RequestError: Gymnasium-Robotics is missing, or does not work with the installed MuJoCo.
    """
    try:
        import gymnasium
        import gymnasium_robotics  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise RequestError("FetchReach on the host needs Gymnasium-Robotics: pip install gymnasium-robotics") from error
    gymnasium.register_envs(gymnasium_robotics)
    try:
        return gymnasium.make(ENV).unwrapped
    except AssertionError as error:  # of its joint types, by MuJoCo 3.17 and later
        raise RequestError(
            f"Gymnasium-Robotics does not work with MuJoCo {mujoco.__version__}: "
            "in an environment of its own, pip install 'mujoco==3.3.7'"
        ) from error


class Camera:
    """Depth camera of an environment of MuJoCo. Close it to free the GL context."""

    def __init__(self, env: Any) -> None:
        """Open the GL context; make the mocap body and `_HIDDEN` transparent in the environment's model, in place."""
        model, self._data = env.model, env.data
        for geom in range(model.ngeom):
            if model.geom(geom).name in _HIDDEN or model.body(model.geom_bodyid[geom]).name == "robot0:mocap":
                model.geom_rgba[geom, 3] = 0.0
        model.vis.quality.offsamples = 0  # no antialiasing
        self._renderer = mujoco.Renderer(model, *SHAPE[:2])
        self._renderer.enable_depth_rendering()
        self._view, self._options = mujoco.MjvCamera(), mujoco.MjvOption()
        self._view.lookat[:], self._view.distance = (1.2, 0.8, 0.5), 0.8
        self._view.azimuth, self._view.elevation = 180.0, -30.0
        self._options.sitegroup[:] = 0  # the goal is a site

    def render(self) -> np.ndarray:
        """Render a depth image [32, 32, 1] uint8: 0 at 0.25 m and nearer, 255 at 1.25 m and farther, linear in between."""
        self._renderer.update_scene(self._data, self._view, self._options)
        share = (self._renderer.render()[..., None] - _NEAR) / (_FAR - _NEAR)
        return np.round(255.0 * np.clip(share, 0.0, 1.0)).astype(np.uint8)

    def close(self) -> None:
        """Free the GL context."""
        self._renderer.close()


class HostFetch:
    """FetchReach with one robot and its camera. Close it to free the GL context."""

    def __init__(self, noise: float, seed: int) -> None:
        """Make the environment.

        Args:
            noise: Standard deviation of the camera noise, grey levels.
            seed: Seed of the sequences of goals and of noise.

        Raises:
            RequestError: As in `make_env`.
        """
        self._env, self._noise = make_env(), noise
        self._camera = Camera(self._env)
        self.reseed(seed)

    def reseed(self, seed: int) -> None:
        """Start the sequences of goals and of noise anew."""
        self._draw = np.random.default_rng(seed)

    def _begin(self) -> tuple[np.ndarray, np.ndarray]:
        observation, _ = self._env.reset(seed=int(self._draw.integers(2**31)))
        return observation["achieved_goal"], observation["desired_goal"]

    def _step(self, action: np.ndarray) -> np.ndarray:
        return self._env.step(np.asarray(action, np.float32))[0]["achieved_goal"]

    def _image(self) -> np.ndarray:
        return add_noise(self._camera.render(), self._noise, self._draw)

    def run_episode(self, policy: Policy) -> Episode:
        """Roll out an episode of `HORIZON` steps; actions are clipped to [-1, 1].

        The goal image is taken after ten actions of a proportional controller towards the goal, before the robot is reset.
        """
        grip, goal = self._begin()
        for _ in range(10):
            grip = self._step(np.append(np.clip(10.0 * (goal - grip), -1.0, 1.0), 0.0))
        goal_image = self._image()
        grip, _ = self._begin()
        images, states, actions = [self._image()], [grip], []
        for _ in range(HORIZON):
            actions.append(np.clip(policy(images[-1], goal_image, goal - states[-1]), -1.0, 1.0))
            states.append(self._step(actions[-1]))
            images.append(self._image())
        is_reached = bool(np.linalg.norm(states[-1] - goal) <= THRESHOLD)
        true = np.stack([*states, goal]).astype(np.float32)
        return Episode(np.stack(images), np.stack(actions).astype(np.float32), goal_image, true, is_reached)

    def close(self) -> None:
        """Free the GL context."""
        self._camera.close()
