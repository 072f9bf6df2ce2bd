"""Reaches by a policy trained on VisualStalkReach, in the physics of `reach`: the loop ``policy``.

The goal image shows the detected stalks in still air, with the gripper at the target; it is rendered from detections, without
ground truth. The policy then observes images from the camera over the arm's shoulder at 25 Hz, and its actions displace the
setpoint of the grip. After two seconds the jaws close, while the policy continues to act.
"""

import copy
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxrl_vis_envs
from jaxrl_vis.errors import RequestError
from jaxrl_vis.run.trained.policy import Policy
from jaxrl_vis.stalks.grasping.arm import control
from jaxrl_vis.stalks.grasping.arm.approach import is_within_reach
from jaxrl_vis.stalks.grasping.arm.control import Gains, Timing
from jaxrl_vis.stalks.grasping.arm.reach import Reaching, ReachResult, Scene, begin, build_arm_model, held_stalks, step_control
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.pixels import ImageObserver
from jaxrl_vis_envs.plants import bending
from jaxrl_vis_envs.plants.bending import StalkShapes
from jaxrl_vis_envs.plants.stand import Stands
from jaxrl_vis_envs.tasks import stalk_arm
from jaxrl_vis_envs.tasks.stalk_reach import HOME, StalkReach, clamp_to_workspace

STALKS = 4
"""Number of stalks in a stand, the default of the task."""
HEIGHTS = (0.6, 0.9)
"""Minimum and maximum height of a goal, m, the default of the task."""


def check_policy(policy: Policy) -> None:
    """Raise a `RequestError` unless the policy is of VisualStalkReach and observes single images."""
    if not isinstance(policy.env, StalkReach) or policy.env.observation_spec.dtype != jnp.uint8:
        raise RequestError(f"--policy must be a run of VisualStalkReach, not of {policy.env_name}")
    if policy.env.frame_stack != 1:
        raise RequestError(f"--policy must see single images: its run has frame_stack {policy.env.frame_stack}")


class _LoopState(NamedTuple):
    """State of one arm moved by a policy.

    Attributes:
        reaching: State of the reach.
        setpoint: [3] float32, setpoint of the grip, m in the frame of the stand.
    """

    reaching: Reaching
    setpoint: jax.Array


def reach_by_policy(
    stands: Stands, detected: Stands, targets: np.ndarray, policy: Policy, key: jax.Array, wind_mm: float
) -> ReachResult:
    """Simulate reaches in which the policy moves each arm to its target and the jaws close there.

    Args:
        stands: True stalks around each of B arms.
        detected: Detected stalks around each arm, in the same order.
        targets: [B, 3] float32, where the jaws should close, m in the plot's frame; the policy sees them in goal images only.
        policy: Policy of a run of VisualStalkReach.
        key: [B], typed keys for sampling the wind.
        wind_mm: Amplitude of the stalks' sway, mm.

    Returns:
        Results of the reaches; ``path`` holds the setpoints of the grip. Arms whose target is out of reach hold and touch
        nothing.

    Raises:
        RequestError: The policy is not one of VisualStalkReach, or does not observe single images.
    """
    check_policy(policy)
    can = is_within_reach(stands.origin, targets)
    count = len(stands)
    fill = np.concatenate([np.arange(count), np.zeros(max(8, 1 << (count - 1).bit_length()) - count, int)])
    local = np.where(can[:, None], targets - stands.origin, np.array(HOME))[fill].astype(np.float32)
    shapes = [jax.tree.map(lambda part: jnp.asarray(part[fill]), bending.shapes(stalks)) for stalks in (stands, detected)]
    winds = jnp.full(len(fill), wind_mm / 1000, jnp.float32)
    draw, episode = _compile_programs(policy)
    goals = draw(shapes[1], local)
    result = jax.tree.map(lambda part: np.asarray(part)[:count], episode(*shapes[:1], goals, key[fill], winds))
    steps = round(Timing().reach / policy.env.control_period)
    error = np.linalg.norm(result["taken"][:, steps - 1] - (targets - stands.origin), axis=-1)
    mine = can[:, None] & stands.is_present
    return ReachResult(
        held=result["held"] & mine,
        path=result["path"] + stands.origin[:, None],
        taken=result["taken"] + stands.origin[:, None],
        arm_contact=result["arm_contact"] & mine,
        gripper_contact=result["gripper_contact"] & mine,
        reachable=can,
        error=np.where(can, error, np.nan).astype(np.float32),
        poses=result["poses"],
        interval=policy.env.control_period,
    )


@functools.lru_cache(maxsize=4)
def _compile_programs(policy: Policy) -> tuple[Any, Any]:
    """Return the compiled programs that render goal images of B arms from detected stalks and targets, and simulate reaches."""
    env: Any = policy.env
    arms, gains, timing = build_arm_model(STALKS), Gains(), Timing()
    observer = ImageObserver(arms.mj_model, env.camera, env.config)
    geoms = np.concatenate([arms.layout.lower_geom, arms.layout.upper_geom])
    substeps = round(env.control_period * control.RATE)

    def image(model: Any, data: Any) -> jax.Array:
        fitted = copy.copy(observer)
        fitted.scene = observer.scene.replace(size=observer.scene.size.at[geoms].set(model.geom_size[geoms]))
        return fitted(data)

    def draw(stalk_shapes: StalkShapes, target: jax.Array) -> jax.Array:
        model = bending.set_stalk_properties(arms.model, arms.layout, stalk_shapes)
        data = bending.place_stands(arms.rest, arms.layout, stalk_shapes)
        joints = stalk_arm.joints_at(target, 1.0)
        return image(model, mjx_model.kinematics(model, data.replace(qpos=data.qpos.at[: stalk_arm.ARM_JOINTS].set(joints))))

    def episode(stalk_shapes: StalkShapes, goal: jax.Array, key: jax.Array, wind: jax.Array) -> dict[str, jax.Array]:
        scene = Scene(stalk_shapes, bending.sample_gusts(key, wind), jnp.float32(1.0))
        model = bending.set_stalk_properties(arms.model, arms.layout, stalk_shapes)

        def step(moving: _LoopState, _: None) -> tuple[_LoopState, dict[str, jax.Array]]:
            reaching, place = moving
            action = jnp.clip(policy(image(model, reaching.data), goal), -1.0, 1.0)
            wanted = clamp_to_workspace(place + env.config.action_scale * action)
            is_closing = reaching.data.time > timing.reach - 0.5 / control.RATE

            def interpolate(reaching: Reaching, fraction: jax.Array) -> tuple[Reaching, None]:
                return step_control(arms, model, scene, reaching, place + fraction * (wanted - place), is_closing, gains), None

            reaching, _ = jax.lax.scan(interpolate, reaching, jnp.arange(1, substeps + 1) / substeps)
            reaching = reaching._replace(data=mjx_model.kinematics(model, reaching.data))
            now = {"path": wanted, "taken": stalk_arm.grip_at(reaching.data.qpos[:3]), "poses": reaching.data.qpos}
            return _LoopState(reaching, wanted), now

        with jax.default_matmul_precision("highest"):
            start = _LoopState(begin(arms, scene, HOME), jnp.asarray(HOME, jnp.float32))
            steps = round((timing.reach + timing.close) / env.control_period)
            (reaching, _), history = jax.lax.scan(step, start, length=steps)
        return {
            **history,
            "held": held_stalks(arms, reaching.data),
            "arm_contact": reaching.arm_contact,
            "gripper_contact": reaching.gripper_contact,
        }

    return jaxrl_vis_envs.jit(jax.vmap(draw)), jaxrl_vis_envs.jit(jax.vmap(episode))
