"""Writing of synthetic plots: folders of stereo pairs with calibration, odometry and ground truth.

    family.json          family that the plots are sampled from
    plot_0000/
        left_000.png  right_000.png  ...
        calibration.yaml     stated calibration, which may deviate from the true one; OpenCV
        odometry.csv         pair, file names, time_s, distance_m
        annotations.json     COCO: a box and a mask for each stalk of the near row in each left image
        truth/               instance_000.png  disparity_000.png
        plot.json            count, diameters of each stalk, true cameras; written last, it marks the plot as complete

A complete plot is not rendered again, so an interrupted command continues where it stopped; a plot with less of the ground
truth than requested is rendered again.
"""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np

import jaxrl_vis
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.host.spreadsheets import to_csv
from jaxrl_vis.stalks.phenotyping.io.annotations import make_coco
from jaxrl_vis.stalks.phenotyping.io.calibration import write_calibration
from jaxrl_vis.stalks.phenotyping.io.images import SUFFIX, ImageFormat, write_image
from jaxrl_vis.stalks.phenotyping.io.masks import encode_mask
from jaxrl_vis_envs.documents import parse_json
from jaxrl_vis_envs.plants import Family, Plot, draw
from jaxrl_vis_envs.plants.pairs import Pair, Sequence
from jaxrl_vis_envs.plants.truth import BAND, HEIGHTS, StalkInView, stalks_in_view

Truth = Literal["all", "boxes", "none"]
DISPARITY_SCALE = 64.0
"""Scale of disparity images: uint16 values are the disparity in pixels times this, or 0 if there is none."""
SCHEMA = 1


def write_plots(
    folder: Path,
    family: Family,
    seeds: range,
    image_format: ImageFormat = "png",
    truth: Truth = "all",
    done: Callable[[int, int], None] = lambda plot, pair: None,
) -> int:
    """Write plots of a family.

    Args:
        folder: Folder to write to; created if missing.
        family: Family to sample from.
        seeds: Seeds, one per plot.
        image_format: Format of the camera images.
        truth: ``all``; ``boxes``, without masks and without disparity and instance images; or ``none``, only plot.json.
        done: Called after each pair with the plot's seed and the number of its pairs written so far, and once for a plot that
            exists.

    Returns:
        The number of plots that already existed.

    Raises:
        RequestError: The folder holds plots of another family.
        OSError: A file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    about = {"schema": SCHEMA, "synthetic": True, "version": jaxrl_vis.__version__, **dataclasses.asdict(family)}
    text = json.dumps(about, indent=2) + "\n"
    index = folder / "family.json"
    if index.exists() and _without_version(index.read_text(encoding="utf-8", errors="replace")) != _without_version(text):
        raise RequestError(f"{folder} holds plots of another family: choose another folder")
    write_atomically(index, text)
    present = 0
    for seed in seeds:
        description = folder / plot_name(seed) / "plot.json"
        if description.exists():
            if _is_complete(description.parent, truth, family.rig.frames):
                present += 1
                done(seed, family.rig.frames)
                continue
            description.unlink()  # incomplete until it is written again
            for image in [*description.parent.glob("left_*.*"), *description.parent.glob("right_*.*")]:
                image.unlink()  # may have another format
        write_plot(folder / plot_name(seed), draw(family, seed), image_format, truth, done)
    return present


def _is_complete(folder: Path, truth: Truth, frames: int) -> bool:
    """Return True if a plot that was written completely holds at least the requested ground truth."""
    maps = [folder / "truth" / f"{kind}_{frame:03d}.png" for kind in ("instance", "disparity") for frame in range(frames)]
    wanted = {"none": [], "boxes": [folder / "annotations.json"], "all": [folder / "annotations.json", *maps]}[truth]
    return all(path.exists() for path in wanted)


def plot_name(seed: int) -> str:
    """Return the folder name of the plot with a seed."""
    return f"plot_{seed:04d}"


def write_plot(folder: Path, plot: Plot, image_format: ImageFormat, truth: Truth, done: Callable[[int, int], None]) -> None:
    """Write one plot to its own folder, created if missing; files of the same names are replaced. See `write_plots`.

    Raises:
        OSError: A file cannot be written.
    """
    (folder / "truth").mkdir(parents=True, exist_ok=True)
    sequence = Sequence.of(plot)
    write_calibration(folder / "calibration.yaml", sequence.drive.stated)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    visible: list[dict[str, Any]] = []
    for pair in sequence:
        names = [f"{side}_{pair.frame:03d}{SUFFIX[image_format]}" for side in ("left", "right")]
        for name, image in zip(names, (pair.left, pair.right)):
            write_image(folder / name, np.asarray(image))
        instance, depth = np.asarray(pair.instance), np.asarray(pair.depth)
        if truth == "all":
            _write_maps(folder / "truth", pair, instance)
        if truth != "none":
            height, width = instance.shape
            images.append({"id": pair.frame + 1, "file_name": names[0], "width": width, "height": height})
            stalks = stalks_in_view(plot, pair.pose, sequence.drive.true, instance, depth)
            annotations += [_annotation(pair.frame, stalk, instance, truth == "all") for stalk in stalks if stalk.pixels]
            visible += [{"pair": pair.frame, **dataclasses.asdict(stalk)} for stalk in stalks]
        done(plot.seed, pair.frame + 1)
    write_atomically(folder / "odometry.csv", _odometry_csv(sequence, SUFFIX[image_format]))
    if truth != "none":
        text = f"synthetic stalks, family {plot.family.name}, seed {plot.seed}"
        write_atomically(folder / "annotations.json", json.dumps(make_coco(images, annotations, {"description": text})) + "\n")
    write_atomically(folder / "plot.json", json.dumps(_summary(sequence, visible)) + "\n")


def _write_maps(folder: Path, pair: Pair, instance: np.ndarray) -> None:
    scaled = np.round(np.asarray(pair.disparity) * DISPARITY_SCALE)
    write_image(folder / f"disparity_{pair.frame:03d}.png", np.clip(scaled, 0, 65535).astype(np.uint16))
    write_image(folder / f"instance_{pair.frame:03d}.png", np.clip(instance + 1, 0, 65535).astype(np.uint16))


def _annotation(frame: int, stalk: StalkInView, instance: np.ndarray, with_mask: bool) -> dict[str, Any]:
    assert stalk.visible_box is not None
    left, top, right, bottom = stalk.visible_box
    annotation: dict[str, Any] = {
        "image_id": frame + 1,
        "bbox": [left + 0.5, top + 0.5, right - left, bottom - top],
        "area": stalk.pixels,
        "stalk": stalk.stalk,
        "visible": round(stalk.visible, 4),
    }
    if with_mask:
        rows, columns = slice(int(top + 0.5), int(bottom + 0.5)), slice(int(left + 0.5), int(right + 0.5))
        mask = instance[rows, columns] == stalk.stalk
        annotation["segmentation"] = encode_mask(mask, (rows.start, columns.start), instance.shape)
    return annotation


def _odometry_csv(sequence: Sequence, suffix: str) -> str:
    rows = []
    for frame, (time, distance) in enumerate(zip(sequence.drive.times, sequence.drive.odometry)):
        images = {side: f"{side}_{frame:03d}{suffix}" for side in ("left", "right")}
        rows.append({"pair": frame, **images, "time_s": f"{time:.4f}", "distance_m": f"{distance:.5f}"})
    return to_csv(rows)


def _summary(sequence: Sequence, visible: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the contents of plot.json: lengths in m, except those named ``_mm``."""
    plot, drive = sequence.plot, sequence.drive
    stalks = []
    for index, stalk in enumerate(plot.measured):
        by_height = {}
        for height in HEIGHTS:
            by_height[f"{round(height / 0.0254)}in"] = {
                "diameter_mm": round(1e3 * stalk.diameter(height), 4),
                "bare_diameter_mm": round(1e3 * stalk.diameter(height, bare=True), 4),
                "node_distance_mm": round(1e3 * stalk.node_distance(height), 2),
            }
        foot = {"stalk": index, "x": float(stalk.points[0, 0]), "y": float(stalk.points[0, 1])}
        # Centre line in steps of 5 cm.
        line = [
            [*np.round(stalk.at_height(height)[0], 5).tolist(), round(1e3 * stalk.diameter(height), 3)]
            for height in np.arange(0.0, stalk.points[:, 2].max(), 0.05)
        ]
        stalks.append({**foot, "middle_line_x_y_z_diameter_mm": line, **by_height})
    return {
        "schema": SCHEMA,
        "synthetic": True,
        "family": plot.family.name,
        "seed": plot.seed,
        "count": len(plot.measured),
        "plot_length": plot.family.layout.plot_length,
        "stalks": stalks,
        "cameras": dataclasses.asdict(drive.true),
        "stated_cameras": dataclasses.asdict(drive.stated),
        "poses": [{"position": pose.position.tolist(), "rotation": pose.rotation.tolist()} for pose in drive.poses],
        "disparity_scale": DISPARITY_SCALE,
        "band": BAND,
        "seen": visible,
    }


def _without_version(text: str) -> dict[str, Any]:
    try:
        return {name: value for name, value in parse_json(text).items() if name != "version"}
    except (ValueError, AttributeError):
        return {}
