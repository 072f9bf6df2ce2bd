"""No benchmark measures copies: results differ within a batch, and the next call computes another batch."""

import itertools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def assert_varied(rows: Any, what: str) -> None:
    """Asserts that [N, ...] ``rows`` are not copies of each other: more than half are unlike all others.

    A benchmark whose environments all do the same measures one environment and a broadcast.
    """
    rows = np.asarray(rows)
    count = rows.shape[0]
    distinct = len({row.tobytes() for row in rows})
    if count > 1 and distinct <= count // 2:
        raise AssertionError(f"only {distinct} of {count} {what} differ: this would measure a broadcast")


def alternate(draw: Callable[[Any], Any], batches: list[Any]) -> Callable[[], Any]:
    """A call without arguments that draws the next of the batches, round and round."""
    turns = itertools.cycle(batches)
    return lambda: draw(next(turns))


def assert_new_images(draw: Callable[[Any], Any], batches: list[Any]) -> None:
    """Asserts that images differ within a batch and between batches.

    Args:
        draw: Gives arrays [N, ...], or a tree of them.
        batches: Two or more.
    """
    drawn = [rows_of(draw(batch)) for batch in batches]
    for rows in drawn:
        assert_varied(rows, "images")
    for first, second in itertools.pairwise(drawn):
        same = int(np.sum(np.all(first == second, axis=1)))
        if len(first) > 1 and same >= len(first) / 2:
            raise AssertionError(
                f"{same} of {len(first)} images stay the same in the next batch: this would measure a broadcast"
            )


def rows_of(images: Any) -> np.ndarray:
    """[N, bytes] of a tree of arrays [N, ...]."""
    planes = [np.ascontiguousarray(plane) for plane in jax.tree.leaves(jax.device_get(images))]
    return np.concatenate([plane.reshape(len(plane), -1).view(np.uint8) for plane in planes], axis=1)
