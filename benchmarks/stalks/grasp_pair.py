"""Time from one pair of 1,024 x 1,024 images, as arrays in memory, to its grasp points.

    python -m benchmarks.stalks.grasp_pair [--workers 1 8 15]

Covers matching, masks, point clouds, stitching and grasp points of runs of five pairs of the shifted family, without rendering.
``--workers`` gives the time per pair with that number of processes, as with `grasp eval --workers`.
"""

import functools
import pickle
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.stalks.worker_rate import Once, parse_options, print_rate
from jaxrl_vis.host.provenance import device_name
from jaxrl_vis.stalks.grasping.evaluation.scoring import Scene, draw_scene
from jaxrl_vis.stalks.grasping.masks.painter import SHIPPED, Painter, read_weights
from jaxrl_vis.stalks.grasping.perception.perceive import Perception, perceive
from jaxrl_vis_envs.plants.grasping import GRASPING_FAMILIES


def perceive_scene(scene: Scene, painter: Painter) -> Perception:
    """Compute the perception of all pairs of a run."""
    return perceive(scene.views, lambda image, _: painter(image), scene.drive.stated, scene.mount)


def make(path: Path) -> tuple[Once, int]:
    """Return a function that processes the scene with an index in a file, and the number of scenes; see `print_rate`."""
    scenes = pickle.loads(path.read_bytes())
    params, settings, _ = read_weights(SHIPPED)
    painter = Painter(params, settings)

    def once(number: int) -> list[float]:
        return [float(value) for point in perceive_scene(scenes[number], painter).points for value in point.point]

    return once, len(scenes)


if __name__ == "__main__":
    asked = parse_options()
    family = GRASPING_FAMILIES["shifted"]
    family = family if asked.width is None else family.at_width(asked.width)
    scenes = [draw_scene(family, seed) for seed in range(3)]
    params, settings, _ = read_weights(SHIPPED)
    painter = Painter(params, settings)
    started = time.perf_counter()
    perceive_scene(scenes[0], painter)
    first = time.perf_counter() - started
    runs = [perceive_scene(scenes[number % len(scenes)], painter) for number in range(asked.repeats)]
    assert len({str([point.point for point in run.points]) for run in runs}) > 1, "all runs gave the same"
    count = len(scenes[0].views)
    height, width = scenes[0].views[0].left.shape[:2]
    seconds = [sum(run.seconds.values()) / count for run in runs]
    print(f"{width} x {height}, runs of {count} pairs, {len(runs[0].points)} grasp points in the first, on {device_name()}")
    print(f"{np.median(seconds):.3f} s a pair (least {min(seconds):.3f}); the first run, which compiles, {first:.1f} s")
    for name in runs[0].seconds:
        print(f"  {np.median([run.seconds[name] / count for run in runs]):.4f} s  {name}")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB, drawing the pairs included")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenes.pickle"
        path.write_bytes(pickle.dumps(scenes))
        for workers in asked.workers:
            print_rate(functools.partial(make, path), workers, asked.seconds, count)
