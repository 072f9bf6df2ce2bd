"""Linear algebra in scalars: a matrix is a dictionary of its nonzero entries, a scalar is an array over a batch of episodes.

Positive definite matrices are factorized from the last row up, which preserves the zeros of a kinematic tree's mass matrix.

Source: Featherstone, "Rigid Body Dynamics Algorithms", 6.5.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import jax.numpy as jnp

TINY = 1e-15

Column = list[Any]  # arrays of one shape
Row = dict[int, Any]  # column -> nonzero entry
Matrix = dict[tuple[int, int], Any]  # (row, column) -> nonzero entry


def solve_positive(matrix: Matrix, rhs: Column) -> Column:
    """Solve a symmetric positive definite system.

    Args:
        matrix: Entries on and below the diagonal.
        rhs: Right-hand side, one scalar per row.
    """
    factors, inverse = _factorize(matrix, len(rhs))
    half = _solve_transposed(factors, rhs)
    solution = [value * scale for value, scale in zip(half, inverse, strict=True)]
    for row in range(len(rhs)):
        for column, factor in factors[row].items():
            solution[row] = solution[row] - factor * solution[column]
    return solution


def _factorize(matrix: Matrix, size: int) -> tuple[list[Row], Column]:
    """Factorize a matrix as L' D L; return the entries of L left of its unit diagonal, by row, and the reciprocals of D."""
    left, factors, inverse = dict(matrix), [{} for _ in range(size)], [None] * size
    for row in reversed(range(size)):
        inverse[row] = 1.0 / left[row, row]
        before = [column for column in range(row) if (row, column) in left]
        factors[row] = {column: left[row, column] * inverse[row] for column in before}
        for column in before:
            for other in before:
                if other <= column:
                    change = factors[row][column] * left[row, other]
                    left[column, other] = left[column, other] - change if (column, other) in left else -change
    return factors, inverse


def _solve_transposed(factors: list[Row], rhs: Column) -> Column:
    """Solve a linear system with the matrix L'."""
    values = list(rhs)
    for row in reversed(range(len(values))):
        for column, factor in factors[row].items():
            values[column] = values[column] - factor * values[row]
    return values


def add_square(matrix: Matrix, row: Row, weight: Any) -> None:
    """Add the weighted outer product of a row with itself to ``matrix`` in place, on and below the diagonal."""
    add_product(matrix, row, row, weight)


def add_product(matrix: Matrix, left: Row, right: Row, weight: Any) -> None:
    """Add the weighted outer product of two rows to ``matrix`` in place, on and below the diagonal."""
    for row, entry in left.items():
        scaled = weight * entry
        for column, factor in right.items():
            if column <= row:
                matrix[row, column] = matrix[row, column] + scaled * factor if (row, column) in matrix else scaled * factor


def symmetric_product(matrix: Matrix, column: Column) -> Column:
    """Multiply a symmetric matrix, given on and below the diagonal, by a column."""
    result: Column = [0.0] * len(column)
    for (row, other), value in matrix.items():
        result[row] = result[row] + value * column[other]
        if other != row:
            result[other] = result[other] + value * column[row]
    return result


def safe_divide(numerator: Any, denominator: Any) -> Any:
    """Divide elementwise; the result is finite where the denominator is 0."""
    return numerator / jnp.where(denominator == 0, TINY, denominator)


def row_product(row: Row, column: Sequence[Any]) -> Any:
    """Multiply a sparse row by a column."""
    return total(entry * column[index] for index, entry in row.items())


def inner(left: Column, right: Column) -> Any:
    """Return the inner product of two columns."""
    return total(a * b for a, b in zip(left, right, strict=True))


def total(terms: Iterable[Any]) -> Any:
    """Return the sum of terms; 0.0 for none."""
    result: Any = None
    for term in terms:
        result = term if result is None else result + term
    return 0.0 if result is None else result
