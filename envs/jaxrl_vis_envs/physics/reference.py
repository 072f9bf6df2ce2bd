"""How hard a constraint is, and what acceleration it asks for: MuJoCo's ``solref`` and ``solimp``, for constants of a model.

Source: MuJoCo's documentation, "Modeling", solver parameters.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.physics.folding import minus, plus, times


class Reference(NamedTuple):
    """The constants of one constraint.

    Attributes:
        stiffness: 1/s^2, of the spring whose accelerations the constraint asks for.
        damping: 1/s, of that spring.
        least, most: The impedance of a constraint that is just met, and of one that is violated by ``width``.
        width: m or rad.
        middle: Where between the two, as a share of the width, the curve has its point of inflection.
        power: Of the curve.
    """

    stiffness: float
    damping: float
    least: float
    most: float
    width: float
    middle: float
    power: float

    def impedance(self, violation: Any) -> Any:
        """The share of the acceleration that the constraint takes upon itself, where it is violated by so much (m or rad)."""
        if self.least == self.most or isinstance(violation, float):
            return self._known_impedance(abs(violation) if isinstance(violation, float) else 0.0)
        share = jnp.minimum(jnp.abs(violation) * (1.0 / self.width), 1.0)
        if self.power > 1:
            power = int(self.power)
            below = times(*[share] * power, self.middle ** (1 - power))
            rest = 1.0 - share
            above = minus(1.0, times(*[rest] * power, (1.0 - self.middle) ** (1 - power)))
            share = jnp.where(share < self.middle, below, above)
        return plus(self.least, times(share, self.most - self.least))

    def _known_impedance(self, violation: float) -> float:
        share = min(violation / self.width, 1.0)
        if share < self.middle:
            share = share**self.power * self.middle ** (1 - self.power)
        else:
            share = 1.0 - (1.0 - share) ** self.power * (1.0 - self.middle) ** (1 - self.power)
        return self.least + share * (self.most - self.least)

    def softness(self, inverse_weight: float, impedance: Any) -> Any:
        """What MuJoCo calls ``efc_D``: how hard the constraint is, 1 over the part of its inverse inertia that gives way."""
        if isinstance(impedance, float):
            return 1.0 / max(inverse_weight * (1.0 - impedance) / impedance, mujoco.mjMINVAL)
        return impedance / minus(inverse_weight, times(impedance, inverse_weight))


def reference_of(solref: np.ndarray, solimp: np.ndarray, timestep: float, is_safe: bool) -> Reference:
    """The constants of a constraint of a model.

    Args:
        solref: [2] float, time constant (s) and damping ratio, or negative stiffness and damping.
        solimp: [5] float.
        timestep: s.
        is_safe: Whether the time constant is at least two steps (the model does not disable that).
    """
    time, ratio = (float(number) for number in solref)
    least, most, width, middle, power = (float(number) for number in solimp)
    least, most, middle = (float(np.clip(each, mujoco.mjMINIMP, mujoco.mjMAXIMP)) for each in (least, most, middle))
    if is_safe:
        time_used = max(time, 2.0 * timestep)
    else:
        time_used = time
    stiffness = -time / most**2 if time <= 0 else 1.0 / (most * time_used * ratio) ** 2
    damping = -ratio / most if ratio <= 0 else 2.0 / (most * time_used)
    return Reference(stiffness, damping, least, most, max(mujoco.mjMINVAL, width), middle, max(1.0, power))
