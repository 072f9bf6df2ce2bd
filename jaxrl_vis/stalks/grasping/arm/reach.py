"""Batched simulation of arms that reach for stalks: physics, contacts and wind in one compiled program.

    stands = stands_at(plot, x, targets)                     # jaxrl_vis_envs.plants.stand: stalks around each arm
    result = reach(stands, targets, jax.random.key(0), wind_mm=10.0)
    result.held                                              # [B, N] bool: stalks that the jaws hold, by contact

Stalks bend and are pushed by the arm; which of them a grasp holds is determined from their contacts with the jaws. Programs are
compiled for 8, 16, 32, ... arms, and reused for fewer.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import jaxrl_vis_envs
from jaxrl_vis.stalks.grasping.arm import control
from jaxrl_vis.stalks.grasping.arm.approach import is_within_reach
from jaxrl_vis.stalks.grasping.arm.control import ControllerState, Gains, Timing
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.plants import bending
from jaxrl_vis_envs.plants.bending import Gusts, Layout, StalkShapes
from jaxrl_vis_envs.plants.stand import Stands
from jaxrl_vis_envs.tasks import stalk_arm

_STEPS_PER_POINT = 5  # physics steps between two points of a path
_POINTS_PER_CALL = 5
POINT_INTERVAL = _STEPS_PER_POINT / control.RATE
"""Time between two points of a path, s."""
LOOK_INTERVAL = _POINTS_PER_CALL * POINT_INTERVAL
"""Time between two calls of the ``observer`` of `reach`, s."""
_MIN_ARMS = 8  # minimum batch size of a compiled program
_CONTACT_DISTANCE = 0.0015  # m, a jaw nearer to a stalk presses on it: soft contacts give way by some tenths of a millimetre


@dataclasses.dataclass(frozen=True)
class ReachResult:
    """Results of B reaches among N stalks each. NumPy arrays; paths have T points, `interval` s apart.

    Attributes:
        held: [B, N] bool, stalks between the closed jaws.
        path: [B, T, 3] float32, planned positions of the grip, m in the plot's frame.
        taken: [B, T, 3] float32, actual positions of the grip, m in the plot's frame.
        arm_contact: [B, N] bool, stalks that upper arm or forearm touched at any time.
        gripper_contact: [B, N] bool, stalks that the open jaws or the palm touched before the jaws began to close.
        reachable: [B] bool, True if the target is within the arm's reach.
        error: [B] float32, distance of the grip from the target when the jaws began to close, m; NaN if out of reach.
        poses: [B, T, J] float32, positions of all joints of the model, for rendering (`video`).
        interval: Time between two points of a path, s.
    """

    held: np.ndarray
    path: np.ndarray
    taken: np.ndarray
    arm_contact: np.ndarray
    gripper_contact: np.ndarray
    reachable: np.ndarray
    error: np.ndarray
    poses: np.ndarray
    interval: float = POINT_INTERVAL


class ArmView(NamedTuple):
    """True state of B reaches at one time, from which an ``observer`` may simulate detections.

    Attributes:
        time: Time since the start, s.
        grip: [B, 3] float32, positions of the grips, m in the plot's frame.
        stalks: [B, N, 3] float32, centres of the stalks at the height of the target, m in the plot's frame; NaN for absent
            ones.
    """

    time: float
    grip: np.ndarray
    stalks: np.ndarray


class Reaching(NamedTuple):
    """State of one arm during a reach.

    Attributes:
        data: State of the physics, an `mjx.Data`.
        controllers: State of the controllers.
        start: [3] float32, position of the grip at time 0, m in the frame of the stand.
        arm_contact, gripper_contact: [N] bool, stalks touched so far; see `ReachResult`.
    """

    data: Any
    controllers: ControllerState
    start: jax.Array
    arm_contact: jax.Array
    gripper_contact: jax.Array


class Scene(NamedTuple):
    """Constants of one arm's reach.

    Attributes:
        stalk_shapes: Shapes of its stalks.
        gusts: Wind.
        side: [] float32, solution of the inverse kinematics, 1 or -1.
    """

    stalk_shapes: StalkShapes
    gusts: Gusts
    side: jax.Array


class ArmModel(NamedTuple):
    """MJX model of an arm among N stalks, with lookup tables.

    Attributes:
        mj_model: Model in MuJoCo.
        model: The same as an `mjx.Model`.
        layout: Indices of the stalks in the model.
        rest: `mjx.Data` of the model at rest.
        contacts: For each geom of the arm by name, [N] indices of its contacts with the stalks' upper segments.
    """

    mj_model: mujoco.MjModel
    model: Any
    layout: Layout
    rest: Any
    contacts: dict[str, np.ndarray]


@functools.cache
def build_arm_model(stalks: int) -> ArmModel:
    """Build the model of an arm among a number of ``stalks``; cached."""
    mj_model = stalk_arm.build(stalks)
    layout = bending.read_layout(mj_model)
    rest = mjx_model.rest_data(mj_model)
    model = mjx_model.put_model(mj_model)
    geoms = np.asarray(jax.jit(mjx.collision)(model, rest)._impl.contact.geom)
    places = {}
    for name in stalk_arm.JAWS + stalk_arm.LINKS:
        pairs = [{mj_model.geom(name).id, int(geom)} for geom in layout.upper_geom]
        places[name] = np.array([next(i for i, geom in enumerate(geoms) if set(geom) == pair) for pair in pairs])
    return ArmModel(mj_model, model, layout, rest, places)


def reach(
    stands: Stands,
    targets: np.ndarray,
    key: jax.Array,
    wind_mm: Any = 0.0,
    timing: Timing | None = None,
    gains: Gains | None = None,
    sides: np.ndarray | None = None,
    observer: Callable[[ArmView], np.ndarray] | None = None,
) -> ReachResult:
    """Simulate reaches: each arm moves to its target and closes its jaws there.

    Args:
        stands: True stalks around each of B arms.
        targets: [B, 3] float32, where the jaws should close, m in the plot's frame.
        key: [] or [B], typed keys for sampling the wind: one for all arms, which is split, or one each, so that an arm's wind
            does not depend on the other arms.
        wind_mm: Amplitude of the stalks' sway (`bending.Gusts.strength`), mm; [] or [B], 0 to 20 in the field.
        timing: Durations of the phases of a reach; None for the default.
        gains: Gains of the controllers; None for the default.
        sides: [B], 1 or -1, solution of the inverse kinematics of each arm (see `approach.clearance`); None for
            `control.better_side`.
        observer: Function called every `LOOK_INTERVAL` s during the reach and while the jaws close, which returns new targets
            [B, 3], m in the plot's frame; those that are NaN or out of reach leave the old one. None for an open loop.

    Returns:
        Results of the reaches. Arms whose target is out of reach are not sent: they hold and touch nothing.

    Raises:
        ValueError: A shape is wrong, a target is not finite, the wind is negative, or a side is neither 1 nor -1.
    """
    timing, gains = timing or Timing(), gains or Gains()
    count, targets = len(stands), np.array(targets, np.float32)
    if targets.shape != (count, 3):
        raise ValueError(f"targets must be [B, 3] for {count} stands, got {list(targets.shape)}")
    if not np.isfinite(targets).all():
        raise ValueError("targets must be finite")
    wind = np.asarray(wind_mm, np.float32)
    if wind.shape not in ((), (count,)) or not (wind >= 0).all():
        raise ValueError(f"wind_mm must be at least 0, one number or one for each of {count} arms, got {wind_mm}")
    can = is_within_reach(stands.origin, targets)
    targets = np.where(can[:, None], targets, stands.origin + np.array(control.HOME, np.float32))
    side = np.asarray(control.better_side(targets - stands.origin, np) if sides is None else sides, np.float32)
    if side.shape != (count,) or not (np.abs(side) == 1).all():
        raise ValueError(f"sides must be 1 or -1 for each of {count} arms")
    if key.shape not in ((), (count,)):
        raise ValueError(f"there must be one key, or one for each of {count} arms, got {list(key.shape)}")
    if not count:
        return _empty_result(stands, timing)
    # Pad the batch to the size of the program with copies of the first arm.
    fill = np.concatenate([np.arange(count), np.zeros(max(_MIN_ARMS, 1 << (count - 1).bit_length()) - count, int)])
    start, advance = _compile_programs(stands.stalk.shape[1], timing, gains)
    stalk_shapes = jax.tree.map(lambda part: part[fill], bending.shapes(stands))
    winds = np.broadcast_to(wind / 1000, (count,))[fill]
    keys = key[fill] if key.shape else jax.random.split(key, len(fill))
    scene, reaching = start(stalk_shapes, keys, winds, side[fill])
    parts, aimed_at = [], targets
    for call in range(_count_calls(timing.reach) + _count_calls(timing.close)):
        if observer is not None and call:
            targets = _observe_targets(observer, stands, targets, can, call * LOOK_INTERVAL, parts[-1])
        if call < _count_calls(timing.reach):
            aimed_at = targets
        reaching, report = advance(scene, reaching, (targets - stands.origin)[fill])
        parts.append(jax.tree.map(lambda part: np.asarray(part)[:count], report))
    paths = {name: np.concatenate([part[name] for part in parts], axis=1) for name in ("path", "taken", "poses")}
    closing = parts[_count_calls(timing.reach) - 1]
    error = np.linalg.norm(closing["taken"][:, -1] - (aimed_at - stands.origin), axis=-1)
    mine = can[:, None] & stands.is_present
    return ReachResult(
        held=parts[-1]["held"] & mine,
        path=paths["path"] + stands.origin[:, None],
        taken=paths["taken"] + stands.origin[:, None],
        arm_contact=parts[-1]["arm_contact"] & mine,
        gripper_contact=parts[-1]["gripper_contact"] & mine,
        reachable=can,
        error=np.where(can, error, np.nan).astype(np.float32),
        poses=paths["poses"],
    )


def _observe_targets(
    observer: Callable[[ArmView], np.ndarray],
    stands: Stands,
    targets: np.ndarray,
    is_reachable: np.ndarray,
    time: float,
    report: dict,
) -> np.ndarray:
    """Return the targets [B, 3] after a call of the observer, unchanged where its target is not finite or out of reach.

    Args:
        observer: See `reach`.
        stands: True stalks around each of B arms.
        targets: [B, 3] float32, present targets, m in the plot's frame.
        is_reachable: [B] bool, arms whose first target was within reach; the targets of the others are unchanged.
        time: Time since the start, s.
        report: Last report of `_advance`, batched.

    Raises:
        ValueError: The observer returns targets of another shape.
    """
    places = np.where(stands.is_present[..., None], report["stalks"], np.nan) + stands.origin[:, None]
    updated = np.asarray(observer(ArmView(time, report["taken"][:, -1] + stands.origin, places)), np.float32)
    if updated.shape != targets.shape:
        raise ValueError(f"a look must return targets {list(targets.shape)}, got {list(updated.shape)}")
    there = np.all(np.isfinite(updated), axis=-1)
    there &= is_reachable & is_within_reach(stands.origin, np.where(there[:, None], updated, 0.0))
    return np.where(there[:, None], updated, targets)


def _count_calls(seconds: float) -> int:
    return max(round(seconds / LOOK_INTERVAL), 1)


def _empty_result(stands: Stands, timing: Timing) -> ReachResult:
    """Return the result of no reaches: arrays with B = 0."""
    points, stalks = _POINTS_PER_CALL * (_count_calls(timing.reach) + _count_calls(timing.close)), stands.stalk.shape[1]
    none, path = np.zeros((0, stalks), bool), np.zeros((0, points, 3), np.float32)
    poses = np.zeros((0, points, build_arm_model(stalks).mj_model.nq), np.float32)
    return ReachResult(none, path, path, none, none, np.zeros(0, bool), np.zeros(0, np.float32), poses)


@functools.cache
def _compile_programs(stalks: int, timing: Timing, gains: Gains) -> tuple[Any, Any]:
    """Return the compiled programs that start B arms and advance them by `LOOK_INTERVAL` s."""
    arms = build_arm_model(stalks)

    def start(stalk_shapes: StalkShapes, key: jax.Array, wind: jax.Array, side: jax.Array) -> tuple[Scene, Reaching]:
        scene = Scene(jax.tree.map(jnp.asarray, stalk_shapes), bending.sample_gusts(key, wind), side)
        return scene, begin(arms, scene)

    def advance(scene: Scene, reaching: Reaching, target: jax.Array) -> tuple[Reaching, dict[str, jax.Array]]:
        return _advance(arms, scene, reaching, target, timing, gains)

    return jaxrl_vis_envs.jit(jax.vmap(start), runs_once=True), jaxrl_vis_envs.jit(jax.vmap(advance))


def begin(arms: ArmModel, scene: Scene, home: tuple[float, float, float] = control.HOME) -> Reaching:
    """Return the initial state of an arm with its grip at ``home`` (m, frame of the stand) among swaying stalks."""
    model = bending.set_stalk_properties(arms.model, arms.layout, scene.stalk_shapes)
    data = bending.place_stands(arms.rest, arms.layout, scene.stalk_shapes)
    swayed = bending.hinge_angles(arms.layout, model.nv, bending.displacement(scene.gusts, scene.stalk_shapes.foot, 0.0))
    joints = stalk_arm.joints_at(jnp.asarray(home, jnp.float32), scene.side)
    data = mjx_model.kinematics(model, data.replace(qpos=(data.qpos + swayed).at[: stalk_arm.ARM_JOINTS].set(joints)))
    nothing = jnp.zeros(len(arms.layout.mocap), bool)
    return Reaching(data, control.init_controllers(joints), stalk_arm.grip_at(joints), nothing, nothing)


def _advance(
    arms: ArmModel, scene: Scene, reaching: Reaching, target: jax.Array, timing: Timing, gains: Gains
) -> tuple[Reaching, dict[str, jax.Array]]:
    """Advance a reach to ``target`` [3] (m, frame of the stand) by `LOOK_INTERVAL` s.

    Returns:
        The new state, and a report: path, actual positions and poses at each point, held and touched stalks, and the positions
        of the stalks at the target's height.
    """
    model = bending.set_stalk_properties(arms.model, arms.layout, scene.stalk_shapes)

    def step(reaching: Reaching, _: None) -> tuple[Reaching, None]:
        time = reaching.data.time
        wanted = control.plan_movement(target, reaching.start, time + 1.0 / control.RATE, timing)
        return step_control(arms, model, scene, reaching, wanted, time > timing.reach - 0.5 / control.RATE, gains), None

    def point(reaching: Reaching, _: None) -> tuple[Reaching, dict[str, jax.Array]]:
        reaching = jax.lax.scan(step, reaching, length=_STEPS_PER_POINT)[0]
        data = reaching.data
        path = control.plan_movement(target, reaching.start, data.time, timing)
        return reaching, {"path": path, "taken": stalk_arm.grip_at(data.qpos[:3]), "poses": data.qpos}

    with jax.default_matmul_precision("highest"):
        reaching, report = jax.lax.scan(point, reaching, length=_POINTS_PER_CALL)
    data = mjx_model.kinematics(model, reaching.data)
    report |= {
        "held": held_stalks(arms, data),
        "arm_contact": reaching.arm_contact,
        "gripper_contact": reaching.gripper_contact,
        "stalks": bending.at_height(data, arms.layout, target[2]),
    }
    return reaching._replace(data=data), report


def step_control(
    arms: ArmModel, model: Any, scene: Scene, reaching: Reaching, target: jax.Array, is_closing: jax.Array, gains: Gains
) -> Reaching:
    """Advance controllers and physics by one control period.

    Args:
        arms: Model with its lookup tables.
        model: Model with the stalks of the scene (`bending.set_stalk_properties`).
        scene: Constants of the reach.
        reaching: State of the arm.
        target: [3], setpoint of the grip, m in the frame of the stand.
        is_closing: [] bool, True to close the jaws, False to open them.
        gains: Gains of the controllers.

    Returns:
        The new state of the arm; positions of bodies and geoms in its physics are stale until `mjx_model.kinematics`.
    """
    data = reaching.data
    memory, forces = control.step_controllers(
        reaching.controllers, data.qpos[:3], data.qvel[:3], stalk_arm.joints_at(target, scene.side), gains
    )
    jaws = jnp.where(is_closing, gains.jaw_force, -gains.jaw_force) * jnp.ones(2, jnp.float32)
    wind = bending.wind_torque(model, arms.layout, scene.gusts, scene.stalk_shapes.foot, data.time)
    none = jnp.zeros(model.nv - stalk_arm.JOINTS, jnp.float32)
    data = mjx_model.step(model, data.replace(qfrc_applied=wind + jnp.concatenate([forces, jaws, none])), False)
    touches = {name: data._impl.contact.dist[places] < 0 for name, places in arms.contacts.items()}
    arm_contact = reaching.arm_contact | touches["forearm"] | touches["upper_arm"]
    by_gripper = touches["left_jaw"] | touches["right_jaw"] | touches["palm"]
    return Reaching(data, memory, reaching.start, arm_contact, reaching.gripper_contact | (by_gripper & ~is_closing))


def held_stalks(arms: ArmModel, data: Any) -> jax.Array:
    """Return True for stalks that the jaws hold, [N] bool: those between the jaws on which at least one jaw presses."""
    across, along = stalk_arm.grip_frame(data.qpos[:3])
    grip = stalk_arm.grip_at(data.qpos[:3])
    places = (bending.at_height(data, arms.layout, grip[2]) - grip)[:, :2]
    aside, ahead = places @ across, places @ along
    open_at = stalk_arm.OPENING / 2 + stalk_arm.JAW_RADIUS
    is_between = (aside > data.qpos[3] - open_at) & (aside < open_at - data.qpos[4])
    is_between &= (ahead > stalk_arm.PALM) & (ahead < stalk_arm.TIPS)
    distance = data._impl.contact.dist
    pressed = jnp.stack([distance[arms.contacts[name]] < _CONTACT_DISTANCE for name in stalk_arm.JAWS]).any(axis=0)
    return is_between & pressed
