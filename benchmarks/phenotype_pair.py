"""Time and memory for one pair of 9 megapixels, from arrays in memory: `python benchmarks/phenotype_pair.py`.

Finding, outlining, disparity, ground and widths; a synthetic pair of the shifted family; decoding of files is not in it. Parts
are timed one after the other in repeats of their own; in the whole, the ground is found while the networks compute.
``--workers 1 8 14`` says how long a pair takes where so many processes look at pairs, as with `phenotype run --workers`.
"""

import argparse
import functools
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.evaluation_pool import processes, share_accelerator
from jaxrl_vis.phenotyping.detector.detect import detect, pad
from jaxrl_vis.phenotyping.detector.finder import Finder, reduce
from jaxrl_vis.phenotyping.detector.weights import SHIPPED, read_weights
from jaxrl_vis.phenotyping.ground import find_ground
from jaxrl_vis.phenotyping.sightings import find_with_ground, grey_of, look
from jaxrl_vis.provenance import device_name
from jaxrl_vis_envs.plants import SHIFTED, Calibration, draw
from jaxrl_vis_envs.plants.pairs import Sequence
from jaxrl_vis_envs.plants.truth import stalks_in_view


def timed(run: Callable[[], Any], repeats: int) -> list[float]:
    """Seconds of each repeat, after one that compiles."""
    run()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        run()
        times.append(time.perf_counter() - started)
    return times


def pairs_a_second(workers: int, seconds: float, pairs: list[tuple[np.ndarray, np.ndarray]], stated: Calibration) -> None:
    """Prints how long a pair takes where so many processes look at pairs side by side, each at one of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        np.savez(path / "pairs.npz", *[image for pair in pairs for image in pair])
        with processes(workers) as each:
            work = functools.partial(_work, path, workers, seconds, stated)
            counts = list(each(work, range(workers)))
    total, finds = sum(count for count, _ in counts), [found for _, found in counts]
    assert len({tuple(each) for each in finds}) > 1 or workers < 2, "all pairs gave the same"
    print(f"{workers} processes: {seconds / total:.4f} s a pair ({total} pairs in {seconds:.0f} s)")


def _work(folder: Path, workers: int, seconds: float, stated: Calibration, index: int) -> tuple[int, list[float]]:
    """What one process does: pairs from arrays in memory, once all are ready; how many, and the widths of the last one."""
    images = list(np.load(folder / "pairs.npz").values())
    pairs = list(zip(images[::2], images[1::2]))
    params, settings, _ = read_weights(SHIPPED)
    finder, widths = Finder(params, settings), []

    def once(number: int) -> list[float]:
        left, right = pairs[(index + number) % len(pairs)]
        detections, ground = find_with_ground(finder, left, right, stated)
        return [each.diameter_mm or 0.0 for each in look(detections, left, right, stated, ground=ground)]

    for number in range(len(pairs)):
        once(number)
    (folder / f"ready_{index}").touch()
    while len(list(folder.glob("ready_*"))) < workers:
        time.sleep(0.01)
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        widths = once(count)
        count += 1
    return count, widths


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Time and memory for one synthetic pair.")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--width", type=int, default=3376, help="of an image, pixels")
    parser.add_argument(
        "--workers", type=int, nargs="*", default=[], help="processes side by side; several numbers, one by one"
    )
    parser.add_argument("--seconds", type=float, default=10.0, help="how long each number of them is timed")
    options = parser.parse_args()
    if options.workers:
        share_accelerator()
    family = SHIFTED.at_width(options.width)
    sequence = Sequence.of(draw(family, 3))
    pair = sequence[15]
    left, right, stated = np.asarray(pair.left), np.asarray(pair.right), sequence.drive.stated
    params, settings, _ = read_weights(SHIPPED)
    finder = Finder(params, settings)

    def once() -> tuple[Any, Any, list[Any]]:
        """What a pair says: finds, ground and sightings."""
        detections, ground = find_with_ground(finder, left, right, stated)
        return detections, ground, look(detections, left, right, stated, ground=ground)

    started = time.perf_counter()
    detections, ground, sightings = once()
    first = time.perf_counter() - started
    measured = sum(each.diameter_mm is not None for each in sightings)
    whole = timed(once, options.repeats)
    print(f"{left.shape[1]} x {left.shape[0]}, {len(detections)} finds, {measured} measured, on {device_name()}")
    print(f"{np.median(whole):.3f} s a pair (least {min(whole):.3f}); the first one, which compiles, {first:.1f} s")
    small = pad(reduce(left, settings.width)[0])
    dtype = finder.dtype
    parts = {
        "image to the device": lambda: jax.block_until_ready(jax.device_put(left)),
        "reduced image": lambda: reduce(left, settings.width),
        "detector": lambda: jax.block_until_ready(detect(params["detector"], small, settings, dtype)),
        "all of finding, with masks and edges": lambda: finder(left),
        "ground, beside that": lambda: find_ground(grey_of(left), grey_of(right), stated),
        "disparities and widths": lambda: look(detections, left, right, stated, ground=ground),
    }
    for name, part in parts.items():
        print(f"  {np.median(timed(part, options.repeats)):.4f} s  {name}")
    print("what an evaluated pair costs besides:")
    on_device = (pair.left, pair.right, pair.instance, pair.depth)
    truth = np.asarray(pair.instance), np.asarray(pair.depth)
    others = {
        "drawing both images, with their truth": lambda: jax.block_until_ready((sequence[15].left, sequence[15].right)),
        "images and truth to the host": lambda: jax.device_get([jnp.copy(each) for each in on_device]),
        "truth of the stalks": lambda: stalks_in_view(sequence.plot, pair.pose, sequence.drive.true, *truth),
    }
    for name, part in others.items():
        print(f"  {np.median(timed(part, min(options.repeats, 3))):.4f} s  {name}")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB, drawing the pair included")
    if options.workers:
        some = [sequence[frame] for frame in (5, 12, 19, 26)]
        images = [(np.asarray(each.left), np.asarray(each.right)) for each in some]
        for workers in options.workers:
            pairs_a_second(workers, options.seconds, images, stated)
