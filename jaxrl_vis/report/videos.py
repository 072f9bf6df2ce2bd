"""Videos of episodes: observations beside their goals.

Images are planar, [C, H, W] uint8, and shown in rows: colour, then depth, as available.
"""

import base64
import dataclasses
import functools
import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.provenance import install_command
from jaxrl_vis.report.colours import depth_colours
from jaxrl_vis.report.outputs import check_writable

SUFFIXES = (".gif", ".mp4", ".html", ".png")

_IMAGE_SIZE = 256  # approximate, px; images are enlarged by an integer factor
GAP, BORDER, HEADER, FOOTER = 14, 5, 30, 40
BACKGROUND, TEXT, FAINT = (24, 26, 31), (232, 234, 237), (139, 145, 154)
REACHED, MISSED, PLAIN = (62, 207, 142), (226, 109, 92), (52, 56, 64)
HOLD = 1.0  # duration of the last frame of an episode, s


@dataclasses.dataclass(frozen=True)
class EpisodeImages:
    """Images of K episodes.

    Attributes:
        frames: [K, T+1, C, H, W] uint8, the observations.
        goals: [K, C, H, W] uint8, the desired goals.
        success: [K] bool, at the last step; or [K, T+1] at every step.
    """

    frames: np.ndarray
    goals: np.ndarray
    success: np.ndarray


def shows_images(shape: Sequence[int]) -> bool:
    """Return True if frames of this shape, [episodes, steps, *observation], are images that can be shown."""
    return len(shape) == 5 and shape[2] in (1, 3, 4)


def first_seed(images: dict[str, Any]) -> EpisodeImages:
    """Copy the first seed's images of an evaluation to the host.

    Args:
        images: ``frames``, ``goals`` and ``success`` as in `EpisodeImages`, with a leading axis of seeds, on any device.
    """
    first = {name: np.asarray(values)[0] for name, values in images.items()}
    return EpisodeImages(first["frames"], first["goals"], first["success"])


def range_of_depth(episodes: EpisodeImages) -> tuple[float, float]:
    """Return a robust range of the last channel, depth, in grey levels: percentiles 0.5 and 99.5, at least 1 apart.

    They are computed over the goals and every fifth frame of each episode.
    """
    depth = np.concatenate([episodes.frames[:, ::5, -1].ravel(), episodes.goals[:, -1].ravel()])
    near, far = np.percentile(depth, [0.5, 99.5])
    return float(near), max(float(far), float(near) + 1.0)


def image_rows(image: np.ndarray, depth_range: tuple[float, float]) -> list[tuple[str, np.ndarray]]:
    """Split an image [C, H, W] into captions and images [H, W, 3] uint8; ``depth_range`` as from `range_of_depth`."""
    rows = []
    if image.shape[0] >= 3:
        rows.append(("colour", np.moveaxis(image[:3], 0, -1)))
    if image.shape[0] in (1, 4):
        rows.append(("depth", depth_colours(image[-1], *depth_range)))
    return rows


def enlarge(image: np.ndarray, size: int = _IMAGE_SIZE) -> Image.Image:
    """Enlarge an image [H, W, 3] uint8 by an integer factor to about ``size`` pixels."""
    factor = max(1, round(size / image.shape[0]))
    enlarged = (image.shape[1] * factor, image.shape[0] * factor)
    return Image.fromarray(image).resize(enlarged, Image.Resampling.NEAREST)


@functools.cache
def _font(size: int) -> Any:
    return ImageFont.load_default(size=size)


def _draw_backdrop(goal: np.ndarray, depth_range: tuple[float, float]) -> Image.Image:
    """Draw what all frames of an episode have in common: captions, the goal [C, H, W] uint8, and the bar of elapsed time."""
    images = [enlarge(wanted) for _, wanted in image_rows(goal, depth_range)]
    width, height = images[0].size
    cell = height + 2 * BORDER + GAP
    size = (2 * (width + 2 * BORDER) + 3 * GAP, HEADER + GAP // 2 + cell * len(images) + FOOTER)
    canvas = Image.new("RGB", size, BACKGROUND)
    draw = ImageDraw.Draw(canvas)
    columns = (GAP, 2 * GAP + width + 2 * BORDER)
    for x, text in zip(columns, ("observation", "goal"), strict=True):
        draw.text((x + 2, HEADER // 2 + 4), text, font=_font(17), fill=TEXT, anchor="lm")
    for row, image in enumerate(images):
        _paste(canvas, image, columns[1], row, PLAIN)
    y = size[1] - FOOTER
    draw.rectangle((GAP, y, size[0] - GAP, y + 3), fill=PLAIN)
    return canvas


def _paste(canvas: Image.Image, image: Image.Image, x: int, row: int, border: tuple[int, int, int]) -> None:
    """Paste an image with a border into the column that begins at ``x`` px."""
    width, height = image.size
    y = HEADER + GAP // 2 + row * (height + 2 * BORDER + GAP)
    outline = (x, y, x + width + 2 * BORDER - 1, y + height + 2 * BORDER - 1)
    ImageDraw.Draw(canvas).rectangle(outline, fill=border)
    canvas.paste(image, (x + BORDER, y + BORDER))


def _compose(
    backdrop: Image.Image,
    observation: np.ndarray,
    depth_range: tuple[float, float],
    footer: tuple[str, str],
    fraction: float,
    colour: tuple[int, int, int],
) -> Image.Image:
    """Compose one frame of the video.

    Args:
        backdrop: See `_draw_backdrop`; it is not changed.
        observation: [C, H, W] uint8.
        depth_range: See `range_of_depth`.
        footer: The texts at the left and at the right.
        fraction: Elapsed fraction of the episode, 0 to 1.
        colour: Colour of the border.
    """
    canvas = backdrop.copy()
    for row, (_, actual) in enumerate(image_rows(observation, depth_range)):
        _paste(canvas, enlarge(actual), GAP, row, colour)
    draw, (width, height) = ImageDraw.Draw(canvas), canvas.size
    y, shown = height - FOOTER, colour if colour != PLAIN else FAINT
    draw.rectangle((GAP, y, GAP + (width - 2 * GAP) * fraction, y + 3), fill=shown)
    draw.text((GAP + 2, y + 20), footer[0], font=_font(14), fill=FAINT, anchor="lm")
    draw.text((width - GAP - 2, y + 20), footer[1], font=_font(17), fill=shown, anchor="rm")
    return canvas


def draw_frames(episodes: EpisodeImages, frame_seconds: float, max_episodes: int) -> tuple[list[Image.Image], list[float]]:
    """Draw all frames of a video; return them with their durations in seconds.

    The border turns green where the goal is reached, and red at the end of an episode that missed it.

    Args:
        episodes: Images of the episodes.
        frame_seconds: Duration of a frame in seconds; the last frame of an episode is held longer.
        max_episodes: Maximum number of episodes; further ones are left out.
    """
    num_episodes, num_frames = episodes.frames.shape[:2]
    count = min(num_episodes, max_episodes)
    depth_range = range_of_depth(episodes)
    images, seconds = [], []
    for episode in range(count):
        success = np.asarray(episodes.success[episode], bool)
        backdrop = _draw_backdrop(episodes.goals[episode], depth_range)
        for t in range(num_frames):
            is_last = t == num_frames - 1
            reached = bool(success[t]) if success.ndim else is_last and bool(success)
            colour = REACHED if reached else MISSED if is_last else PLAIN
            verdict = "goal reached" if reached else "missed" if is_last else ""
            footer = (f"episode {episode + 1} of {count}   step {t} of {num_frames - 1}", verdict)
            fraction = t / max(1, num_frames - 1)
            images.append(_compose(backdrop, episodes.frames[episode, t], depth_range, footer, fraction, colour))
            seconds.append(HOLD if is_last else frame_seconds)
    return images, seconds


def _gif_bytes(images: list[Image.Image], seconds: list[float]) -> bytes:
    """Encode a looping GIF. All frames share one palette, without dithering: no flicker, and good compression."""
    # Every fourth pixel in each direction suffices for the palette, because images are enlarged by whole numbers.
    quarter = (max(1, images[0].width // 4), max(1, images[0].height // 4))
    samples = [image.resize(quarter, Image.Resampling.NEAREST) for image in images[:: max(1, len(images) // 16)] + images[-1:]]
    # Swatches reserve palette entries for the colours of borders and texts, however colourful the images are.
    swatches = (REACHED, MISSED, PLAIN, BACKGROUND, TEXT, FAINT)
    height = samples[0].height
    montage = Image.new("RGB", (samples[0].width, height * len(samples) + 12 * len(swatches)))
    for i, sample in enumerate(samples):
        montage.paste(sample, (0, i * height))
    for i, colour in enumerate(swatches):
        top = height * len(samples) + 12 * i
        montage.paste(colour, (0, top, montage.width, top + 12))
    palette = montage.quantize(255, method=Image.Quantize.MEDIANCUT)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    # GIF counts in hundredths of a second, and players slow down anything below two.
    durations = [max(2, round(value * 100)) * 10 for value in seconds]
    file = io.BytesIO()
    frames[0].save(file, "GIF", save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=False, disposal=1)
    return file.getvalue()


def _draw_strip(episodes: EpisodeImages) -> Image.Image:
    """Draw six steps of up to four episodes, one episode per row, with the goal at the right."""
    num_frames = episodes.frames.shape[1]
    depth_range = range_of_depth(episodes)
    steps = sorted({round(fraction * (num_frames - 1)) for fraction in (0, 0.1, 0.2, 0.35, 0.6, 1)})
    rows = []
    for episode in range(min(4, episodes.frames.shape[0])):
        success = np.asarray(episodes.success[episode], bool)
        border = REACHED if bool(success if success.ndim == 0 else success[-1]) else MISSED
        shown = [(episodes.frames[episode, t], border if t == num_frames - 1 else PLAIN) for t in steps]
        shown.append((episodes.goals[episode], PLAIN))
        views = [
            ([enlarge(view).resize((128, 128)) for _, view in image_rows(image, depth_range)], edge) for image, edge in shown
        ]
        rows += [[(images[row], edge) for images, edge in views] for row in range(len(views[0][0]))]
    cell = 128 + 2 * 3 + 8
    canvas = Image.new("RGB", (cell * len(rows[0]) + 24, cell * len(rows) + 34), BACKGROUND)
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(size=15)
    for column in range(len(rows[0])):
        is_goal = column == len(steps)
        x = 8 + column * cell + (12 if is_goal else 0)
        draw.text((x + 3, 17), "goal" if is_goal else f"step {steps[column]}", font=font, fill=TEXT, anchor="lm")
        for line, row in enumerate(rows):
            image, edge = row[column]
            y = 30 + line * cell
            draw.rectangle((x, y, x + 133, y + 133), fill=edge)
            canvas.paste(image, (x + 3, y + 3))
    return canvas


def check_output(path: Path) -> None:
    """Check that a video can be written to ``path``. Call it before playing the episodes, which takes a minute.

    Raises:
        RequestError: The suffix is not one of `SUFFIXES`, it needs a package that is not installed, or the file cannot be
            written there.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise RequestError(f"cannot write {path}: the name must end in one of {', '.join(SUFFIXES)}")
    if path.suffix.lower() == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise RequestError(f"writing {path} needs imageio-ffmpeg: {install_command('video')}, or ask for a .gif") from error
    check_writable(path)


def write_video(episodes: EpisodeImages, path: Path, frame_seconds: float = 0.04, max_episodes: int = 6) -> None:
    """Write episodes as a .gif, an .mp4, an .html page with an embedded .gif, or a .png with some frames.

    Args:
        episodes: The episodes.
        path: The file; its suffix determines the format.
        frame_seconds: Duration of a frame in seconds; the last one of an episode is shown for `HOLD` seconds.
        max_episodes: Maximum number of episodes to show; a .png shows up to four, regardless of it.

    Raises:
        RequestError: See `check_output`; or the observations are not images.
    """
    check_output(path)
    if not shows_images(episodes.frames.shape):
        raise RequestError(f"nothing to show: observations are vectors of {episodes.frames.shape[-1]} numbers, not images")
    if path.suffix.lower() == ".png":
        path.parent.mkdir(parents=True, exist_ok=True)
        _draw_strip(episodes).save(path)
        return
    write_images(*draw_frames(episodes, frame_seconds, max_episodes), path, frame_seconds)


def write_images(images: list[Image.Image], seconds: list[float], path: Path, frame_seconds: float) -> None:
    """Write frames of equal size as a .gif, an .mp4 or an .html page with an embedded .gif.

    Args:
        images: The frames.
        seconds: Durations of the frames in seconds.
        path: The file; its suffix determines the format; its folder is created.
        frame_seconds: Duration of most frames in seconds, which determines the frame rate of an .mp4.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    suffix = path.suffix.lower()
    if suffix == ".gif":
        path.write_bytes(_gif_bytes(images, seconds))
    elif suffix == ".html":
        encoded = base64.b64encode(_gif_bytes(images, seconds)).decode("ascii")
        page = f'<!doctype html><title>{path.stem}</title><body style="margin:0;background:#181a1f;text-align:center">'
        path.write_text(f'{page}<img alt="episodes" src="data:image/gif;base64,{encoded}"></body>\n', encoding="utf-8")
    else:
        import imageio.v2 as imageio

        rate = max(1, round(1 / frame_seconds))
        width, height = images[0].size
        even = (0, 0, width + width % 2, height + height % 2)  # required by most players
        with warnings.catch_warnings(), imageio.get_writer(path, fps=rate, macro_block_size=2, quality=8) as writer:
            # ffmpeg starts at the first frame, and JAX warns of every fork, even if exec follows at once.
            warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
            for image, duration in zip(images, seconds, strict=True):
                for _ in range(max(1, round(duration * rate))):
                    writer.append_data(np.asarray(image.crop(even)))
