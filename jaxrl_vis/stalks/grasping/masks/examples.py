"""Training examples of the generator: left images of synthetic rows, with masks of the stalks of the near row."""

import dataclasses

import jax
import numpy as np

from jaxrl_vis_envs.plants import Family, draw
from jaxrl_vis_envs.plants.pairs import Sequence


@dataclasses.dataclass(frozen=True)
class Example:
    """One image.

    Attributes:
        image: [H, W, 3] uint8.
        mask: [H, W] bool, pixels of stalks of the near row.
    """

    image: np.ndarray
    mask: np.ndarray


def true_mask(instance: jax.Array | np.ndarray, count: int) -> np.ndarray:
    """Pixels of the stalks of the near row: [H, W] bool.

    Args:
        instance: [H, W] int, which stalk each pixel shows; those of the near row come first.
        count: Stalks of the near row.
    """
    instance = np.asarray(instance)
    return (instance >= 0) & (instance < count)


def synthetic_examples(family: Family, seed: int, frames: int = 2) -> list[Example]:
    """Examples of one row of a family.

    Args:
        family: Family that the row is drawn from.
        seed: Seed of the row.
        frames: Number of images of it; consecutive pairs show nearly the same.
    """
    sequence = Sequence.of(draw(family, seed))
    length = len(sequence)
    examples = []
    for frame in sorted({round(place) for place in np.linspace(0, length - 1, min(frames, length))}):
        image, instance, _ = sequence.left(frame)
        examples.append(Example(np.asarray(image), true_mask(instance, len(sequence.plot.measured))))
    return examples
