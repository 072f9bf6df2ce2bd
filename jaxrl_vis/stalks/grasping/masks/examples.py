"""Training examples for the generator: left images of synthetic rows, with masks of the stalks of the near row."""

import dataclasses

import jax
import numpy as np

from jaxrl_vis_envs.plants import Family, draw
from jaxrl_vis_envs.plants.pairs import Sequence


@dataclasses.dataclass(frozen=True)
class Example:
    """Training example.

    Attributes:
        image: [H, W, 3] uint8, RGB.
        mask: [H, W] bool, True for pixels of stalks of the near row.
    """

    image: np.ndarray
    mask: np.ndarray


def true_mask(instance: jax.Array | np.ndarray, count: int) -> np.ndarray:
    """Return the mask [H, W] bool of the stalks of the near row.

    Args:
        instance: [H, W] int, index of the stalk that each pixel shows, those of the near row first; negative for none.
        count: Number of stalks of the near row.
    """
    instance = np.asarray(instance)
    return (instance >= 0) & (instance < count)


def synthetic_examples(family: Family, seed: int, frames: int = 2) -> list[Example]:
    """Render examples of one row of a family.

    Args:
        family: Family that the row is sampled from.
        seed: Seed of the row.
        frames: Maximum number of images, evenly spaced because consecutive pairs show nearly the same.
    """
    sequence = Sequence.of(draw(family, seed))
    length = len(sequence)
    examples = []
    for frame in sorted({round(place) for place in np.linspace(0, length - 1, min(frames, length))}):
        image, instance, _ = sequence.left(frame)
        examples.append(Example(np.asarray(image), true_mask(instance, len(sequence.plot.measured))))
    return examples
