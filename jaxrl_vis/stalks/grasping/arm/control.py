"""Planned path of the arm to a stalk, and its controllers: PID for the elastic joints, PI for the slide.

A reach takes two seconds until the jaws close. While the slide moves to the height of the target, the folded arm turns towards
it. Then the grip moves along the straight line through the first joint and the target, until the stalk is between the jaws.
Both solutions of the inverse kinematics move the grip along the same line; they differ in the pose of the forearm.

Source: section 4.2.2 of the thesis, whose gains were tuned by hand and are not stated; those here are tuned by hand, too.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis_envs.tasks import stalk_arm

RATE = 250.0
"""Frequency of the controllers, Hz."""
FOLDED = 0.34
"""Distance of the grip from the first joint before it moves outwards, m."""
HOME = (0.0, stalk_arm.SHOULDER[1] + FOLDED, 0.85)
"""Home position of the grip, m in the frame of a stand."""


@dataclasses.dataclass(frozen=True)
class Timing:
    """Durations of the phases of a reach, s."""

    turn: float = 0.8
    """Movement of the slide and turn of the folded arm."""
    extend: float = 1.0
    """Movement of the grip outwards along the line."""
    settle: float = 0.2
    """Settling of the controllers at the target."""
    close: float = 0.4
    """Closing of the jaws."""

    @property
    def reach(self) -> float:
        """Duration until the jaws begin to close, s."""
        return self.turn + self.extend + self.settle


class Gains(NamedTuple):
    """Gains and limits of the controllers, in SI units; see `step_controllers`.

    Attributes:
        proportional, integral, derivative: Gains of the PID controllers, [2] for shoulder and elbow.
        spring: Stiffness of the elastic part of a joint, [2].
        torque: Maximum torque, [2].
        motor: Inverse time constant of the motors.
        slide_proportional, slide_integral: Gains from the slide's position error to its speed.
        slide_speed: Maximum speed of the slide.
        slide_drive: Force on the slide per error of its speed.
        jaw_force: Force that closes, or opens, each jaw.
    """

    proportional: Any = (260.0, 130.0)  # N m/rad
    integral: Any = (600.0, 300.0)  # N m/(rad s)
    derivative: Any = (18.0, 7.0)  # N m s/rad
    spring: Any = (180.0, 90.0)  # N m/rad, the elastic part of a joint
    torque: Any = (30.0, 15.0)  # N m, maximum
    motor: float = 120.0  # 1/s, inverse time constant of a motor
    slide_proportional: float = 25.0  # 1/s
    slide_integral: float = 4.0  # 1/s^2
    slide_speed: float = 1.0  # m/s, maximum
    slide_drive: float = 400.0  # N s/m
    jaw_force: float = 10.0  # N


class ControllerState(NamedTuple):
    """State of the controllers.

    Attributes:
        integral: [3] float32, integrated errors of slide, shoulder and elbow, m s and rad s, clipped to -0.05 to 0.05.
        motor: [2] float32, angles of the motors behind the springs of shoulder and elbow, rad.
        error: [2] float32, last errors of shoulder and elbow, rad.
    """

    integral: jax.Array
    motor: jax.Array
    error: jax.Array


def minimum_jerk(fraction: Any) -> Any:
    """Return the fraction of a minimum-jerk movement that is completed after a ``fraction`` of its time, clipped to 0 to 1."""
    fraction = jnp.clip(fraction, 0.0, 1.0)
    return fraction**3 * (10.0 - 15.0 * fraction + 6.0 * fraction**2)


def better_side(target: Any, numeric: Any = jnp) -> Any:
    """Return the solution, 1. or -1., whose forearm points more squarely at the row: [...].

    Args:
        target: [..., 3], m in the frame of a stand.
        numeric: Module to compute with, `jax.numpy` or `numpy`.
    """
    return numeric.where(target[..., 0] > stalk_arm.SHOULDER[0], 1.0, -1.0)


def plan_movement(target: jax.Array, start: jax.Array, time: Any, timing: Timing) -> jax.Array:
    """Return the planned position [3] of the grip at a time, on its path from ``start`` to ``target``, m.

    Args:
        target: [3], m in the frame of a stand.
        start: [3], position of the grip at time 0, m in the same frame.
        time: [], time since the start, s.
        timing: Durations of the phases of the reach.
    """
    shoulder = jnp.asarray(stalk_arm.SHOULDER, jnp.float32)
    turned = minimum_jerk(time / timing.turn)
    extended = minimum_jerk((time - timing.turn) / timing.extend)
    bearings = [jnp.arctan2(-(place - shoulder)[0], (place - shoulder)[1]) for place in (start[:2], target[:2])]
    radii = [jnp.linalg.norm(place - shoulder) for place in (start[:2], target[:2])]
    bearing = bearings[0] + turned * (bearings[1] - bearings[0])
    folded_radius = radii[0] + turned * (FOLDED - radii[0])
    radius = folded_radius + extended * (radii[1] - FOLDED)
    height = start[2] + turned * (target[2] - start[2])
    return jnp.stack([shoulder[0] - radius * jnp.sin(bearing), shoulder[1] + radius * jnp.cos(bearing), height])


def init_controllers(joints: jax.Array) -> ControllerState:
    """Return the initial state of the controllers for an arm at rest at ``joints`` [3]: slide, shoulder, elbow (m, rad)."""
    return ControllerState(jnp.zeros(3, jnp.float32), joints[1:3], jnp.zeros(2, jnp.float32))


def step_controllers(
    state: ControllerState, joints: jax.Array, velocity: jax.Array, targets: jax.Array, gains: Gains
) -> tuple[ControllerState, jax.Array]:
    """Advance the controllers by one period.

    Args:
        state: State of the controllers.
        joints: [3], positions of slide, shoulder and elbow, m and rad.
        velocity: [3], their velocities, m/s and rad/s.
        targets: [3], their setpoints, m and rad.
        gains: Gains of the controllers.

    Returns:
        The new state, and the generalised forces [3] float32 on slide, shoulder and elbow, N and N m.
    """
    period = 1.0 / RATE
    error = targets - joints
    integral = jnp.clip(state.integral + period * error, -0.05, 0.05)
    parts = [jnp.asarray(part, jnp.float32) for part in gains[:5]]
    proportional, integrating, derivative, spring, max_torque = parts
    slope = (error[1:] - state.error) / period
    wish = jnp.clip(proportional * error[1:] + integrating * integral[1:] + derivative * slope, -max_torque, max_torque)
    # Series elastic actuators: torque is the deflection of the spring between motor and joint.
    motor = state.motor + period * gains.motor * (joints[1:] + wish / spring - state.motor)
    torque = jnp.clip(spring * (motor - joints[1:]), -max_torque, max_torque)
    speed = gains.slide_proportional * error[0] + gains.slide_integral * integral[0]
    force = gains.slide_drive * (jnp.clip(speed, -gains.slide_speed, gains.slide_speed) - velocity[0])
    return ControllerState(integral, motor, error[1:]), jnp.concatenate([force[None], torque])
