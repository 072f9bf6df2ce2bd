"""Time and memory for one pair of 9 megapixels, from arrays in memory: `python benchmarks/phenotype_pair.py`.

Finding, outlining, disparity, ground and widths; a synthetic pair of the shifted family; decoding of files is not in it.
"""

import argparse
import resource
import time

import jax
import numpy as np

from jaxrl_vis.phenotyping.detector.finder import Finder
from jaxrl_vis.phenotyping.detector.weights import SHIPPED, read_weights
from jaxrl_vis.phenotyping.ground import find_ground
from jaxrl_vis.phenotyping.sightings import grey_of, look
from jaxrl_vis_envs.plants import SHIFTED, draw
from jaxrl_vis_envs.plants.pairs import Sequence

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Time and memory for one synthetic pair.")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    sequence = Sequence.of(draw(SHIFTED, 3))
    pair = sequence[15]
    left, right, stated = np.asarray(pair.left), np.asarray(pair.right), sequence.drive.stated
    params, settings, _ = read_weights(SHIPPED)
    finder = Finder(params, settings)

    def once() -> int:
        """Finds and measures; how many stalks were measured."""
        detections = finder(left)
        ground = find_ground(grey_of(left), grey_of(right), stated)
        return sum(each.diameter_mm is not None for each in look(detections, left, right, stated, ground=ground))

    started = time.perf_counter()
    measured = once()
    first = time.perf_counter() - started
    times = []
    for _ in range(options.repeats):
        started = time.perf_counter()
        once()
        times.append(time.perf_counter() - started)
    print(f"{left.shape[1]} x {left.shape[0]}, {measured} stalks measured, on {jax.devices()[0].device_kind}")
    print(f"{np.median(times):.3f} s a pair (least {min(times):.3f}); the first one, which compiles, {first:.1f} s")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB, drawing the pair included")
