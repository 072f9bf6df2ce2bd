"""Page of start images: ours on the left of each pair, `mujoco.Renderer`'s on the right."""

import pathlib

import numpy as np
from PIL import Image, ImageDraw, ImageFont

COLUMNS, GAP, TITLE = 3, 4, 16  # pairs per row, few enough for legible titles on a page of text; pixels


def save(pairs: dict[str, tuple[np.ndarray, np.ndarray]], path: pathlib.Path) -> None:
    """Write the page.

    Args:
        pairs: Two images [H, W, 3] uint8, all of one size, by their title.
        path: PNG file.
    """
    height, width = next(iter(pairs.values()))[0].shape[:2]
    cell_width, cell_height = 2 * width + 3 * GAP, height + TITLE + GAP
    rows = -(-len(pairs) // COLUMNS)
    page = Image.new("RGB", (min(COLUMNS, len(pairs)) * cell_width, rows * cell_height), "white")
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(12)
    for number, (title, pair) in enumerate(pairs.items()):
        left, top = number % COLUMNS * cell_width, number // COLUMNS * cell_height
        pen.text((left, top), title, fill="black", font=font)
        for side, image in enumerate(pair):
            page.paste(Image.fromarray(image), (left + side * (width + GAP // 2), top + TITLE))
    page.save(path, optimize=True)
