"""Linear algebra number by number: a matrix is a table of its places that are not zero, a number an array over a batch.

Positive definite matrices are factorized from the last row on, which keeps the zeros of the mass matrix of a tree
(Featherstone, "Rigid Body Dynamics Algorithms", 6.5). Rows whose squares would fill these in are added afterwards (Woodbury's
identity).
"""

from collections.abc import Iterable, Sequence
from typing import Any

import jax.numpy as jnp

TINY = 1e-15

Numbers = list[Any]  # of arrays of one shape
Matrix = dict[tuple[int, int], Any]  # row and column -> number, those that are not zero


def solve_positive(matrix: Matrix, right: Numbers, added: Iterable[dict[int, Any]] = ()) -> Numbers:
    """``matrix``, symmetric and positive definite, plus squares of rows, divides ``right``.

    Args:
        matrix: On the diagonal and below it.
        right: One number for each row.
        added: Rows (joint -> number) whose squares are added to the matrix after its factorization.
    """
    factors, inverse = _factorize(matrix, len(right))
    half = _towards_root(factors, right)
    rows = [_towards_root(factors, [entries.get(joint, 0.0) for joint in range(len(right))]) for entries in added]
    if rows:
        # (S + W'W)^-1 b = S^-1 (b - W' (1 + W S^-1 W')^-1 W S^-1 b), with each S^-1 taken half on either side.
        weighted = [[value * scale for value, scale in zip(row, inverse, strict=True)] for row in rows]
        small: Matrix = {}
        for one, left in enumerate(weighted):
            for other in range(one + 1):
                value = inner(left, rows[other])
                small[one, other] = 1.0 + value if one == other else value
        answers = solve_positive(small, [inner(row, half) for row in weighted])
        for answer, row in zip(answers, rows, strict=True):
            half = [value - answer * part for value, part in zip(half, row, strict=True)]
    solution = [value * scale for value, scale in zip(half, inverse, strict=True)]
    for joint in range(len(right)):
        for ancestor, factor in factors[joint].items():
            solution[joint] = solution[joint] - factor * solution[ancestor]
    return solution


def _factorize(matrix: Matrix, size: int) -> tuple[list[dict[int, Any]], Numbers]:
    """``L' D L`` from the last row on: for each row of L what is before the diagonal, which is 1, and the inverses of D."""
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


def _towards_root(factors: list[dict[int, Any]], right: Numbers) -> Numbers:
    """``L'^-1`` times a column."""
    values = list(right)
    for row in reversed(range(len(values))):
        for column, factor in factors[row].items():
            values[column] = values[column] - factor * values[row]
    return values


def add_square(matrix: Matrix, row: dict[int, Any], weight: Any) -> None:
    """Adds the weighted square of a row (joint -> number), below the diagonal."""
    add_product(matrix, row, row, weight)


def add_product(matrix: Matrix, left: dict[int, Any], right: dict[int, Any], weight: Any) -> None:
    """Adds the weighted outer product of two rows, below the diagonal."""
    for joint, entry in left.items():
        scaled = weight * entry
        for other, factor in right.items():
            if other <= joint:
                matrix[joint, other] = matrix[joint, other] + scaled * factor if (joint, other) in matrix else scaled * factor


def product(matrix: Matrix, column: Numbers) -> Numbers:
    """A symmetric matrix, of which the lower half is given, times a column."""
    result: Numbers = [0.0] * len(column)
    for (row, other), value in matrix.items():
        result[row] = result[row] + value * column[other]
        if other != row:
            result[other] = result[other] + value * column[row]
    return result


def ratio(above: Any, below: Any) -> Any:
    """``above / below``, and nothing that is not a number where the latter is 0."""
    return above / jnp.where(below == 0, TINY, below)


def dot(row: dict[int, Any], column: Sequence[Any]) -> Any:
    """A row (joint -> number) times a column."""
    return total(entry * column[joint] for joint, entry in row.items())


def inner(one: Numbers, other: Numbers) -> Any:
    """The inner product of two columns."""
    return total(a * b for a, b in zip(one, other, strict=True))


def total(terms: Iterable[Any]) -> Any:
    """The sum; a plain 0 of no terms."""
    result: Any = None
    for term in terms:
        result = term if result is None else result + term
    return 0.0 if result is None else result
