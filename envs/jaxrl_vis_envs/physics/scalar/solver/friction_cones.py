"""Elliptic friction cones in scalars: contact zones, forces and second derivatives of a contact's cost.

Source: MuJoCo's documentation, "Computation", constraint model.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxrl_vis_envs.physics.scalar.sparse_algebra import TINY, Column, Matrix, safe_divide, total


class Cone(NamedTuple):
    """Residuals of a contact relative to its elliptic cone.

    Attributes:
        scales: Factors of the rows that make the cone circular.
        scaled: Scaled residuals of the rows.
        normal: First scaled residual.
        tangent: Norm of the other scaled residuals.
        friction: Friction coefficient of the circular cone.
        stiffness: Stiffness in the middle zone, between the cone and its dual; 0 elsewhere.
        is_stuck: True in the bottom zone, where all rows act like equalities.
    """

    scales: Column
    scaled: Column
    normal: Any
    tangent: Any
    friction: Any
    stiffness: Any
    is_stuck: Any

    def curvature(self) -> Matrix:
        """Return second derivatives of the middle zone's cost with respect to the rows' residuals; 0 in the other zones.

        The caller adds the stiffness of the bottom zone.
        """
        friction, safe = self.friction, jnp.maximum(self.tangent, TINY)
        gap = self.normal - friction * self.tangent
        units = [part / safe for part in self.scaled[1:]]
        bend = friction * gap / safe
        size = len(self.scaled)
        matrix: Matrix = {}
        first = self.stiffness * self.scales[0]
        matrix[0, 0] = first * self.scales[0]
        for row in range(1, size):
            outer = self.stiffness * self.scales[row]
            matrix[row, 0] = matrix[0, row] = -friction * units[row - 1] * first * self.scales[row]
            for column in range(1, size):
                # Of (normal - friction * tangent)^2 / 2: the square of its gradient, and the gradient's own derivative.
                turn = (1.0 if row == column else 0.0) - units[row - 1] * units[column - 1]
                value = friction * friction * units[row - 1] * units[column - 1] - bend * turn
                matrix[row, column] = outer * self.scales[column] * value
        return matrix

    def forces(self) -> Column:
        """Return the forces of the rows; 0 outside the middle zone."""
        pull = self.stiffness * (self.normal - self.friction * self.tangent)
        safe = jnp.maximum(self.tangent, TINY)
        across = zip(self.scaled[1:], self.scales[1:], strict=True)
        return [-pull * self.scales[0], *(pull * self.friction * (part / safe) * scale for part, scale in across)]

    def slope_along(self, direction: Column) -> tuple[Any, Any]:
        """Return the cost's slope and curvature along a direction of the residuals; valid where the contact is not stuck."""
        turned = [part * scale for part, scale in zip(direction, self.scales, strict=True)]
        safe = jnp.maximum(self.tangent, TINY)
        change = total(u * v for u, v in zip(self.scaled[1:], turned[1:], strict=True)) / safe
        bend = (total(v * v for v in turned[1:]) - change * change) / safe
        gap, opening = self.normal - self.friction * self.tangent, turned[0] - self.friction * change
        slope = self.stiffness * gap * opening
        return slope, self.stiffness * (opening * opening - self.friction * gap * bend)

    def corners(self, direction: Column) -> Column:
        """Return the two step lengths along a direction of the residuals at which the contact enters or leaves the bottom
        zone.
        """
        turned = [part * scale for part, scale in zip(direction, self.scales, strict=True)]
        # Roots of tangent^2 = (friction * normal)^2.
        square = self.friction * self.friction
        two = total(v * v for v in turned[1:]) - square * turned[0] * turned[0]
        one = total(u * v for u, v in zip(self.scaled[1:], turned[1:], strict=True)) - square * self.normal * turned[0]
        none = self.tangent * self.tangent - square * self.normal * self.normal
        root = jnp.sqrt(jnp.maximum(one * one - two * none, 0.0))
        larger = jnp.where(one < 0, root, -root) - one
        return [safe_divide(larger, two), safe_divide(none, larger)]


def evaluate_cone(scales: Column, residual: Column, stiffness: Any) -> Cone:
    """Evaluate a cone at its rows' residuals.

    Args:
        scales: Factors of the rows (`Cone.scales`).
        residual: Residuals of the rows.
        stiffness: Stiffness of the first row.
    """
    friction = scales[0]
    scaled = [x * scale for x, scale in zip(residual, scales, strict=True)]
    normal, tangent = scaled[0], jnp.sqrt(total(part * part for part in scaled[1:]))
    is_stuck = jnp.where(tangent > 0, friction * normal + tangent <= 0, normal < 0)
    is_outside = (tangent > 0) & (normal < friction * tangent) & (friction * normal + tangent > 0)
    square = friction * friction
    outside = jnp.where(is_outside, stiffness / jnp.maximum(square * (1.0 + square), TINY), 0.0)
    return Cone(scales, scaled, normal, tangent, friction, outside, is_stuck)
