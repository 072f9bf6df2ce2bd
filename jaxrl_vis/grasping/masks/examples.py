"""What the generator learns from: left images of synthetic rows, and which of their pixels show a stalk of the near row."""

import dataclasses
from collections.abc import Iterator
from concurrent.futures import Executor

import jax
import numpy as np

from jaxrl_vis.phenotyping.training.examples import sequences
from jaxrl_vis_envs.plants import Family


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


def synthetic_examples(
    family: Family, seeds: Iterator[int], frames: int = 2, helpers: Executor | None = None
) -> Iterator[Example]:
    """Examples of rows of a family.

    Args:
        family: What rows are drawn from.
        seeds: One row each.
        frames: How many images of each row; pairs that follow each other show nearly the same.
        helpers: Processes in which rows are laid out, so that this one has time for the network; this one if not given.
    """
    for sequence in sequences(family, seeds, helpers):
        length = len(sequence)
        chosen = sorted({round(each) for each in np.linspace(0, length - 1, min(frames, length))})
        for frame in chosen:
            image, instance, _ = sequence.left(frame)
            yield Example(np.asarray(image), true_mask(instance, len(sequence.plot.measured)))
