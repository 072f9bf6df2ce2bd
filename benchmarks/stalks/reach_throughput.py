"""Throughput of simulated reaches, in reaches per second.

    python -m benchmarks.stalks.reach_throughput [--arms 1000] [--wind 10] [--json FILE]

Each arm reaches for a stalk among 6 stalks in wind, with the true position as its target. The first call compiles; the result
is the median of the following three, from arrays on the host to arrays on the host.
"""

import argparse
import json
import os
import pathlib
import sys
import time
from typing import Any

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "envs")]

import jax  # noqa: E402
import numpy as np  # noqa: E402

from jaxrl_vis.stalks.grasping.arm.reach import reach  # noqa: E402
from jaxrl_vis_envs.plants import TRAINING, draw  # noqa: E402
from jaxrl_vis_envs.plants.stand import stands_at  # noqa: E402

_PLOTS = 16


def scenes(arms: int, seed: int = 0) -> tuple[Any, np.ndarray]:
    """Draw stands and targets [arms, 3] (m): stalks of a few plots at heights of 0.5 to 0.9 m, masts within 0.1 m of them."""
    rng = np.random.default_rng(seed)
    plots = [draw(TRAINING, seed * _PLOTS + index) for index in range(_PLOTS)]
    chosen = [plots[rng.integers(_PLOTS)] for _ in range(arms)]
    targets = np.array([plot.measured[rng.integers(len(plot.measured))].at_height(rng.uniform(0.5, 0.9))[0] for plot in chosen])
    return stands_at(chosen, targets[:, 0] + rng.uniform(-0.1, 0.1, arms), targets), targets


def main() -> int:
    """Print the result, and write it to a file if requested; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=1000)
    parser.add_argument("--wind", type=float, default=10.0, help="mm")
    parser.add_argument("--json", type=pathlib.Path)
    options = parser.parse_args()
    stands, targets = scenes(options.arms)
    seconds = []
    for _ in range(4):
        began = time.perf_counter()
        result = reach(stands, targets, jax.random.key(0), options.wind)
        seconds.append(time.perf_counter() - began)
    rate = options.arms / float(np.median(seconds[1:]))
    kind = jax.devices()[0].device_kind
    device = f"{os.cpu_count()} CPU cores" if jax.default_backend() == "cpu" else kind
    print(f"{rate:,.1f} reaches/s, {options.arms} arms at once, on {device}; {seconds[0] - seconds[1]:.0f} s to compile")
    print(f"{result.reachable.mean():.1%} can be reached; {1000 * np.nanmedian(result.error):.2f} mm off in the median")
    if options.json:
        record = {"name": "grasp/reaches", "value": rate, "unit": "1/s", "arms": options.arms, "wind_mm": options.wind}
        options.json.write_text(json.dumps({**record, "device": device, "jax": jax.__version__}, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
