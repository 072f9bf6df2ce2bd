"""Scalar arithmetic with constant folding: known values are Python floats and generate no operations.

A scalar is a Python float, or an array with one element per episode of a batch. Additions of 0 and multiplications by 0 or 1
are skipped, so general formulas for joints and inertias reduce to the short ones that hold for axis-aligned joints and
symmetric bodies. A vector is a tuple of three scalars; a symmetric matrix is a dictionary of its entries on and above the
diagonal.
"""

import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

Vector = tuple[Any, Any, Any]
Symmetric = dict[tuple[int, int], Any]  # (row, column) -> entry, row <= column

ZERO: Vector = (0.0, 0.0, 0.0)


def _equals(number: Any, value: float) -> bool:
    return isinstance(number, float) and number == value


def plus(*terms: Any) -> Any:
    """Return the sum of scalars; 0.0 for none."""
    known = sum(term for term in terms if isinstance(term, float))
    result = None
    for term in terms:
        if not isinstance(term, float):
            result = term if result is None else result + term
    if result is None:
        return float(known)
    return result if known == 0.0 else result + known


def minus(left: Any, right: Any) -> Any:
    """Return ``left - right``."""
    if isinstance(right, float):
        return plus(left, -right)
    return -right if _equals(left, 0.0) else left - right


def times(*factors: Any) -> Any:
    """Return the product of scalars."""
    known = math.prod(factor for factor in factors if isinstance(factor, float))
    result = None
    for factor in factors:
        if not isinstance(factor, float):
            result = factor if result is None else result * factor
    if result is None or known == 0.0:
        return float(known)
    if known == 1.0:
        return result
    return -result if known == -1.0 else result * known


def choose(condition: Any, if_true: Any, if_false: Any) -> Any:
    """Select by a condition, a Python bool or an array."""
    if isinstance(condition, bool):
        return if_true if condition else if_false
    return jnp.where(condition, if_true, if_false)


def inverse_root(number: Any, minimum: float) -> Any:
    """Return ``1 / sqrt(max(number, minimum))``."""
    return 1.0 / math.sqrt(max(number, minimum)) if isinstance(number, float) else 1.0 / jnp.sqrt(jnp.maximum(number, minimum))


def add(*vectors: Vector) -> Vector:
    """Return the sum of vectors."""
    x, y, z = zip(*vectors, strict=True)
    return plus(*x), plus(*y), plus(*z)


def subtract(left: Vector, right: Vector) -> Vector:
    """Return the difference of two vectors."""
    return minus(left[0], right[0]), minus(left[1], right[1]), minus(left[2], right[2])


def scale(vector: Vector, factor: Any) -> Vector:
    """Multiply a vector by a scalar."""
    return times(vector[0], factor), times(vector[1], factor), times(vector[2], factor)


def dot(left: Vector, right: Vector) -> Any:
    """Return the inner product of two vectors."""
    return plus(*(times(a, b) for a, b in zip(left, right, strict=True)))


def cross(left: Vector, right: Vector) -> Vector:
    """Return the cross product of two vectors."""
    (a, b, c), (x, y, z) = left, right
    return (
        minus(times(b, z), times(c, y)),
        minus(times(c, x), times(a, z)),
        minus(times(a, y), times(b, x)),
    )


def floats(array: Any) -> tuple[float, ...]:
    """Convert a NumPy vector to known scalars."""
    return tuple(float(number) for number in array)


def combine(columns: Sequence[Vector], weights: Sequence[Any]) -> Vector:
    """Multiply a matrix, given by its columns, by a vector."""
    return add(*(scale(column, weight) for column, weight in zip(columns, weights, strict=True)))


def upper_key(row: int, column: int) -> tuple[int, int]:
    """Return the key of an entry in the upper triangle, by which a symmetric matrix stores it."""
    return (row, column) if row <= column else (column, row)


def symmetric_times(matrix: Symmetric, vector: Vector) -> Vector:
    """Multiply a symmetric matrix by a vector."""
    x, y, z = (plus(*(times(matrix[upper_key(row, column)], vector[column]) for column in range(3))) for row in range(3))
    return x, y, z


# On [-pi/2, pi/2], in powers of the squared angle: interpolated at Chebyshev points, with errors of 4e-9 and 6e-10 there.
_QUARTER_SQUARED = (0.5 * np.pi) ** 2


def _coefficients(function: Any, degree: int) -> tuple[float, ...]:
    fitted = np.polynomial.Chebyshev.interpolate(function, degree, domain=[0.0, _QUARTER_SQUARED])
    return floats(fitted.convert(kind=np.polynomial.Polynomial).coef)


_SINE = _coefficients(lambda square: np.sinc(np.sqrt(square) / np.pi), 4)
_COSINE = _coefficients(lambda square: np.cos(np.sqrt(square)), 5)
_PI = (3.140625, math.pi - 3.140625)  # the first part has so few digits that its products with whole numbers are exact


def sine_and_cosine(angle: Any) -> tuple[Any, Any]:
    """Return the sine and cosine of an array of angles (rad), to within 3e-7 for up to a thousand turns.

    Library functions handle arguments of any size with longer code, which would appear twice per joint.
    """
    half_turns = jnp.floor(angle * (1.0 / math.pi) + 0.5)
    rest = angle - half_turns * _PI[0] - half_turns * _PI[1]
    halves = 0.5 * half_turns
    sign = 1.0 - 4.0 * (halves - jnp.floor(halves))
    square = rest * rest

    def polynomial(coefficients: tuple[float, ...]) -> Any:
        value = coefficients[-1]
        for coefficient in coefficients[-2::-1]:
            value = value * square + coefficient
        return value

    return sign * (rest * polynomial(_SINE)), sign * polynomial(_COSINE)
