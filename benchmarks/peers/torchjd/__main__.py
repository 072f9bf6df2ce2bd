"""Compare our weightings with TorchJD's: results (equality) or time (cost).

    python -m benchmarks.peers.torchjd equality --python PYTHON [--jacobians 1000]
    python -m benchmarks.peers.torchjd cost --python PYTHON [--losses 2 4 8 16] [--width 576] [--batch-size 256] [--repeats 20]

PYTHON is the interpreter of an environment with torchjd[full] (see the package). Records: weighting_parity.json,
weighting_cost-DEVICE.json. The exit status of equality is 1 if a method exceeds its tolerance.
"""

import argparse
import concurrent.futures
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.peers.torchjd.jacobians import COUNTS, draw
from jaxrl_vis.host import provenance
from jaxrl_vis.host.files import write_atomically

RESULTS = Path(__file__).resolve().parents[2] / "results"
PARITY = "weighting_parity.json"


def run_peer(python: Path, script: str, *arguments: str) -> None:
    """Run a script of this folder in the peer's environment; its output passes through.

    Raises:
        subprocess.CalledProcessError: The script failed.
    """
    subprocess.run([str(python), str(Path(__file__).with_name(script)), *arguments], check=True)


def equality(python: Path, jacobians: int, results: Path) -> int:
    """Compute the results of both sides in parallel, compare them, and write the record; return the exit status."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from benchmarks.peers.torchjd import ours

    arrays = draw(jacobians // len(COUNTS))
    with tempfile.TemporaryDirectory() as folder, concurrent.futures.ThreadPoolExecutor(1) as pool:
        inputs, outputs = Path(folder) / "jacobians.npz", Path(folder) / "results.npz"
        np.savez(inputs, **arrays)  # pyright: ignore[reportArgumentType]
        peer = pool.submit(run_peer, python, "peer.py", str(inputs), str(outputs))
        mine = ours.results(arrays)
        peer.result()
        theirs = dict(np.load(outputs))
    return keep(arrays, mine, theirs, results)


def keep(arrays: dict[str, np.ndarray], ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray], results: Path) -> int:
    """Compare the results of both libraries, print and write the record; return 1 if a method exceeds its tolerance, else 0.

    Removes ``versions`` from ``theirs``.
    """
    from benchmarks.peers.torchjd import equality

    versions = dict(str(line).split(" ") for line in theirs.pop("versions"))
    rows = equality.compare(arrays, ours, theirs)
    for row in rows:
        print("  ".join(f"{name} {value:.2g}" if isinstance(value, float) else str(value) for name, value in row.items()))
    jacobians = sum(len(value) for name, value in arrays.items() if name.endswith("/jacobians"))
    record = {"versions": {**provenance.versions(), **versions}, "jacobians": jacobians, "losses": COUNTS, "rows": rows}
    write_atomically(results / PARITY, json.dumps(record, indent=1) + "\n")
    wrong = equality.failures(rows)
    print(f"beyond what is allowed: {', '.join(wrong)}" if wrong else "all within what is allowed")
    return int(bool(wrong))


def main() -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    actions = parser.add_subparsers(dest="action", required=True)
    commands = {name: actions.add_parser(name) for name in ("equality", "cost")}
    for command in commands.values():
        command.add_argument("--results", type=Path, default=RESULTS, help="folder of records")
        command.add_argument("--python", type=Path, help="interpreter with TorchJD", required=command is commands["equality"])
    commands["equality"].add_argument("--jacobians", type=int, default=1000)
    cost_options = commands["cost"]
    cost_options.add_argument("--losses", type=int, nargs="+", default=[2, 4, 8, 16], help="numbers of losses")
    cost_options.add_argument("--width", type=int, default=576, help="of the trunk's three layers: 576 for 1 M parameters")
    cost_options.add_argument("--batch-size", type=int, default=256)
    cost_options.add_argument("--repeats", type=int, default=20)
    options = parser.parse_args()
    if options.action == "equality":
        minimum = len(COUNTS) * max(COUNTS)
        if options.jacobians < minimum:
            parser.error(f"--jacobians must be at least {minimum}, for some of every rank")
        return equality(options.python, options.jacobians, options.results)
    from benchmarks.peers.torchjd import cost

    size = cost.Size(tuple(options.losses), options.width, options.batch_size, options.repeats)
    return cost.measure_all(size, options.python, options.results)


if __name__ == "__main__":
    sys.exit(main())
