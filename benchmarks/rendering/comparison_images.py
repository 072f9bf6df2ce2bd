"""Create the images of docs/renderer.md: ours, MuJoCo's own, and the difference. Needs a GL library.

    MUJOCO_GL=egl python -m benchmarks.rendering.comparison_images [SHEET ...]

Each sheet is a PNG in docs/renderer/. The models are those of tests/render_models.py, in their first random pose; on the sheet
`limits` they are those of tests/render_limits.py.
"""

import argparse
import os
import pathlib
import sys

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "envs"), str(ROOT / "tests")]
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import render_limits  # noqa: E402
import render_models  # noqa: E402
from PIL import Image, ImageDraw, ImageFont  # noqa: E402
from render_features import FEATURES  # noqa: E402

from benchmarks.rendering.reference import ReferenceRenderer  # noqa: E402
from jaxrl_vis_envs.render import Scene  # noqa: E402

FOLDER = ROOT / "docs" / "renderer"
SIZE, GAP, TITLE = 144, 4, 18  # pixels
GAIN = 8  # amplification of the difference
MISSING = (255, 225, 225)


def models_by_sheet() -> dict[str, list[str]]:
    """Return the models by sheet: one sheet per group of features, one of limits, one of our and public models."""
    groups: dict[str, list[str]] = {}
    for name in FEATURES:
        groups.setdefault(FEATURES[name].sheet, []).append(name)
    groups["limits"] = list(render_limits.LIMITS)
    groups["models"] = [name for name, entry in render_models.MODELS.items() if entry.source != "feature"]
    return groups


def panel(name: str) -> tuple[str, Image.Image]:
    """Return the title and the three images of one model, side by side."""
    if name in render_limits.LIMITS:
        return limit_panel(name)
    entry = render_models.MODELS[name]
    mj_model, camera = render_models.build(name)
    mj_data = mujoco.MjData(mj_model)
    render_models.set_pose(mj_model, mj_data, 0)
    with ReferenceRenderer(render_models.build(name, truth=True)[0], SIZE, SIZE, site_groups=entry.site_groups) as reference:
        theirs = np.asarray(reference(mj_data, camera).rgb)
    title = FEATURES[name].title if name in FEATURES else name
    try:
        scene = render_models.make_scene(name, mj_model, camera, SIZE, SIZE)
    except ValueError:
        blank = np.full((SIZE, SIZE, 3), MISSING, np.uint8)
        return f"{title} (refused)", side_by_side(blank, theirs, blank)
    ours = np.asarray(render_models.draw(scene, [render_models.poses_of(mj_data)], quick=True)[0].rgb)
    return title, side_by_side(ours, theirs, difference(ours, theirs))


def limit_panel(name: str) -> tuple[str, Image.Image]:
    """Return the panel of a scene of `render_limits`, with MuJoCo's default rendering except multisampling."""
    title, xml, effects = render_limits.LIMITS[name]
    mj_model = mujoco.MjModel.from_xml_string(xml)
    mj_model.vis.quality.offsamples = 0
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)  # tendons too
    with ReferenceRenderer(mj_model, SIZE, SIZE, effects=effects) as reference:
        theirs = np.asarray(reference(mj_data, "cam").rgb)
    scene = Scene.from_mjmodel(mj_model, "cam", SIZE, SIZE, plane_backs=False)
    ours = np.asarray(render_models.draw(scene, [render_models.poses_of(mj_data)], quick=True)[0].rgb)
    return title, side_by_side(ours, theirs, difference(ours, theirs))


def difference(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return the absolute difference of two images [H, W, 3] uint8, times `GAIN`, clipped."""
    return np.minimum(GAIN * np.abs(ours.astype(int) - theirs), 255).astype(np.uint8)


def side_by_side(*images: np.ndarray) -> Image.Image:
    """Join images [SIZE, SIZE, 3] uint8 into a row, with gaps."""
    row = np.full((SIZE, len(images) * (SIZE + GAP) - GAP, 3), 255, np.uint8)
    for number, image in enumerate(images):
        row[:, number * (SIZE + GAP) : number * (SIZE + GAP) + SIZE] = image
    return Image.fromarray(row)


def sheet(names: list[str], columns: int = 2) -> Image.Image:
    """Draw the panels of all models of a sheet, in ``columns`` columns."""
    panels = [panel(name) for name in names]
    width, height = panels[0][1].size
    rows = -(-len(panels) // columns)
    page = Image.new("RGB", (columns * (width + 4 * GAP), rows * (height + TITLE + GAP) + GAP), "white")
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(13)
    for index, (title, image) in enumerate(panels):
        left, top = index % columns * (width + 4 * GAP), index // columns * (height + TITLE + GAP)
        pen.text((left + 2, top + 1), title, fill="black", font=font)
        page.paste(image, (left, top + TITLE))
    return page


def main() -> None:
    """Create the named sheets, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sheets", nargs="*", metavar="SHEET", help=f"all if none is named: {', '.join(models_by_sheet())}")
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in parser.parse_args().sheets or models_by_sheet():
        path = FOLDER / f"{name}.png"
        sheet(models_by_sheet()[name]).save(path, optimize=True)
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
