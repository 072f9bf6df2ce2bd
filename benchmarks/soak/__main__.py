"""Random faults injected into small real runs, each then resumed; and one long run that is killed once a minute.

    python -m benchmarks.soak [--minutes 9] [--workers 2] [--seed 0] [--faults 10000] [--json FILE]
    python -m benchmarks.soak --sigkill-every 60 [--preset cpu] [--minutes 60] [--env VisualFetchReach] [--json FILE]

**Faults.** Each run is `jaxrl-vis train Reacher` with small settings, in a process of its own, interrupted by faults and
resumed until it is finished. After every fault it is checked that

* no row of metrics.jsonl up to the last intact checkpoint is lost, and the newest checkpoint is at most one iteration older;
* there is no traceback, and the exit status is the one expected of the fault;

and at the end of a run that it has every row exactly once and, unless a replay was lost, which is counted, that its
metrics.jsonl equals that of an undisturbed run, bit for bit (except times). Faults with folders of their own
(`benchmarks.soak.alone`) are interleaved. Full and frozen disks need root, to mount small ones; otherwise a limit on file
sizes and SIGSTOP replace them. A violation is printed and recorded, its folder is kept, and the exit status is 1.

No fault begins in the last 45 s of --minutes, so that runs can finish. Soaks with different seeds on one commit, each with its
--json in benchmarks/results/soak, are added up by `make tables`.

**Goodput.** A run with the default intervals is killed at regular intervals and finally evaluated; then as many steps are
trained undisturbed. With --folder, a second call continues the same run, so that an hour can be split over several calls:
--no-reference skips the undisturbed run until the last one.
"""

import argparse
import concurrent.futures
import json
import sys
import tempfile
from pathlib import Path

from benchmarks.soak.goodput import report, train_undisturbed, train_with_kills
from benchmarks.soak.record import Record
from benchmarks.soak.soak import Soak

_TO_THE_END = 45.0  # seconds


def _soak(options: argparse.Namespace, folder: Path) -> int:
    def note(record: Record) -> None:
        if options.json is not None:
            record.write(options.json)

    soak = Soak(folder, options.faults, options.seed, 60.0 * options.minutes - _TO_THE_END, note)
    soak.train_reference()
    with concurrent.futures.ThreadPoolExecutor(options.workers) as pool:
        for future in [pool.submit(soak.work, worker) for worker in range(options.workers)]:
            future.result()
    note(soak.record)
    print(soak.record.table())
    return 1 if soak.record.broken else 0


def _goodput(options: argparse.Namespace, folder: Path) -> int:
    what = [options.env, "--preset", options.preset, "--seed", str(options.seed)]
    killed = train_with_kills(folder / "killed", options.sigkill_every, options.minutes, what)
    reference = None if options.no_reference else train_undisturbed(folder / "undisturbed", killed["env_steps"], what)
    figures = report(killed, options.sigkill_every, reference)
    if options.json is not None:
        options.json.write_text(json.dumps(Record(seed=options.seed).machine | figures, indent=1) + "\n")
    return 0


def main() -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=10_000, help="maximum number of faults")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=9.0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="folder of the runs; temporary by default")
    parser.add_argument("--json", type=Path, help="file of the record")
    parser.add_argument("--sigkill-every", type=float, metavar="SECONDS", help="measure the goodput of a long run instead")
    parser.add_argument("--env", default="VisualFetchReach", help="with --sigkill-every")
    parser.add_argument("--preset", default="cpu", help="with --sigkill-every")
    parser.add_argument("--no-reference", action="store_true", help="with --sigkill-every: skip the undisturbed run")
    options = parser.parse_args()
    folder = (options.folder or Path(tempfile.mkdtemp(prefix="soak-"))).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    return _soak(options, folder) if options.sigkill_every is None else _goodput(options, folder)


if __name__ == "__main__":
    sys.exit(main())
