"""Random Jacobians of ranks 1 to K for the comparison, with the random numbers of random methods, and losses."""

import numpy as np

COUNTS = (2, 3, 5, 8)
"""Values of K, the number of losses."""
SIZE = 24
"""Number of shared parameters."""
STEPS = 6
"""Number of updates of methods that depend on past losses."""


def draw(number: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Draw arrays by name; those of K losses begin with ``K/``.

    Args:
        number: Number of Jacobians for every number of losses.
        seed: Random seed.

    Returns:
        K/jacobians [number, K, SIZE] float64, products of normal factors, with ranks cycling through 1 to K; K/ranks [number];
        K/orders [number, K, K], permutations; K/uniform [number, SIZE]; K/normal [number, K];
        K/losses [number, STEPS, K], positive.
    """
    random, arrays = np.random.default_rng(seed), {}
    for count in COUNTS:
        ranks = 1 + np.arange(number) % count
        factors = [(random.normal(size=(count, rank)), random.normal(size=(rank, SIZE))) for rank in ranks]
        arrays |= {
            f"{count}/jacobians": np.stack([left @ right for left, right in factors]),
            f"{count}/ranks": ranks,
            f"{count}/orders": np.stack([[random.permutation(count) for _ in range(count)] for _ in range(number)]),
            f"{count}/uniform": random.uniform(size=(number, SIZE)),
            f"{count}/normal": random.normal(size=(number, count)),
            f"{count}/losses": random.uniform(0.2, 3.0, size=(number, STEPS, count)),
        }
    return arrays
