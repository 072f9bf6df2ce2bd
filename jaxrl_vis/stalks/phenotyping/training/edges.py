"""Edges of stalks in the rows of an image, from synthetic plots, masks or boxes; see `detector.sections`."""

from collections.abc import Sequence

import numpy as np

from jaxrl_vis.stalks.phenotyping.detector.sections import ABSENT, NOTHING, STALK, STEP, UNCLEAR, UNKNOWN
from jaxrl_vis_envs.plants import Calibration
from jaxrl_vis_envs.plants.cameras import Pose
from jaxrl_vis_envs.plants.field import Plot, Stalk
from jaxrl_vis_envs.plants.truth import outline

MAX_EDGES = 96
"""Maximum number of stalks per training image, those of the rows of plants behind included; further ones are dropped."""
_HEIGHTS = 160  # of the outline of a stalk
_COLUMNS = 1600  # of the instance image that suffice to estimate visibility
_NEAR = 0.1  # m: minimum depth of the parts of a stalk
_FEW = 12  # minimum number of visible pixels of the resized image

Edges = tuple[np.ndarray, np.ndarray]
"""Edges [T, R, 3] float32, see `sections`, and kinds [T] int32."""


def synthetic_edges(
    plot: Plot, pose: Pose, camera: Calibration, instance: np.ndarray, shape: tuple[int, int], scale: tuple[float, float]
) -> Edges:
    """Compute the edges of the visible stalks of an image; those with fewer than 12 pixels after resizing are dropped.

    In daytime plots, stalks of the rows of plants behind look like those of the near row: they are ``UNCLEAR``. At night,
    they are background, as the light of the flash falls off.

    Args:
        plot: Plot with its plants.
        pose: Pose of the left camera.
        camera: True calibration of the camera.
        instance: Instance image [H, W] of the original size.
        shape: Height and width of the resized image.
        scale: Vertical and horizontal factors from coordinates of the resized image to those of the original.
    """
    thin = max(int(min(scale)), instance.shape[1] // _COLUMNS, 1)
    thinned = instance[::thin, ::thin]
    count, total = -(-shape[0] // STEP), len(plot.stalks)
    bins = np.minimum(((np.arange(thinned.shape[0]) * thin + 0.5) / scale[0] / STEP).astype(int), count - 1)
    of_stalks = bins[:, None] * total + thinned
    counts = np.bincount(of_stalks[thinned >= 0], minlength=count * total).reshape(count, total)  # of pixels
    sampled = np.bincount(bins, minlength=count)  # rows
    image_rows = (np.arange(count) + 0.5) * STEP * scale[0] - 0.5
    pixel = thin * thin / (scale[0] * scale[1])  # of the resized image
    is_daytime = plot.family.scene.share > 0
    candidates: list[tuple[float, np.ndarray, int]] = []
    for number in np.flatnonzero(counts.any(axis=0)).tolist():
        amount = int(counts[:, number].sum())
        plant_row = plot.stalks[number].row
        if plant_row < 0 or (plant_row > 0 and not is_daytime) or amount * pixel < _FEW:
            continue
        sides = _sides(plot.stalks[number], pose, camera, image_rows)
        if sides is None:
            continue
        left, right, there = sides
        room = sampled * np.maximum(right - left, 1.0) / thin
        visible = np.where(there, np.minimum(counts[:, number] / np.maximum(room, 1e-6), 1.0), ABSENT)
        columns = np.stack([(left + 0.5) / scale[1], (right + 0.5) / scale[1], visible], axis=-1).astype(np.float32)
        kind = STALK if plant_row == 0 else UNCLEAR
        candidates.append((amount * (1.0 if kind == STALK else 1e-6), columns, kind))
    candidates.sort(key=lambda candidate: -candidate[0])
    candidates = candidates[:MAX_EDGES]
    edges = np.array([columns for _, columns, _ in candidates], np.float32).reshape(-1, count, 3)
    return edges, np.array([kind for _, _, kind in candidates], np.int32)


def _sides(stalk: Stalk, pose: Pose, camera: Calibration, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return the left and right columns [R] of a stalk at image ``rows`` [R], and a mask [R] of the rows that it reaches.

    Beyond its ends, columns are extrapolated. None if all of it is nearer than `_NEAR`, or less than two pixels tall.
    """
    heights = np.linspace(0.0, stalk.points[:, 2].max(), _HEIGHTS)
    # A tall stalk that leans over the camera has no projection there.
    heights = heights[np.interp(heights, stalk.points[:, 2], pose.to_camera(stalk.points)[:, 2]) >= _NEAR]
    if len(heights) < 2:
        return None
    edges = outline(stalk, pose, camera, heights)
    middle = edges[:, :, 1].mean(axis=1)
    if np.ptp(middle) < 2.0:
        return None
    left, right = (_interpolate(rows, edges[:, side, 1], edges[:, side, 0]) for side in (0, 1))
    return left, right, (rows >= middle.min()) & (rows <= middle.max())


def _interpolate(rows: np.ndarray, at: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate ``values`` at rows ``at`` linearly, and extrapolate them by the slope of their ends."""
    order = np.argsort(at)
    at, values = at[order], values[order]
    reach = max(len(at) // 20, 1)
    inner = np.interp(rows, at, values)
    for end, other in ((0, reach), (-1, -1 - reach)):
        slope = (values[end] - values[other]) / (at[end] - at[other]) if at[end] != at[other] else 0.0
        beyond = rows < at[0] if end == 0 else rows > at[-1]
        inner = np.where(beyond, values[end] + slope * (rows - at[end]), inner)
    return inner


def boxes_around_edges(edges: np.ndarray) -> np.ndarray:
    """Return the boxes [T, 4] float32 around the visible rows of edges [T, R, 3]; (0, 0, 0, 0) for stalks without such rows."""
    boxes = np.zeros((len(edges), 4), np.float32)
    for box, columns in zip(boxes, edges):
        rows = np.flatnonzero(columns[:, 2] > UNKNOWN)
        if len(rows):
            box[:] = columns[rows, 0].min(), rows[0] * STEP, columns[rows, 1].max(), (rows[-1] + 1) * STEP
    return boxes


def cut_edges(edges: Edges, top: int, left: int, height: int) -> Edges:
    """Return the edges in a crop of ``height`` rows that begins at row ``top``, a multiple of `STEP`, and column ``left``."""
    first = top // STEP
    rows = edges[0][:, first : first + -(-height // STEP)] - np.array([left, left, 0], np.float32)
    return rows, edges[1]


def stack_edges(edges: Sequence[Edges | None], height: int) -> Edges:
    """Batch the edges of N images padded to ``height`` pixels: edges [N, T, R, 3] and kinds [N, T], T being `MAX_EDGES`.

    Images whose edges are None have no stalks.
    """
    rows = -(-height // STEP)
    batch, kinds = np.zeros((len(edges), MAX_EDGES, rows, 3), np.float32), np.full((len(edges), MAX_EDGES), NOTHING, np.int32)
    batch[..., 2] = ABSENT
    for part, kind, of_image in zip(batch, kinds, edges):
        if of_image is not None:
            count = min(of_image[0].shape[1], rows)
            part[: len(of_image[0]), :count], kind[: len(of_image[1])] = of_image[0][:, :count], of_image[1]
            # The last band may be padded: edges go on straight there, so that its sections have the right slope.
            more = np.arange(1, rows - count + 1)[:, None]
            last = part[:, max(count - 1, 0), None, :2]
            part[:, count:, :2] = last + more * (last - part[:, max(count - 2, 0), None, :2])
    return batch, kinds


def annotated_edges(
    stalks: np.ndarray, kinds: np.ndarray, masks: list[np.ndarray | None], shape: tuple[int, int], scale: tuple[float, float]
) -> Edges:
    """Compute the edges of annotated stalks.

    Annotations need not contain a whole stalk: along its axis beyond the box, to the top and bottom of the image, its
    visibility is `UNKNOWN`, so that these sections are neither targets nor background.

    Args:
        stalks: Boxes and axes [N, 6] in the original image.
        kinds: Kinds [N] int32.
        masks: Mask [H, W] bool of each stalk; None if it has only a box.
        shape: Height and width of the resized image.
        scale: Vertical and horizontal factors from coordinates of the resized image to those of the original.
    """
    count = -(-shape[0] // STEP)
    rows = (np.arange(count) + 0.5) * STEP * scale[0]
    edges = np.zeros((min(len(stalks), MAX_EDGES), count, 3), np.float32)
    for columns, stalk, mask in zip(edges, stalks, masks):
        box_left, top, box_right, bottom, above, below = stalk
        half = 0.5 * max(float(box_right - box_left - abs(below - above)), 1.0)
        axis = above + (below - above) * (rows - top) / max(float(bottom - top), 1.0)
        left, right = axis - half, axis + half
        there = (rows >= top) & (rows <= bottom)
        visible = np.where(there, 1.0, UNKNOWN)
        filled = None if mask is None else np.flatnonzero(mask.any(axis=1))
        if mask is not None and filled is not None and len(filled) > 1:
            first = mask.argmax(axis=1)[filled].astype(float)
            last = mask.shape[1] - mask[:, ::-1].argmax(axis=1)[filled].astype(float)
            inside = (rows >= filled[0]) & (rows <= filled[-1] + 1)
            left = np.where(inside, np.interp(rows, filled + 0.5, first), left)
            right = np.where(inside, np.interp(rows, filled + 0.5, last), right)
            shown = np.isin(rows.astype(int), filled)
            visible = np.where(inside, np.where(shown, 1.0, 0.0), UNKNOWN)
        columns[:] = np.stack([left / scale[1], right / scale[1], visible], axis=-1)
    return edges, np.asarray(kinds[:MAX_EDGES], np.int32)
