"""Hand reach: move the five fingertips of a Shadow hand to their positions in the goal image.

HandReach of Gym's robotics environments with the goals of the OL-AUX release: the fingertip positions after 20 random actions
from the start, most of which fully open or close each joint. ``goal_rule="meet"`` is Gym's own: the thumb meets a finger above
the palm or, one time in ten, everything returns to the start; its threshold in Gym is .01 m. The release's images differ from
those here in the camera pose (``view``) and the fingertip markers (``tip_marks``).

    VisualHandReach   observes RGB-D from above the palm; each fingertip has its own colour
    HandReach         observes joint angles and velocities, and fingertip positions

State: positions in the world of the tips of the first, middle, ring and little finger and the thumb, m; the distance is that of
all 15 coordinates. Action: a target angle for each of the 20 actuators, with -1 and 1 at the ends of its range. The distal
joints of the four fingers have no actuator; a tendon couples each to the joint before it.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs import checks
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.pixels import Observer, PixelsConfig
from jaxrl_vis_envs.tasks.config import TaskConfig
from jaxrl_vis_envs.tasks.mjx_env import MjxGoalEnv, register_task

View = Literal["palm", "fingertips"]
TipMarks = Literal["bright", "faint"]
_CONTROL_PERIOD = 0.04  # s
_FINGERTIPS = ("fftip", "mftip", "rftip", "lftip", "thtip")
_THUMB = 4
_RELEASE_CAMERA = "fingertips"
_FAINT_RADIUS, _FAINT_ALPHA = 0.01, 0.2  # m; of the release's markers
_PLAIN = (0.88, 0.88, 0.9, 1.0)  # colour of a finger's last link, if not the fingertip's
# Gym's rule, m in the world: meeting point of thumb and finger, from the palm's origin; its standard deviation; distance that
# each tip keeps from it.
_MEETING_OFFSET = (0.0, -0.09, 0.05)
_MEETING_SCATTER = 0.005
_MEETING_DISTANCE = 0.005
_RETURN_FRACTION = 0.1
_IK_STEPS = 30
_IK_DAMPING = 1e-3  # m
_IK_LARGEST_STEP = 0.2  # rad


@dataclasses.dataclass(frozen=True)
class HandReachConfig(TaskConfig):
    """Settings of the task. Lengths in m."""

    horizon: int = 50
    threshold: float = 0.03
    """Distance of the 15 fingertip coordinates from the goal's within which an episode succeeds, m (1.3 cm rms per finger)."""
    goal_rule: Literal["random_actions", "meet"] = "random_actions"
    """Source of goals: random actions from the start (the release), or thumb and finger meeting (Gym)."""
    goal_actions: int = 20
    """Number of random actions that generate a goal, with ``goal_rule="random_actions"``."""
    goal_noise: float = 5.0
    """Standard deviation of the Gaussian noise added to each of the uniform ``goal_actions`` before clipping to [-1, 1]."""
    substeps: int = 20
    """Physics steps per control step of 40 ms (20 gives the original's 2 ms; 10 adds .1 mm of error at the tips)."""
    goal_substeps: int = 10
    """Physics steps per control step while generating a goal by random actions, of which only the distribution matters."""
    contacts: bool = True
    """Simulate collisions of fingers, thumb and palm. False is for measuring the effect of contacts."""
    solver_iterations: int = 1
    """Newton iterations per physics step."""
    line_search_iterations: int = 4
    """Line search iterations per Newton iteration of MJX's solver; the scalar engine ignores them (see `physics`)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.integers(self, "goal_actions", "substeps", "goal_substeps", "solver_iterations", "line_search_iterations")
        checks.choice(self, "goal_rule", ("random_actions", "meet"))
        checks.not_negative(self, "goal_noise")
        checks.boolean(self, "contacts")


@dataclasses.dataclass(frozen=True)
class VisualHandReachConfig(PixelsConfig, HandReachConfig):
    """Settings of the task and its images."""

    depth_range: tuple[float, float] = (0.7, 0.96)
    """Depths encoded as 0 and 255, m: 1 mm per step, from above upright fingers to below the lowest knuckle. Only for
    ``depth_encoding="metric"``."""
    clip_range: tuple[float, float] = (0.0124, 62.0)
    """Near and far clipping planes of the release, m. Only for ``depth_encoding="zbuffer"``."""
    view: View = "palm"
    """Camera pose: above the palm or, as in the release, in front of the fingertips."""
    tip_marks: TipMarks = "bright"
    """Fingertip markers: opaque spheres and links in their colour or, as in the release, smaller, faint spheres."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.choice(self, "view", get_args(View))
        checks.choice(self, "tip_marks", get_args(TipMarks))


class HandReach(MjxGoalEnv):
    """Hand reach task (see the module docstring), observed as images or as state, depending on ``observer``."""

    action_size = 20
    action_meaning = "target angles of the 20 actuators, in the model's order, with -1 and 1 at the ends of each one's range"
    camera = "front"
    distance_unit = "m"
    exact_contacts = True  # the task depends on contacts
    chance, difficulty = 0.0, 4.3  # benchmarks/tasks/task_difficulty.py HandReach --episodes 1000

    def __init__(self, config: HandReachConfig, observer: Callable[[mujoco.MjModel], Observer] | None = None):
        """Build the model.

        Args:
            config: Settings of the task.
            observer: Function that builds the observer (poses to images) from the model. If None, `observe_state` is used.
        """
        is_release_view = self.select_camera(config) == _RELEASE_CAMERA
        mj_model = mjx_model.load_model("hand_reach.xml", _add_release_camera if is_release_view else None)
        mj_model.opt.iterations = config.solver_iterations
        mj_model.opt.ls_iterations = config.line_search_iterations
        mj_model.opt.timestep = _CONTROL_PERIOD / config.substeps
        if not config.contacts:
            mj_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self.control_period = _CONTROL_PERIOD
        if isinstance(config, VisualHandReachConfig) and config.tip_marks == "faint":
            for name in _FINGERTIPS:
                mj_model.geom(name).rgba[3] = _FAINT_ALPHA
                mj_model.geom(name).size[0] = _FAINT_RADIUS
                mj_model.geom(name.replace("tip", "distal")).rgba = _PLAIN
        self._tips = np.array([mj_model.site(name).id for name in _FINGERTIPS])
        self._start = mjx_model.rest_data(mj_model, "start")
        super().__init__(config, mj_model, observer)
        goal_model = mjx_model.load_model("hand_reach.xml")
        goal_model.opt = mj_model.opt
        goal_model.opt.timestep = _CONTROL_PERIOD / config.goal_substeps
        self._goal_model = mjx_model.put_model(goal_model)

    @classmethod
    def select_camera(cls, config: HandReachConfig) -> str:
        is_release_view = isinstance(config, VisualHandReachConfig) and config.view == "fingertips"
        return _RELEASE_CAMERA if is_release_view else cls.camera

    def sample_start(self, key: jax.Array) -> mjx.Data:
        return self._start

    def sample_goal(self, key: jax.Array) -> mjx.Data:
        if self.config.goal_rule == "meet":
            return self.configuration_at(self._meeting_tips(key))
        return self._take_random_actions(key)

    def act(self, data: mjx.Data, action: jax.Array) -> mjx.Data:
        data = data.replace(ctrl=self._targets(action))
        return mjx_model.simulate(self._model, data, self.config.substeps, self.exact_contacts)

    def achieved(self, data: mjx.Data) -> jax.Array:
        return data.site_xpos[self._tips].reshape(-1)

    def observe_state(self, data: mjx.Data) -> jax.Array:
        """Return joint angles (rad) and velocities (rad/s), fingertip positions (m): [63] float32, as in Gym."""
        return jnp.concatenate([data.qpos, data.qvel, self.achieved(data)])

    def configuration(self, joint_angles: jax.Array) -> mjx.Data:
        """Return the hand at rest with ``joint_angles`` [24] float32, rad."""
        return mjx_model.kinematics(self._model, self._start.replace(qpos=joint_angles))

    def configuration_at(self, tips: jax.Array) -> mjx.Data:
        """Return the hand at rest with its tips nearest to ``tips`` [5, 3] (m, world) within joint limits (damped least
        squares).
        """
        low, high = jnp.asarray(self.mj_model.jnt_range.T, jnp.float32)
        coupling = jnp.asarray(_joints_by_actuator(self.mj_model), jnp.float32)

        def improve(data: mjx.Data, _: Any) -> tuple[mjx.Data, None]:
            jacobian = coupling.T @ mjx_model.tip_jacobian(self.mj_model, data, self._tips).reshape(-1, 15)  # [nu, 15]
            error = (tips - data.site_xpos[self._tips]).reshape(-1)
            step = jacobian @ jnp.linalg.solve(jacobian.T @ jacobian + _IK_DAMPING**2 * jnp.eye(15), error)
            change = coupling @ jnp.clip(step, -_IK_LARGEST_STEP, _IK_LARGEST_STEP)
            return self.configuration(jnp.clip(data.qpos + change, low, high)), None

        with jax.default_matmul_precision("highest"):
            return jax.lax.scan(improve, self._start, length=_IK_STEPS)[0]

    def _targets(self, action: jax.Array) -> jax.Array:
        """Convert an action [20] to target angles [20] (rad)."""
        low, high = jnp.asarray(self.mj_model.actuator_ctrlrange.T, jnp.float32)
        return 0.5 * (low + high) + 0.5 * (high - low) * action

    def _take_random_actions(self, key: jax.Array) -> mjx.Data:
        """Return the hand at rest in the configuration reached by random actions from the start."""
        uniform_key, noise_key = jax.random.split(key)
        shape = (self.config.goal_actions, self.action_size)
        actions = jax.random.uniform(uniform_key, shape, jnp.float32, -1.0, 1.0)
        actions = jnp.clip(actions + self.config.goal_noise * jax.random.normal(noise_key, shape, jnp.float32), -1.0, 1.0)

        def act(data: mjx.Data, action: jax.Array) -> tuple[mjx.Data, None]:
            data = data.replace(ctrl=self._targets(action))
            # Not exact, but False (not None) shares the kernel with the exact steps of `act`.
            return mjx_model.take_steps(self._goal_model, data, self.config.goal_substeps, exact=False), None

        return self.configuration(jax.lax.scan(act, self._start, actions)[0].qpos)

    def _meeting_tips(self, key: jax.Array) -> jax.Array:
        """Sample fingertip positions [5, 3] (m, world) by Gym's rule."""
        finger_key, scatter_key, return_key = jax.random.split(key, 3)
        start = self._start.site_xpos[self._tips]
        palm = self._start.xpos[self.mj_model.body("palm").id]
        meeting = palm + jnp.asarray(_MEETING_OFFSET) + _MEETING_SCATTER * jax.random.normal(scatter_key, (3,), jnp.float32)
        away = meeting - start
        near_meeting = meeting - _MEETING_DISTANCE * away / jnp.linalg.norm(away, axis=-1, keepdims=True)
        finger = jax.random.randint(finger_key, (), 0, _THUMB)
        meets = (jnp.arange(len(_FINGERTIPS)) == finger) | (jnp.arange(len(_FINGERTIPS)) == _THUMB)
        meets &= jax.random.uniform(return_key) >= _RETURN_FRACTION
        return jnp.where(meets[:, None], near_meeting, start)


def _add_release_camera(spec: mujoco.MjSpec) -> None:
    """Add the camera of the authors' release, in front of the fingertips, looking along world y, with z up."""
    spec.worldbody.add_camera(name=_RELEASE_CAMERA, pos=[1.0, 0.05, 0.15], quat=[1.0, 1.0, 0.0, 0.0], fovy=12.0)


def _joints_by_actuator(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the rotation of each joint (including coupled ones) per radian of each actuated joint: [nq, nu]."""
    ratios = np.zeros((mj_model.nq, mj_model.nu))
    joints = mj_model.actuator_trnid[:, 0]
    ratios[joints, np.arange(mj_model.nu)] = 1.0
    for tendon in range(mj_model.ntendon):
        first = mj_model.tendon_adr[tendon]
        tied, leading = mj_model.wrap_objid[first : first + 2]
        coefficients = mj_model.wrap_prm[first : first + 2]
        ratios[tied] = -coefficients[1] / coefficients[0] * ratios[leading]
    return ratios


register_task(HandReach, HandReachConfig, VisualHandReachConfig)
