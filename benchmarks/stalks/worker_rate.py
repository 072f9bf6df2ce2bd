"""Rate of a job run by several processes in parallel; for the other scripts of this folder."""

import argparse
import functools
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from jaxrl_vis.host.worker_pool import share_accelerator, worker_pool

Once = Callable[[int], list[float]]
"""Function that runs the job once on the input of that index, and returns numbers that characterise the result."""


def time_repeats(run: Callable[[], object], repeats: int) -> list[float]:
    """Return the time of each repeat, s, after a first call that compiles."""
    run()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        run()
        times.append(time.perf_counter() - started)
    return times


def parse_options() -> argparse.Namespace:
    """Parse the options of the scripts; with workers, let processes share the GPU."""
    parser = argparse.ArgumentParser(description="Time and memory for one synthetic pair.")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--workers", type=int, nargs="*", default=[], help="processes side by side; several numbers, one by one"
    )
    parser.add_argument("--seconds", type=float, default=10.0, help="how long each number of them is timed")
    parser.add_argument("--width", type=int, help="of an image, pixels, instead of the family's")
    parsed = parser.parse_args()
    if parsed.workers:
        share_accelerator()
    return parsed


def print_rate(make: Callable[[], tuple[Once, int]], workers: int, seconds: float, count: float = 1.0) -> None:
    """Print the time per pair with several parallel processes, each working on its own pairs.

    Args:
        make: Function called in each process; returns the job and the number of inputs, all processed once before timing.
        workers: Number of processes.
        seconds: Duration of the timing, once all are ready, s.
        count: Number of pairs per call of the job.
    """
    with tempfile.TemporaryDirectory() as folder:
        with worker_pool(workers) as pool:
            counts = list(pool(functools.partial(_work, make, Path(folder), workers, seconds), range(workers)))
    pairs = sum(counts) * count
    print(f"{workers} processes: {seconds / pairs:.4f} s a pair ({pairs:.0f} pairs in {seconds:.0f} s)")


def _work(make: Callable[[], tuple[Once, int]], folder: Path, workers: int, seconds: float, index: int) -> int:
    """Run the job in one process, and return the number of completed calls."""
    once, inputs = make()
    results = {tuple(once(number)) for number in range(inputs)}
    assert len(results) > 1 or inputs < 2, "all pairs gave the same"
    (folder / f"ready_{index}").touch()
    while len(list(folder.glob("ready_*"))) < workers:
        time.sleep(0.01)
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        once((index + count) % inputs)
        count += 1
    return count
