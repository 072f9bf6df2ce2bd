"""Lossless image files: colours as H.264 video in RGB, depth as PNG.

Videos in YUV, as supported by most players, would change pixels and thus the equality of images, on which indicator rewards
rely.
"""

import fractions
import io
from collections.abc import Generator, Iterable
from pathlib import Path

import numpy as np
from PIL import Image

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.provenance import install_command

_CODEC = "libx264rgb"
# Lossless; a whole image every eighth frame, so that any frame is soon decoded; no frame that refers to later ones, so that
# times in the file are those of the frames.
_OPTIONS = {"qp": "0", "preset": "slow", "g": "8", "bf": "0"}


def check_video() -> None:
    """Raise a `RequestError` unless PyAV is installed and can write H.264."""
    try:
        import av

        av.Codec(_CODEC, "w")
    except ImportError as error:
        raise RequestError(f"videos of a LeRobot dataset need PyAV: {install_command('lerobot')}") from error
    except ValueError as error:
        raise RequestError(f"this PyAV has no {_CODEC}: {install_command('lerobot')}") from error


def write_video(path: Path, frames: Iterable[np.ndarray], fps: fractions.Fraction) -> None:
    """Write a lossless .mp4.

    Args:
        path: The file; its folder exists.
        frames: [H, W, 3] uint8 each; at least one.
        fps: Frames per second.

    Raises:
        OSError: The file cannot be written.
    """
    import av

    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream(_CODEC, rate=fps, options=_OPTIONS)
        stream.pix_fmt = "rgb24"
        for number, frame in enumerate(frames):
            if not number:
                stream.height, stream.width = frame.shape[:2]
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            picture.pts, picture.time_base = number, 1 / fps
            container.mux(stream.encode(picture))  # type: ignore[arg-type]
        container.mux(stream.encode(None))


def read_video(path: Path) -> Generator[np.ndarray]:
    """Read the frames of a video in order, [H, W, 3] uint8 each.

    Raises:
        OSError, ValueError: The file is missing or damaged.
    """
    import av

    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24")


def encode_png(image: np.ndarray) -> bytes:
    """Encode an image [H, W, 3] or [H, W, 1] uint8 as PNG; a single channel is repeated three times, as LeRobot requires."""
    file = io.BytesIO()
    Image.fromarray(np.broadcast_to(image, (*image.shape[:2], 3))).save(file, "PNG")
    return file.getvalue()


def decode_png(data: bytes) -> np.ndarray:
    """Decode a PNG to [H, W, 3] uint8.

    Raises:
        OSError, ValueError: ``data`` is not an image.
    """
    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image.convert("RGB"))
