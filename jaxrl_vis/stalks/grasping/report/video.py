"""Videos of reaches, one after the other, rendered from a camera beside the arm's mast."""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image, ImageDraw

import jaxrl_vis_envs
from jaxrl_vis.report.videos import BACKGROUND, HOLD, MISSED, REACHED, TEXT, check_output, write_images
from jaxrl_vis.stalks.grasping.arm.control import Timing
from jaxrl_vis.stalks.grasping.arm.reach import ReachResult, build_arm_model
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.plants import bending
from jaxrl_vis_envs.plants.bending import StalkShapes
from jaxrl_vis_envs.plants.stand import Stands
from jaxrl_vis_envs.render import Scene, render_planes

_EVERY = 2  # points of a path per frame
_HEADER = 34  # px


def write_reaches(
    path: Path, stands: Stands, result: ReachResult, targets: Sequence[int], chosen: Sequence[int], size: int = 320
) -> None:
    """Write some reaches as a video.

    Args:
        path: A .gif, .mp4 or .html file.
        stands: Stands of all reaches.
        result: Results of all reaches.
        targets: [B], index of the stalk that each reach is for; -1 for none.
        chosen: Indices of the reaches to show.
        size: Height and width of the rendered image, without its header, px.

    Raises:
        RequestError: The file cannot be written, or its format is not supported.
    """
    check_output(path)
    images, seconds = [], []
    for index in chosen:
        frames = reach_frames(stands, result, index, size)
        held = {int(stalk) for stalk in stands.stalk[index][result.held[index]]}
        is_alone = held == {int(targets[index])}
        for place, frame in enumerate(frames):
            time = (1 + place * _EVERY) * result.interval
            images.append(
                _add_caption(frame, f"{time:4.2f} s", _outcome_caption(time, held, is_alone), REACHED if is_alone else MISSED)
            )
            seconds.append(_EVERY * result.interval)
        seconds[-1] = HOLD
    write_images(images, seconds, path, _EVERY * result.interval)


def reach_frames(stands: Stands, result: ReachResult, index: int, size: int) -> np.ndarray:
    """Render the camera's view of one reach: [F, size, size, 3] uint8, ``2 * result.interval`` s apart."""
    stalk_shapes = jax.tree.map(lambda part: part[index], bending.shapes(stands))
    draw = _compile_drawing(stands.stalk.shape[1], size)
    return np.stack([np.asarray(draw(stalk_shapes, pose)) for pose in result.poses[index, ::_EVERY]])


@functools.cache
def _compile_drawing(stalks: int, size: int) -> Any:
    arms = build_arm_model(stalks)
    scene = Scene.from_mjmodel(arms.mj_model, "work", size, size)
    geoms = np.concatenate([arms.layout.lower_geom, arms.layout.upper_geom])

    def draw(stalk_shapes: StalkShapes, pose: jax.Array) -> jax.Array:
        model = bending.set_stalk_properties(arms.model, arms.layout, stalk_shapes)
        data = mjx_model.kinematics(model, bending.place_stands(arms.rest, arms.layout, stalk_shapes).replace(qpos=pose))
        fitted = scene.replace(size=scene.size.at[geoms].set(model.geom_size[geoms]))
        rgb = render_planes(fitted, data, depth=False, quantized=True).rgb
        assert rgb is not None  # it was asked for
        return rgb.transpose(1, 2, 0)

    return jaxrl_vis_envs.jit(draw)


def _outcome_caption(time: float, held_stalks: set[int], is_alone: bool) -> str:
    """Return a caption of the arm's phase at a ``time`` (s), or of the outcome once the jaws are closed."""
    timing = Timing()
    if time < timing.turn:
        return "turns"
    if time < timing.reach:
        return "reaches"
    if time < timing.reach + 0.8 * timing.close:
        return "closes"
    if not held_stalks:
        return "holds nothing"
    return (
        "holds the target"
        if is_alone
        else f"holds {len(held_stalks)} stalks"
        if len(held_stalks) > 1
        else "holds another stalk"
    )


def _add_caption(frame: np.ndarray, left: str, right: str, colour: tuple[int, int, int]) -> Image.Image:
    """Return the frame below a header with two captions; the right one has ``colour`` if it states what is held."""
    canvas = Image.new("RGB", (frame.shape[1], frame.shape[0] + _HEADER), BACKGROUND)
    canvas.paste(Image.fromarray(frame), (0, _HEADER))
    draw = ImageDraw.Draw(canvas)
    draw.text((10, 10), left, fill=TEXT)
    draw.text((canvas.width - 10, 10), f"simulated: {right}", fill=colour if right.startswith("holds") else TEXT, anchor="ra")
    return canvas
