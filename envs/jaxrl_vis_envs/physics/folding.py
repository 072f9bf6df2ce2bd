"""Arithmetic on numbers some of which are known before the program runs: those are Python floats, and cost it nothing.

A number is a float, or one array over the episodes of a batch. Nothing is added to 0 or multiplied by 0 or 1, so formulas for
any joint and any inertia become, for a joint along an axis of its body and a symmetric body, the short ones of that case.
A vector is a tuple of three numbers, a symmetric matrix a table of its places on the diagonal and above it.
"""

import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

Vector = tuple[Any, Any, Any]
Symmetric = dict[tuple[int, int], Any]  # (row, column), row <= column

NOTHING: Vector = (0.0, 0.0, 0.0)


def _is(number: Any, value: float) -> bool:
    return isinstance(number, float) and number == value


def plus(*terms: Any) -> Any:
    """The sum of numbers; a plain 0 of none."""
    known = sum(term for term in terms if isinstance(term, float))
    result = None
    for term in terms:
        if not isinstance(term, float):
            result = term if result is None else result + term
    if result is None:
        return float(known)
    return result if known == 0.0 else result + known


def minus(one: Any, other: Any) -> Any:
    """``one - other``."""
    if isinstance(other, float):
        return plus(one, -other)
    return -other if _is(one, 0.0) else one - other


def times(*factors: Any) -> Any:
    """The product of numbers."""
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


def choose(condition: Any, one: Any, other: Any) -> Any:
    """``one`` where a condition holds, which may be known, and ``other`` elsewhere."""
    if isinstance(condition, bool):
        return one if condition else other
    return jnp.where(condition, one, other)


def inverse_root(number: Any, least: float) -> Any:
    """One over the square root of a number, or of ``least`` where that is more."""
    return 1.0 / math.sqrt(max(number, least)) if isinstance(number, float) else 1.0 / jnp.sqrt(jnp.maximum(number, least))


def add(*vectors: Vector) -> Vector:
    """The sum of vectors."""
    x, y, z = zip(*vectors, strict=True)
    return plus(*x), plus(*y), plus(*z)


def subtract(one: Vector, other: Vector) -> Vector:
    """The difference of two vectors."""
    return minus(one[0], other[0]), minus(one[1], other[1]), minus(one[2], other[2])


def scale(vector: Vector, factor: Any) -> Vector:
    """A vector times a number."""
    return times(vector[0], factor), times(vector[1], factor), times(vector[2], factor)


def dot(one: Vector, other: Vector) -> Any:
    """The inner product of two vectors."""
    return plus(*(times(left, right) for left, right in zip(one, other, strict=True)))


def cross(one: Vector, other: Vector) -> Vector:
    """The vector product."""
    (a, b, c), (x, y, z) = one, other
    return (
        minus(times(b, z), times(c, y)),
        minus(times(c, x), times(a, z)),
        minus(times(a, y), times(b, x)),
    )


def floats(array: Any) -> tuple[float, ...]:
    """The numbers of a NumPy vector, as known ones."""
    return tuple(float(number) for number in array)


def combine(columns: Sequence[Vector], weights: Sequence[Any]) -> Vector:
    """A matrix, of which the columns are given, times a vector."""
    return add(*(scale(column, weight) for column, weight in zip(columns, weights, strict=True)))


def place(row: int, column: int) -> tuple[int, int]:
    """Where a symmetric matrix keeps a number."""
    return (row, column) if row <= column else (column, row)


def symmetric_times(matrix: Symmetric, vector: Vector) -> Vector:
    """A symmetric matrix times a vector."""
    x, y, z = (plus(*(times(matrix[place(row, column)], vector[column]) for column in range(3))) for row in range(3))
    return x, y, z


# On [-pi/2, pi/2], in powers of the squared angle: interpolated at Chebyshev's points, wrong by 4e-9 and 6e-10 there.
_QUARTER_SQUARED = (0.5 * np.pi) ** 2


def _coefficients(function: Any, degree: int) -> tuple[float, ...]:
    fitted = np.polynomial.Chebyshev.interpolate(function, degree, domain=[0.0, _QUARTER_SQUARED])
    return floats(fitted.convert(kind=np.polynomial.Polynomial).coef)


_SINE = _coefficients(lambda square: np.sinc(np.sqrt(square) / np.pi), 4)
_COSINE = _coefficients(lambda square: np.cos(np.sqrt(square)), 5)
_PI = (3.140625, math.pi - 3.140625)  # the first has few enough digits for its products with whole numbers to be exact


def sine_and_cosine(angle: Any) -> tuple[Any, Any]:
    """Sine and cosine of an array of angles (rad), within 1e-7 for up to some thousand turns.

    A library's functions serve angles of any size, by code that is longer, and it would be there twice for every joint.
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
