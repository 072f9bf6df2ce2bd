"""Video of a policy's episodes with predictions of its auxiliary tasks and their targets.

observation  goal  reconstruction  flow, true and predicted  the observation rotated, with its angle, true and predicted
"""

import dataclasses
from collections.abc import Sequence

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jaxrl_vis.report import videos

_SIZE = 192  # approximate size of a tile, px
_CAPTION = 22

Tile = tuple[str, np.ndarray]
"""A caption and an image [H, W, 3] uint8."""


@dataclasses.dataclass(frozen=True)
class Predictions:
    """Predictions and targets for each step of K episodes; None if the run does not have the task.

    Attributes:
        reconstruction: [K, T, C or 1, H', W'] uint8, of the observation before the action, without borders that do not fill a
            block of the encoder.
        flow: [K, T, H, W] float32, magnitude of the optical flow, in pixels per step; stretched to [0, 1] with
            ``aux_form="release"``.
        flow_predicted: [K, T, H', W'] float32, prediction of ``flow``, without these borders.
        rotated: [K, T, C, H, W] uint8, the rotated observation.
        angle: [K, T] float32, its rotation, degrees counter-clockwise.
        angle_predicted: [K, T] float32, prediction of ``angle``.
    """

    reconstruction: np.ndarray | None = None
    flow: np.ndarray | None = None
    flow_predicted: np.ndarray | None = None
    rotated: np.ndarray | None = None
    angle: np.ndarray | None = None
    angle_predicted: np.ndarray | None = None


def draw_frames(
    episodes: videos.EpisodeImages, predictions: Predictions, frame_seconds: float
) -> tuple[list[Image.Image], list[float]]:
    """Draw all frames of the video; return them with their durations in seconds. Borders are as in `videos.draw_frames`.

    Args:
        episodes: T+1 images of each of K episodes, and their goals; success at the last step.
        predictions: Predictions for the first T images.
        frame_seconds: Duration of a frame in seconds.
    """
    depth_range = videos.range_of_depth(episodes)
    max_flow = 1.0 if predictions.flow is None else max(1e-3, float(np.percentile(predictions.flow, 99.8)))
    images, seconds = [], []
    count, steps = len(episodes.frames), episodes.frames.shape[1] - 1
    for episode in range(count):
        for t in range(steps):
            is_last = t == steps - 1
            success = bool(np.asarray(episodes.success[episode]).ravel()[-1])
            colour = videos.PLAIN if not is_last else videos.REACHED if success else videos.MISSED
            verdict = "" if not is_last else "goal reached" if success else "missed"
            columns = _columns(episodes, predictions, episode, t, depth_range, max_flow)
            footer = (f"episode {episode + 1} of {count}   step {t} of {steps}", verdict)
            images.append(_compose(columns, footer, colour))
            seconds.append(videos.HOLD if is_last else frame_seconds)
    return images, seconds


def _columns(
    episodes: videos.EpisodeImages,
    predictions: Predictions,
    episode: int,
    t: int,
    depth_range: tuple[float, float],
    max_flow: float,
) -> list[list[Tile]]:
    """Arrange tiles in columns; colour and depth of an observation are stacked in one column."""

    def image_tiles(caption: str, image: np.ndarray) -> list[Tile]:
        rows = [image for _, image in videos.image_rows(image, depth_range)]
        return [(caption if index == 0 else "", row) for index, row in enumerate(rows)]

    columns = [image_tiles("observation", episodes.frames[episode, t]), image_tiles("goal", episodes.goals[episode])]
    height = len(columns[0])
    if predictions.reconstruction is not None:
        image = predictions.reconstruction[episode, t]
        is_grey = image.shape[0] == 1 and episodes.frames.shape[2] != 1
        grey = [("reconstruction, grey", np.repeat(image[0][..., None], 3, axis=-1))]
        columns.append(grey if is_grey else image_tiles("reconstruction", image))
    if predictions.flow is not None and predictions.flow_predicted is not None:
        tiles = [
            (f"optical flow, up to {max_flow:.1f}", _heat(predictions.flow[episode, t], max_flow)),
            ("predicted flow", _heat(predictions.flow_predicted[episode, t], max_flow)),
        ]
        columns += [tiles] if height > 1 else [[tile] for tile in tiles]
    if predictions.rotated is not None and predictions.angle is not None and predictions.angle_predicted is not None:
        angle, guess = predictions.angle[episode, t], predictions.angle_predicted[episode, t]
        columns.append(image_tiles(f"rotated {angle:+.0f}°, guess {guess:+.0f}°", predictions.rotated[episode, t]))
    return columns


def _heat(values: np.ndarray, maximum: float) -> np.ndarray:
    fraction = np.clip(values / maximum, 0.0, 1.0)
    return (matplotlib.colormaps["viridis"](fraction)[..., :3] * 255).round().astype(np.uint8)


def _compose(columns: Sequence[Sequence[Tile]], footer: tuple[str, str], colour: tuple[int, int, int]) -> Image.Image:
    """Compose one frame of the video; ``colour`` is that of the observation's border."""
    shape = columns[0][0][1].shape[:2]
    width, height = videos.enlarge(columns[0][0][1], _SIZE).size
    cell = (width + 2 * videos.BORDER + videos.GAP, height + 2 * videos.BORDER + _CAPTION)
    rows = max(map(len, columns))
    canvas = Image.new("RGB", (cell[0] * len(columns) + videos.GAP, cell[1] * rows + videos.FOOTER), videos.BACKGROUND)
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(size=14)
    for column, tiles in enumerate(columns):
        for row, (caption, image) in enumerate(tiles):
            x, y = videos.GAP + column * cell[0], row * cell[1]
            draw.text((x + 2, y + _CAPTION // 2 + 1), caption, font=font, fill=videos.TEXT, anchor="lm")
            border = colour if column == 0 else videos.PLAIN
            right, bottom = x + width + 2 * videos.BORDER - 1, y + _CAPTION + height + 2 * videos.BORDER - 1
            draw.rectangle((x, y + _CAPTION, right, bottom), fill=border)
            # Borders that do not fill a block of the encoder are not predicted, and stay empty.
            size = (width * image.shape[1] // shape[1], height * image.shape[0] // shape[0])
            shown = Image.fromarray(image).resize(size, Image.Resampling.NEAREST)
            canvas.paste(shown, (x + videos.BORDER, y + _CAPTION + videos.BORDER))
    y = canvas.height - videos.FOOTER // 2
    draw.text((videos.GAP + 2, y), footer[0], font=font, fill=videos.FAINT, anchor="lm")
    draw.text((canvas.width - videos.GAP - 2, y), footer[1], font=font, fill=colour, anchor="rm")
    return canvas
