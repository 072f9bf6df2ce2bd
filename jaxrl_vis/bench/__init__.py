"""Measures one machine and keeps a record, so that a change can be told from noise and from another machine.

    settings -> render | physics | env | update | train -> Measurement -> record -> staleness, tables

Every benchmark varies the state of each environment, asserts that the results differ, warms up, waits for the device, repeats,
and reports the median; compilation is timed separately. `conditions` says which figures may be compared, `record` keeps them
and prints each change, `staleness` finds records that are older than the code they measured, and `tables` writes the README's
tables from those in benchmarks/results.
"""

import importlib
from pathlib import Path
from typing import Any

from jaxrl_vis.bench.conditions import Watch
from jaxrl_vis.bench.record import Measurement, compare_and_keep, load, results_path, write_json
from jaxrl_vis.bench.settings import Settings

BENCHMARKS = ("render", "physics", "env", "update", "train")


def run(benchmark: str, results: Path | None = None, json: Path | None = None, **settings: Any) -> list[Measurement]:
    """Runs one benchmark, prints and keeps its records.

    Args:
        benchmark: One of `BENCHMARKS`.
        results: Folder of kept records; None for the user's cache, see `record.user_folder`.
        json: Also write this run's records here.
        **settings: Fields of `Settings`.

    Raises:
        RequestError: A setting cannot be met, or the file of kept records holds something else.
    """
    load(results_path(benchmark, results))  # first: a figure that cannot be kept is lost
    measure = importlib.import_module(f"jaxrl_vis.bench.{benchmark}").measure
    measurements, records = [], []
    chosen, watch = Settings(**settings).for_this_device(), Watch()
    for measurement in measure(chosen):
        measurements.append(measurement)
        records.append(compare_and_keep(benchmark, measurement, results, watch.conditions()))
    if json is not None:
        write_json(json, records)
    if records:
        print(f"kept in {results_path(benchmark, results)}")
    return measurements


__all__ = ["BENCHMARKS", "Measurement", "Settings", "run"]
