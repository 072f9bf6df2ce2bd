"""Many arms that reach for stalks at once: physics, contacts and wind in one compiled program.

    stands = stands_at(plot, x, targets)                     # jaxrl_vis_envs.plants.stand: the stalks around each arm
    result = reach(stands, targets, jax.random.key(0), wind_mm=10.0)
    result.held                                              # [B, N] bool: which stalks the jaws hold, by contact

What a grasp holds comes of the contacts of the jaws with the stalks, which bend and are pushed; no rule decides it.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis.grasping import arm
from jaxrl_vis.grasping.arm import Drive, Gains, Timing
from jaxrl_vis_envs.compilation import env_jit
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.plants import bending
from jaxrl_vis_envs.plants.bending import Gusts, Layout, Shape
from jaxrl_vis_envs.plants.stand import Stands
from jaxrl_vis_envs.tasks import stalk_arm

_STEPS_A_POINT = 5  # physics steps between two points of a path
_TOUCH = 0.0015  # m, a jaw this near to a stalk holds it: soft contacts give way by some tenths of a millimetre


@dataclasses.dataclass(frozen=True)
class ReachResult:
    """What came of B reaches among N stalks each. NumPy arrays; paths have T points, `interval` s apart.

    Attributes:
        held: [B, N] bool, stalks between the closed jaws.
        path: [B, T, 3] float32, where the grip should have been, m in the plot's frame.
        taken: [B, T, 3] float32, where it was.
        touched: [B, N] bool, stalks that links other than the jaws touched; the palm may touch what is held.
        brushed: [B, N] bool, stalks that the open jaws touched on the way.
        reachable: [B] bool, whether the arm's geometry lets the grip be at the target.
        error: [B] float32, distance of the grip from the target when the jaws began to close, m.
        interval: Time between two points of a path, s.
    """

    held: np.ndarray
    path: np.ndarray
    taken: np.ndarray
    touched: np.ndarray
    brushed: np.ndarray
    reachable: np.ndarray
    error: np.ndarray
    interval: float


class Reaching(NamedTuple):
    """One arm on its way.

    Attributes:
        data: The physics.
        drive: What the controllers remember.
        start: [3] float32, where the grip was at time 0, m in the frame of the stand.
        touched, brushed: [N] bool, so far.
    """

    data: Any
    drive: Drive
    start: jax.Array
    touched: jax.Array
    brushed: jax.Array


class _Arms(NamedTuple):
    """The model of an arm among N stalks, and where things are in it."""

    mj_model: mujoco.MjModel
    model: Any
    layout: Layout
    home: Any
    contacts: dict[str, np.ndarray]  # geom of the arm -> the contacts with stalks, in their order


@functools.cache
def _arms(stalks: int) -> _Arms:
    mj_model = stalk_arm.build(stalks, motors=False)
    layout = bending.layout_of(mj_model)
    home = mjx_model.still_data(mj_model)
    model = mjx.put_model(mj_model)
    geoms = np.asarray(mjx.collision(model, home)._impl.contact.geom)
    places = {}
    for name in stalk_arm.JAWS + stalk_arm.LINKS:
        pairs = [{mj_model.geom(name).id, int(geom)} for geom in layout.upper_geom]
        places[name] = np.array([next(i for i, geom in enumerate(geoms) if set(geom) == pair) for pair in pairs])
    return _Arms(mj_model, model, layout, home, places)


def reach(
    stands: Stands,
    targets: np.ndarray,
    key: jax.Array,
    wind_mm: Any = 0.0,
    timing: Timing | None = None,
    gains: Gains | None = None,
    sides: np.ndarray | None = None,
) -> ReachResult:
    """Sends each arm to its target, without looking again on the way, and closes its jaws there.

    Args:
        stands: The stalks around each of B arms.
        targets: [B, 3] float32, where the jaws should close, m in the plot's frame.
        key: [], typed: the wind.
        wind_mm: Greatest sway of stalks one metre above the ground, mm; [] or [B], 0 to 20 in the field.
        timing: How long the parts of a reach take.
        gains: Of the controllers.
        sides: [B], 1 or -1: which of the two solutions each arm takes (see `arm.room`). None for `arm.better_side`.

    Returns:
        What came of it. Arms whose target cannot be reached are not sent: they hold and touch nothing.

    Raises:
        ValueError: Shapes differ, a target is not finite, or the wind is negative.
    """
    timing, gains = timing or Timing(), gains or Gains()
    targets = np.asarray(targets, np.float32)
    wind = np.broadcast_to(np.asarray(wind_mm, np.float32), len(stands))
    if targets.shape != (len(stands), 3):
        raise ValueError(f"targets must be [B, 3] for {len(stands)} stands, got {list(targets.shape)}")
    if not np.isfinite(targets).all():
        raise ValueError("targets must be finite")
    if not (wind >= 0).all():
        raise ValueError(f"wind_mm must be at least 0, got {wind.min():g}")
    can = arm.reachable(stands.origin, targets)
    local = np.where(can[:, None], targets - stands.origin, np.array(arm.HOME, np.float32)).astype(np.float32)
    sides = arm.better_side(local, np) if sides is None else np.asarray(sides)
    if sides.shape != wind.shape or not (np.abs(sides) == 1).all():
        raise ValueError(f"sides must be 1 or -1 for each of {len(stands)} arms")
    run = _whole_reach(stands.stalk.shape[1], timing, gains)
    keys = jax.random.split(key, len(stands))
    found = jax.tree.map(np.asarray, run(bending.shapes(stands), local, keys, wind / 1000, sides.astype(np.float32)))
    mine = can[:, None] & stands.present
    return ReachResult(
        held=found["held"] & mine,
        path=found["path"] + stands.origin[:, None],
        taken=found["taken"] + stands.origin[:, None],
        touched=found["touched"] & mine,
        brushed=found["brushed"] & mine,
        reachable=can,
        error=np.where(can, found["error"], np.nan).astype(np.float32),
        interval=_STEPS_A_POINT / arm.RATE,
    )


@functools.cache
def _whole_reach(stalks: int, timing: Timing, gains: Gains) -> Any:
    """The compiled program of B reaches."""
    arms = _arms(stalks)

    def one(shape: Shape, target: jax.Array, key: jax.Array, wind: jax.Array, side: jax.Array) -> dict[str, jax.Array]:
        model = bending.fit(arms.model, arms.layout, shape)
        gusts = bending.gusts(key, wind)
        reaching = _begin(arms, model, shape, gusts, side)
        reaching, path, taken = _go(
            arms, model, shape, gusts, reaching, target, side, timing, gains, timing.reach, closing=False
        )
        error = jnp.linalg.norm(reaching.data.site_xpos[0] - target)
        reaching, rest, rest_taken = _go(
            arms, model, shape, gusts, reaching, target, side, timing, gains, timing.close, closing=True
        )
        return {
            "held": _held(arms, reaching.data),
            "path": jnp.concatenate([path, rest]),
            "taken": jnp.concatenate([taken, rest_taken]),
            "touched": reaching.touched,
            "brushed": reaching.brushed,
            "error": error,
        }

    return env_jit(jax.vmap(one))


def _begin(arms: _Arms, model: Any, shape: Shape, gusts: Gusts, side: jax.Array) -> Reaching:
    """An arm at home, its elbow to one ``side``, among swaying stalks."""
    data = bending.placed(arms.home, arms.layout, shape)
    swayed = bending.hinge_angles(arms.layout, model.nv, bending.displacement(gusts, jnp.asarray(shape.foot), 0.0))
    joints = stalk_arm.joints_at(jnp.asarray(arm.HOME, jnp.float32), side)
    data = mjx_model.kinematics(model, data.replace(qpos=(data.qpos + swayed).at[: stalk_arm.ARM_JOINTS].set(joints)))
    nothing = jnp.zeros(len(arms.layout.mocap), bool)
    return Reaching(data, arm.start_drive(data.qpos[:3]), data.site_xpos[0], nothing, nothing)


def _go(
    arms: _Arms,
    model: Any,
    shape: Shape,
    gusts: Gusts,
    reaching: Reaching,
    target: jax.Array,
    side: jax.Array,
    timing: Timing,
    gains: Gains,
    seconds: float,
    closing: bool,
) -> tuple[Reaching, jax.Array, jax.Array]:
    """Some seconds of a reach: the arm then, and the planned and taken paths of the grip [T, 3] (m, frame of the stand)."""
    foot = jnp.asarray(shape.foot)
    none = jnp.zeros(model.nv - stalk_arm.JOINTS, jnp.float32)
    jaws = jnp.full(2, gains.jaw_force if closing else -gains.jaw_force, jnp.float32)

    def step(reaching: Reaching, _: None) -> tuple[Reaching, None]:
        data = reaching.data
        point = arm.planned(target, reaching.start, data.time + 1.0 / arm.RATE, timing)
        wanted = stalk_arm.joints_at(point, side)
        memory, forces = arm.drive(reaching.drive, data.qpos[:3], data.qvel[:3], wanted, gains)
        wind = bending.wind_torque(model, arms.layout, gusts, foot, data.time)
        data = mjx_model.step(model, data.replace(qfrc_applied=wind + jnp.concatenate([forces, jaws, none])), False)
        distance = {name: data._impl.contact.dist[places] for name, places in arms.contacts.items()}
        touches = {name: each < 0 for name, each in distance.items()}
        touched = reaching.touched | touches["forearm"] | touches["upper_arm"]
        brushed = reaching.brushed
        if not closing:
            brushed |= touches["left_jaw"] | touches["right_jaw"] | touches["palm"]
        return Reaching(data, memory, reaching.start, touched, brushed), None

    def point(reaching: Reaching, _: None) -> tuple[Reaching, tuple[jax.Array, jax.Array]]:
        reaching = jax.lax.scan(step, reaching, length=_STEPS_A_POINT)[0]
        data = reaching.data
        return reaching, (arm.planned(target, reaching.start, data.time, timing), stalk_arm.grip_at(data.qpos[:3]))

    points = round(seconds * arm.RATE / _STEPS_A_POINT)
    with jax.default_matmul_precision("highest"):
        reaching, (path, taken) = jax.lax.scan(point, reaching, length=points)
    return reaching._replace(data=mjx_model.kinematics(model, reaching.data)), path, taken


def _held(arms: _Arms, data: Any) -> jax.Array:
    """Which stalks the closed jaws hold: [N] bool. They are between the jaws, and at least one of these presses on them."""
    across, along = stalk_arm.grip_frame(data.qpos[:3])
    grip = data.site_xpos[0]
    places = (bending.at_height(data, arms.layout, grip[2]) - grip)[:, :2]
    aside, ahead = places @ across, places @ along
    left, right = (-stalk_arm.OPENING / 2 - stalk_arm.JAW_RADIUS + data.qpos[3], None)
    right = stalk_arm.OPENING / 2 + stalk_arm.JAW_RADIUS - data.qpos[4]
    between = (aside > left) & (aside < right) & (ahead > stalk_arm.PALM) & (ahead < stalk_arm.TIPS)
    contact = data._impl.contact.dist
    pressed = jnp.minimum(contact[arms.contacts["left_jaw"]], contact[arms.contacts["right_jaw"]]) < _TOUCH
    return between & pressed
