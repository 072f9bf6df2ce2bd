"""Checks that benchmarks do not measure copies: results must differ within a batch and between calls."""

import itertools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def assert_varied(rows: Any, label: str) -> None:
    """Assert that [N, ...] ``rows`` are not copies: more than half of them are distinct, or there is only one.

    If all environments of a benchmark behave the same, it measures one environment and a broadcast. ``label`` names the rows in
    the message.

    Raises:
        AssertionError: Half of the rows or fewer are distinct.
    """
    rows = np.asarray(rows)
    count = rows.shape[0]
    distinct = len({row.tobytes() for row in rows})
    if count > 1 and distinct <= count // 2:
        raise AssertionError(f"only {distinct} of {count} {label} differ: this would measure a broadcast")


def cycle_batches(draw: Callable[[Any], Any], batches: list[Any]) -> Callable[[], Any]:
    """Return a function without arguments that renders the batches in turn."""
    turns = itertools.cycle(batches)
    return lambda: draw(next(turns))


def assert_new_images(draw: Callable[[Any], Any], batches: list[Any]) -> None:
    """Assert that images differ within a batch and between batches.

    Args:
        draw: Function from a batch to arrays [N, ...] or a tree of them.
        batches: Two or more batches.

    Raises:
        AssertionError: Half of the images or more are copies of others in their batch, or of the previous batch's.
    """
    drawn = [image_bytes(draw(batch)) for batch in batches]
    for rows in drawn:
        assert_varied(rows, "images")
    for first, second in itertools.pairwise(drawn):
        same = int(np.sum(np.all(first == second, axis=1)))
        if len(first) > 1 and same >= len(first) / 2:
            raise AssertionError(
                f"{same} of {len(first)} images stay the same in the next batch: this would measure a broadcast"
            )


def image_bytes(images: Any) -> np.ndarray:
    """Return the bytes of a tree of arrays [N, ...] as one array [N, bytes] uint8."""
    planes = [np.ascontiguousarray(plane) for plane in jax.tree.leaves(jax.device_get(images))]
    return np.concatenate([plane.reshape(len(plane), -1).view(np.uint8) for plane in planes], axis=1)
