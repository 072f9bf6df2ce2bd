"""Hand reach: bring the five fingertips of a Shadow hand to where the goal image shows them.

HandReach of Gym's robotics environments with the goals of the OL-AUX release: where the fingertips are after 20 random actions
from the start, most of which fully open or close each joint. ``goal_rule="meet"`` is Gym's own: the thumb meets a finger over
the palm, or, one time in ten, everything returns to the start; its threshold in Gym is .01 m. The release's images differ from
ours in where the camera is (``view``) and in what marks the fingertips (``tip_marks``).

    VisualHandReach   sees RGB-D from above the palm; each fingertip has its own colour
    HandReach         sees joint angles and velocities, and the fingertips

State: positions of the tips of first, middle, ring and little finger and thumb in the world, m; the distance is that of the 15
numbers together. Action: a target angle for each of the 20 actuators, -1 and 1 being the ends of its range. The distal
joints of the four fingers have no actuator; a tendon ties them to the joint before.
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
_FAINT_RADIUS, _FAINT_ALPHA = 0.01, 0.2  # m; of the release's marks
_PLAIN = (0.88, 0.88, 0.9, 1.0)  # colour of a finger's last link, where it has none of its own
# Gym's rule, m in the world: where thumb and finger meet, from the palm's origin; its scatter; how far from it each tip stays.
_MEETING_OFFSET = (0.0, -0.09, 0.05)
_MEETING_SCATTER = 0.005
_MEETING_DISTANCE = 0.005
_RETURN_SHARE = 0.1
_IK_STEPS = 30
_IK_DAMPING = 1e-3  # m
_IK_LARGEST_STEP = 0.2  # rad


@dataclasses.dataclass(frozen=True)
class HandReachConfig(TaskConfig):
    """Settings of the task. Lengths in m."""

    horizon: int = 50
    threshold: float = 0.03
    """An episode succeeds where the 15 numbers lie within this distance of the goal's, m (1.3 cm rms a finger)."""
    goal_rule: Literal["random_actions", "meet"] = "random_actions"
    """Where goals come from: random actions from the start (the release), or thumb and finger that meet (Gym)."""
    goal_actions: int = 20
    """Random actions that lead to a goal."""
    goal_noise: float = 5.0
    """Standard deviation of the normal noise added to each of these uniform actions before it is clipped to [-1, 1]."""
    substeps: int = 20
    """Physics steps in a control step of 40 ms (20 is the original's 2 ms; at 10 tips are off by .1 mm more)."""
    goal_substeps: int = 10
    """The same while a goal is made, where what matters is the distribution."""
    contacts: bool = True
    """Whether fingers, thumb and palm collide. False only shows how much that matters."""
    solver_iterations: int = 1
    """Newton iterations in a physics step."""
    line_search_iterations: int = 4
    """Line search iterations in a Newton iteration of MJX's solver, which runs on a CPU (see `constraints`)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.whole(self, "goal_actions", "substeps", "goal_substeps", "solver_iterations", "line_search_iterations")
        checks.one_of(self, "goal_rule", ("random_actions", "meet"))
        checks.not_negative(self, "goal_noise")
        checks.true_or_false(self, "contacts")


@dataclasses.dataclass(frozen=True)
class VisualHandReachConfig(PixelsConfig, HandReachConfig):
    """Settings of the task and its images."""

    depth_range: tuple[float, float] = (0.7, 0.96)
    """Depths that bytes 0 and 255 stand for, m: 1 mm a step, from above fingers that point up to below the lowest knuckle."""
    clip_range: tuple[float, float] = (0.0124, 62.0)
    """The clipping planes of the release, m."""
    view: View = "palm"
    """Where the camera is: above the palm, or before the fingertips, as in the release."""
    tip_marks: TipMarks = "bright"
    """What marks fingertips: opaque spheres and links in their colour, or hardly visible smaller spheres, as in the release."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.one_of(self, "view", get_args(View))
        checks.one_of(self, "tip_marks", get_args(TipMarks))


class HandReach(MjxGoalEnv):
    """The task; what the agent sees of it is up to ``observer``."""

    action_size = 20
    camera = "front"
    distance_unit = "m"
    exact_contacts = True  # they decide what happens
    chance, difficulty = 0.0, 4.3  # benchmarks/tasks/task_difficulty.py HandReach --episodes 1000

    def __init__(self, config: HandReachConfig, observer: Callable[[mujoco.MjModel], Observer] | None = None):
        """Builds the model.

        Args:
            config: The settings.
            observer: Given the model, returns the function from poses to images. Default: `observe_state`.
        """
        is_before = self.camera_of(config) == _RELEASE_CAMERA
        mj_model = mjx_model.load_model("hand_reach.xml", _add_release_camera if is_before else None)
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
        self._start = mjx_model.still_data(mj_model, "start")
        super().__init__(config, mj_model, observer)
        goal_model = mjx_model.load_model("hand_reach.xml")
        goal_model.opt = mj_model.opt
        goal_model.opt.timestep = _CONTROL_PERIOD / config.goal_substeps
        self._goal_model = mjx_model.put_model(goal_model)

    @classmethod
    def camera_of(cls, config: HandReachConfig) -> str:
        is_before = isinstance(config, VisualHandReachConfig) and config.view == "fingertips"
        return _RELEASE_CAMERA if is_before else cls.camera

    def sample_start(self, key: jax.Array) -> mjx.Data:
        return self._start

    def sample_goal(self, key: jax.Array) -> mjx.Data:
        if self.config.goal_rule == "meet":
            return self.configuration_at(self._meeting_tips(key))
        return self._after_random_actions(key)

    def act(self, data: mjx.Data, action: jax.Array) -> mjx.Data:
        data = data.replace(ctrl=self._targets(action))
        return mjx_model.simulate(self._model, data, self.config.substeps, self.exact_contacts, undisturbed=True)

    def achieved(self, data: mjx.Data) -> jax.Array:
        return data.site_xpos[self._tips].reshape(-1)

    def observe_state(self, data: mjx.Data) -> jax.Array:
        """Joint angles (rad) and velocities (rad/s), fingertips (m): [63] float32, as in Gym."""
        return jnp.concatenate([data.qpos, data.qvel, self.achieved(data)])

    def configuration(self, joint_angles: jax.Array) -> mjx.Data:
        """The hand at rest with ``joint_angles`` [24] float32, rad."""
        return mjx_model.kinematics(self._model, self._start.replace(qpos=joint_angles))

    def configuration_at(self, tips: jax.Array) -> mjx.Data:
        """The hand at rest with its tips as near to ``tips`` [5, 3] (m, world) as its joints let it (damped least squares)."""
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
        """Target angles [20] (rad) of an action [20]."""
        low, high = jnp.asarray(self.mj_model.actuator_ctrlrange.T, jnp.float32)
        return 0.5 * (low + high) + 0.5 * (high - low) * action

    def _after_random_actions(self, key: jax.Array) -> mjx.Data:
        """The hand where random actions from the start have led it, at rest."""
        uniform_key, noise_key = jax.random.split(key)
        shape = (self.config.goal_actions, self.action_size)
        actions = jax.random.uniform(uniform_key, shape, jnp.float32, -1.0, 1.0)
        actions = jnp.clip(actions + self.config.goal_noise * jax.random.normal(noise_key, shape, jnp.float32), -1.0, 1.0)

        def act(data: mjx.Data, action: jax.Array) -> tuple[mjx.Data, None]:
            data = data.replace(ctrl=self._targets(action))
            substeps, is_beside = self.config.goal_substeps, self.exact_contacts
            return mjx_model.take_steps(self._goal_model, data, substeps, undisturbed=True, beside_exact=is_beside), None

        return self.configuration(jax.lax.scan(act, self._start, actions)[0].qpos)

    def _meeting_tips(self, key: jax.Array) -> jax.Array:
        """Fingertips [5, 3] (m, world) of Gym's rule."""
        finger_key, scatter_key, return_key = jax.random.split(key, 3)
        start = self._start.site_xpos[self._tips]
        palm = self._start.xpos[self.mj_model.body("palm").id]
        meeting = palm + jnp.asarray(_MEETING_OFFSET) + _MEETING_SCATTER * jax.random.normal(scatter_key, (3,), jnp.float32)
        away = meeting - start
        near_meeting = meeting - _MEETING_DISTANCE * away / jnp.linalg.norm(away, axis=-1, keepdims=True)
        finger = jax.random.randint(finger_key, (), 0, _THUMB)
        meets = (jnp.arange(len(_FINGERTIPS)) == finger) | (jnp.arange(len(_FINGERTIPS)) == _THUMB)
        meets &= jax.random.uniform(return_key) >= _RETURN_SHARE
        return jnp.where(meets[:, None], near_meeting, start)


def _add_release_camera(spec: mujoco.MjSpec) -> None:
    """The camera of the authors' release: before the fingertips, it looks along world y, and up is up."""
    spec.worldbody.add_camera(name=_RELEASE_CAMERA, pos=[1.0, 0.05, 0.15], quat=[1.0, 1.0, 0.0, 0.0], fovy=12.0)


def _joints_by_actuator(mj_model: mujoco.MjModel) -> np.ndarray:
    """Radians that each joint turns per radian of each actuator's joint, tied ones included: [nq, nu]."""
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
