"""Error of widths with perfect detection and masks: `python -m benchmarks.stalks.perfect_masks`.

Synthetic pairs with true masks of the band around 12 inches. Our disparities and widths are compared with the diameter that
faces the cameras at the measured height, sheaths included. Errors of detection and segmentation come on top.
"""

import argparse

import numpy as np

from jaxrl_vis.stalks.phenotyping.measure.stalk import measure_stalk
from jaxrl_vis_envs.plants import FAMILIES, Family, draw
from jaxrl_vis_envs.plants.pairs import Sequence
from jaxrl_vis_envs.plants.truth import outline, stalks_in_view


def to_grey_floats(image: np.ndarray) -> np.ndarray:
    """Convert an image [H, W] or [H, W, 3] of any dtype to greyscale [H, W] float32."""
    return (
        image.astype(np.float32) if image.ndim == 2 else image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    )


def width_errors(family: Family, seed: int, frame: int) -> list[dict[str, float]]:
    """Measure the stalks of one rendered stereo pair on their true masks.

    Args:
        family: Family of the plot.
        seed: Seed of the plot.
        frame: Index of the pair in its sequence.

    Returns:
        For each stalk that is at least 0.3 visible, its visible fraction ``seen``, the error of the ``strip`` and ``ellipse``
        methods (mm), and the ``confidence`` of the latter; stalks that a method cannot measure are left out.
    """
    sequence = Sequence.of(draw(family, seed))
    pair, drive = sequence[frame], sequence.drive
    instance = np.asarray(pair.instance)
    left, right = to_grey_floats(np.asarray(pair.left)), to_grey_floats(np.asarray(pair.right))
    rows = []
    for view in stalks_in_view(sequence.plot, pair.pose, drive.true, instance, np.asarray(pair.depth)):
        if view.band_box is None or view.band_visible < 0.3:
            continue
        begin, top, end, bottom = (round(edge) for edge in view.band_box)
        begin, top = max(begin - 3, 0), max(top, 0)
        mask = instance[top : bottom + 1, begin : end + 4] == view.stalk
        stalk = sequence.plot.stalks[view.stalk]
        row = {"seen": view.band_visible}
        for method in ("strip", "ellipse"):
            measurement = measure_stalk(mask, (top, begin), left, right, drive.stated, method=method)
            if measurement.diameter_mm is None:
                break
            heights = np.linspace(0.0, 0.6, 1201)
            image_rows = outline(stalk, pair.pose, drive.true, heights)[:, :, 1].mean(axis=1)
            height = float(heights[np.argmin(np.abs(image_rows - measurement.row))])
            # Near a node, the true diameter is the mean of those above and below it.
            offsets = (0.02, -0.02) if stalk.node_distance(height) < 0.01 else (0.0,)
            true = 1e3 * float(np.mean([stalk.diameter(height + offset) for offset in offsets]))
            row |= {method: measurement.diameter_mm - true, "confidence": measurement.confidence}
        else:
            rows.append(row)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Error of widths with perfect masks, on synthetic pairs.")
    parser.add_argument("--family", choices=FAMILIES, default="training")
    parser.add_argument("--pairs", type=int, default=3, help="one of each plot")
    parser.add_argument("--width", type=int, default=3376, help="of an image, pixels")
    options = parser.parse_args()
    family = FAMILIES[options.family].at_width(options.width)
    rows = [row for seed in range(options.pairs) for row in width_errors(family, 5000 + seed, family.rig.frames // 2)]
    print("synthetic, family", family.name)
    for min_confidence in (0.0, 0.5, 0.8):
        confident = [row for row in rows if row["confidence"] >= min_confidence]
        if not confident:
            break
        for method in ("strip", "ellipse"):
            errors = np.array([row[method] for row in confident])
            size = np.abs(errors)
            text = f"mean absolute {size.mean():.2f}, median absolute {np.median(size):.2f}, bias {errors.mean():+.2f} mm"
            print(f"{method:8} confidence >= {min_confidence:.1f}: {len(confident)} of {len(rows)} stalks, {text}")
