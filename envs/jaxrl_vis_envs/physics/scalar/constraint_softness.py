"""Softness of constraints in scalars: MuJoCo's ``solref`` and ``solimp``, for constants of a model.

Source: MuJoCo's documentation, "Modeling", solver parameters.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.physics.scalar.partial_arithmetic import minus, plus, times


class Softness(NamedTuple):
    """Constants of one constraint: its reference spring and its impedance curve.

    Attributes:
        stiffness: Stiffness of the spring that gives the reference acceleration, 1/s^2.
        damping: Damping of that spring, 1/s.
        min_impedance: Impedance without violation.
        max_impedance: Impedance at a violation of ``width``.
        width: Violation at which the impedance saturates, m or rad.
        midpoint: Inflection point of the curve, as a fraction of the width.
        power: Exponent of the curve.
    """

    stiffness: float
    damping: float
    min_impedance: float
    max_impedance: float
    width: float
    midpoint: float
    power: float

    def impedance(self, violation: Any) -> Any:
        """Return the constraint's impedance, in (0, 1), at a violation (m or rad) of either sign."""
        if self.min_impedance == self.max_impedance or isinstance(violation, float):
            return self._known_impedance(abs(violation) if isinstance(violation, float) else 0.0)
        fraction = jnp.minimum(jnp.abs(violation) * (1.0 / self.width), 1.0)
        if self.power > 1:
            power = int(self.power)
            below = times(*[fraction] * power, self.midpoint ** (1 - power))
            rest = 1.0 - fraction
            above = minus(1.0, times(*[rest] * power, (1.0 - self.midpoint) ** (1 - power)))
            fraction = jnp.where(fraction < self.midpoint, below, above)
        return plus(self.min_impedance, times(fraction, self.max_impedance - self.min_impedance))

    def _known_impedance(self, violation: float) -> float:
        fraction = min(violation / self.width, 1.0)
        if fraction < self.midpoint:
            fraction = fraction**self.power * self.midpoint ** (1 - self.power)
        else:
            fraction = 1.0 - (1.0 - fraction) ** self.power * (1.0 - self.midpoint) ** (1 - self.power)
        return self.min_impedance + fraction * (self.max_impedance - self.min_impedance)

    def row_stiffness(self, inverse_weight: float, impedance: Any) -> Any:
        """Return MuJoCo's ``efc_D``: the inverse of the regularization ``inverse_weight * (1 - impedance) / impedance``.

        Args:
            inverse_weight: Approximate inverse inertia along the constraint.
            impedance: Value of `impedance`.
        """
        if isinstance(impedance, float):
            return 1.0 / max(inverse_weight * (1.0 - impedance) / impedance, mujoco.mjMINVAL)
        return impedance / minus(inverse_weight, times(impedance, inverse_weight))


def make_softness(solref: np.ndarray, solimp: np.ndarray, timestep: float, is_safe: bool) -> Softness:
    """Compute the constants of a constraint.

    Args:
        solref: [2] float, time constant (s) and damping ratio, or negative stiffness and damping.
        solimp: [5] float, minimum and maximum impedance, width (m or rad), midpoint and power (see `Softness`).
        timestep: Physics time step, s.
        is_safe: Keep the time constant at two time steps or more (MuJoCo's ``refsafe``).
    """
    time, ratio = (float(number) for number in solref)
    low, high, width, midpoint, power = (float(number) for number in solimp)
    low, high, midpoint = (float(np.clip(value, mujoco.mjMINIMP, mujoco.mjMAXIMP)) for value in (low, high, midpoint))
    safe_time = max(time, 2.0 * timestep) if is_safe else time
    stiffness = -time / high**2 if time <= 0 else 1.0 / (high * safe_time * ratio) ** 2
    damping = -ratio / high if ratio <= 0 else 2.0 / (high * safe_time)
    return Softness(stiffness, damping, low, high, max(mujoco.mjMINVAL, width), midpoint, max(1.0, power))
