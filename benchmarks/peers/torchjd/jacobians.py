"""Random Jacobians of ranks 1 to K for the comparison, with what random methods draw, and losses."""

import numpy as np

COUNTS = (2, 3, 5, 8)
"""Numbers of losses, K."""
SIZE = 24
"""Shared parameters."""
STEPS = 6
"""Updates of methods with a memory of the losses."""


def draw(each: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Draw arrays by name; those of K losses begin with ``K/``.

    Args:
        each: Jacobians of every number of losses.
        seed: Of all draws.

    Returns:
        K/jacobians [each, K, SIZE] float64, of normal factors, whose ranks go through 1 to K; K/ranks [each]; K/orders [each,
        K, K], permutations; K/uniform [each, SIZE]; K/normal [each, K]; K/losses [each, STEPS, K], positive.
    """
    random, arrays = np.random.default_rng(seed), {}
    for count in COUNTS:
        ranks = 1 + np.arange(each) % count
        factors = [(random.normal(size=(count, rank)), random.normal(size=(rank, SIZE))) for rank in ranks]
        arrays |= {
            f"{count}/jacobians": np.stack([left @ right for left, right in factors]),
            f"{count}/ranks": ranks,
            f"{count}/orders": np.stack([[random.permutation(count) for _ in range(count)] for _ in range(each)]),
            f"{count}/uniform": random.uniform(size=(each, SIZE)),
            f"{count}/normal": random.normal(size=(each, count)),
            f"{count}/losses": random.uniform(0.2, 3.0, size=(each, STEPS, count)),
        }
    return arrays
