"""Time and memory for one pair of 9-megapixel images, as arrays in memory: `python -m benchmarks.stalks.phenotype_pair`.

Covers detection, segmentation, disparity, ground and widths of a synthetic pair of the shifted family, without decoding of
files. Parts are timed separately; in the whole, the ground is found while the networks compute. ``--workers 1 8 14`` gives the
time per pair with each of these numbers of processes, as with `phenotype run --workers`.
"""

import functools
import resource
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.stalks.worker_rate import Once, parse_options, print_rate, time_repeats
from jaxrl_vis.host.provenance import device_name
from jaxrl_vis.stalks.phenotyping.detector.detect import detect, pad_image
from jaxrl_vis.stalks.phenotyping.detector.finder import Finder, resize
from jaxrl_vis.stalks.phenotyping.detector.weights import SHIPPED, read_weights
from jaxrl_vis.stalks.phenotyping.measure.ground import find_ground
from jaxrl_vis.stalks.phenotyping.track.pairing import PairView, view_pair
from jaxrl_vis.stalks.phenotyping.track.sightings import USUAL_DISTANCE, measure_pair, to_grey_bytes
from jaxrl_vis_envs.plants import SHIFTED, Calibration, draw
from jaxrl_vis_envs.plants.pairs import Sequence
from jaxrl_vis_envs.plants.truth import stalks_in_view


def make(path: Path, stated: Calibration) -> tuple[Once, int]:
    """Return a function that processes the pair with an index in a file, and the number of pairs; see `print_rate`."""
    images = list(np.load(path).values())
    pairs = list(zip(images[::2], images[1::2]))
    params, settings, _ = read_weights(SHIPPED)
    finder = Finder(params, settings)

    def once(number: int) -> list[float]:
        left, right = pairs[number]
        return [sighting.diameter_mm or 0.0 for sighting in view_pair(finder, left, right, stated).sightings]

    return once, len(pairs)


if __name__ == "__main__":
    asked = parse_options()
    family = SHIFTED if asked.width is None else SHIFTED.at_width(asked.width)
    sequence = Sequence.of(draw(family, 3))
    pair = sequence[15]
    left, right, stated = np.asarray(pair.left), np.asarray(pair.right), sequence.drive.stated
    params, settings, _ = read_weights(SHIPPED)
    finder = Finder(params, settings)

    def once() -> PairView:
        """Process one pair."""
        return view_pair(finder, left, right, stated)

    started = time.perf_counter()
    view = once()
    detections, ground = view.detections, view.ground
    first = time.perf_counter() - started
    measured = sum(sighting.diameter_mm is not None for sighting in view.sightings)
    seconds = time_repeats(once, asked.repeats)
    print(f"{left.shape[1]} x {left.shape[0]}, {len(detections)} detections, {measured} measured, on {device_name()}")
    print(f"{np.median(seconds):.3f} s a pair (least {min(seconds):.3f}); the first one, which compiles, {first:.1f} s")
    pixels_per_metre = stated.focal / USUAL_DISTANCE
    small = pad_image(resize(left, settings, pixels_per_metre)[0])
    dtype = finder.dtype
    parts = {
        "image to the device": lambda: jax.block_until_ready(jax.device_put(left)),
        "reduced image": lambda: resize(left, settings, pixels_per_metre),
        "detector": lambda: jax.block_until_ready(detect(params["detector"], small, settings, dtype)),
        "all of finding, with masks and edges": lambda: finder(left, pixels_per_metre),
        "ground, beside that": lambda: find_ground(to_grey_bytes(left), to_grey_bytes(right), stated),
        "disparities and widths": lambda: measure_pair(detections, left, right, stated, ground=ground),
    }
    for name, part in parts.items():
        print(f"  {np.median(time_repeats(part, asked.repeats)):.4f} s  {name}")
    print("what an evaluated pair costs besides:")
    on_device = (pair.left, pair.right, pair.instance, pair.depth)
    truth = np.asarray(pair.instance), np.asarray(pair.depth)
    others = {
        "drawing both images, with their truth": lambda: jax.block_until_ready((sequence[15].left, sequence[15].right)),
        "images and truth to the host": lambda: jax.device_get([jnp.copy(array) for array in on_device]),
        "truth of the stalks": lambda: stalks_in_view(sequence.plot, pair.pose, sequence.drive.true, *truth),
    }
    for name, part in others.items():
        print(f"  {np.median(time_repeats(part, min(asked.repeats, 3))):.4f} s  {name}")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB, drawing the pair included")
    if asked.workers:
        some = [sequence[frame] for frame in (5, 12, 19, 26)]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "pairs.npz"
            np.savez(path, *[np.asarray(image) for pair in some for image in (pair.left, pair.right)])
            for workers in asked.workers:
                print_rate(functools.partial(make, path, stated), workers, asked.seconds)
