"""Grouping of images by photograph, and the split of a folder's images into training and held-out ones by group.

Exports of labelling programs include augmented copies of a photograph (rotated, relit or cropped), and frames of a video are
nearly identical. Copies on both sides of a split would leak training data into the evaluation.
"""

import dataclasses
import re
from collections.abc import Sequence

import cv2
import numpy as np

_THUMBNAIL_SIZE = 16  # pixels: height and width of a thumbnail
_MIN_CORRELATION = 0.97  # minimum correlation of the thumbnails of copies
_COPY = re.compile(r"([._-]rf[._-][0-9a-f]{6,}|[ ._-]*(aug|copy|flip|mirror|rot)[a-z]*[ ._-]*\d*|[ ._-]*\(\d+\))$")
MIN_IMAGES = 5
"""Minimum number of photographs to hold out any."""


@dataclasses.dataclass(frozen=True)
class Split:
    """Indices of the images of each part of a split.

    Attributes:
        train: Training set.
        stop: Validation set for early stopping.
        test: Test set for the report, used for no decision.
        photographs: Number of distinct photographs.
    """

    train: tuple[int, ...]
    stop: tuple[int, ...]
    test: tuple[int, ...]
    photographs: int


def group_by_photograph(names: Sequence[str], images: Sequence[np.ndarray]) -> np.ndarray:
    """Group images by photograph: copies by the name of the file or by the similarity of thumbnails.

    Args:
        names: File names; suffixes that labelling programs append to copies are ignored.
        images: Images [h, w, 3] uint8 of any size.

    Returns:
        [N] int, index of the first image of the same photograph.
    """
    thumbnails = np.array([_thumbnail(image) for image in images])
    flat = thumbnails.reshape(len(images), -1)
    mirrored = thumbnails[:, :, ::-1].reshape(len(images), -1)
    alike = np.maximum(flat @ flat.T, flat @ mirrored.T) > _MIN_CORRELATION
    stems = [_stem(name) for name in names]
    alike |= np.array([[one == other for other in stems] for one in stems])
    number = np.arange(len(images))
    for _ in range(len(images)):
        lowest = np.where(alike, number, len(images)).min(axis=1)
        if (lowest == number).all():
            break
        number = lowest
    return number


def _stem(name: str) -> str:
    stem = name.lower().rpartition("/")[2].rpartition(".")[0]
    while (shorter := _COPY.sub("", stem)) and shorter != stem:
        stem = shorter
    return stem


def _thumbnail(image: np.ndarray) -> np.ndarray:
    grey = cv2.resize(image, (_THUMBNAIL_SIZE, _THUMBNAIL_SIZE), interpolation=cv2.INTER_AREA).astype(np.float64).mean(axis=2)
    grey -= grey.mean()
    return grey / max(float(np.sqrt((grey**2).sum())), 1e-9)


def split_images(photographs: np.ndarray, seed: int) -> Split:
    """Split images by photograph: a fifth for testing, and a sixth of the rest for early stopping.

    With fewer than `MIN_IMAGES` photographs, all images are for training.

    Args:
        photographs: [N] int, see `group_by_photograph`.
        seed: Seed of the split.
    """
    groups = np.random.default_rng([seed, 23]).permutation(np.unique(photographs))
    count = len(groups)
    test = max(round(count / 5), 1) if count >= MIN_IMAGES else 0
    stop = max(round((count - test) / 6), 1) if count >= MIN_IMAGES else 0

    def select(chosen: np.ndarray) -> tuple[int, ...]:
        return tuple(np.flatnonzero(np.isin(photographs, chosen)).tolist())

    return Split(select(groups[test + stop :]), select(groups[test : test + stop]), select(groups[:test]), count)
