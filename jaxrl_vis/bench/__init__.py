"""Benchmarks of this machine, with records that distinguish effects of code changes from noise and from other machines.

    settings -> render | physics | env | update | train -> Measurement -> record

States of environments, images and episodes of the replay differ, which is asserted. Every benchmark warms up, waits for the
device, repeats, and reports the median; compilation is timed separately. `conditions` decides which figures are comparable, and
`record` stores them and prints each change. `scenes` measures the renderer on scenes that other renderers draw as well.

The other renderers and learners (`benchmarks.peers`) and the tables that are written from records (`benchmarks.ledger`) are
not part of the package: they run from a checkout.
"""

import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from jaxrl_vis.bench.conditions import ConditionMonitor
from jaxrl_vis.bench.record import Measurement, compare_and_keep, load, results_path, write_json
from jaxrl_vis.bench.settings import Settings

BENCHMARKS = ("render", "physics", "env", "update", "train")


def run(benchmark: str, results: Path | None = None, json: Path | None = None, **settings: Any) -> list[Measurement]:
    """Run one benchmark; print and store its records, and return its measurements.

    Args:
        benchmark: One of `BENCHMARKS`.
        results: Folder of stored records; None for the user's cache, see `record.user_folder`.
        json: Additional file for the records of this run; None for no such file.
        **settings: Fields of `Settings`.

    Raises:
        RequestError: A setting cannot be met, or the file of stored records is invalid.
    """
    measure = importlib.import_module(f"jaxrl_vis.bench.{benchmark}").measure
    return keep_records(benchmark, measure, Settings(**settings), results, json)


def keep_records(
    benchmark: str,
    measure: Callable[[Settings], Iterator[Measurement]],
    settings: Settings,
    results: Path | None = None,
    json: Path | None = None,
) -> list[Measurement]:
    """Run ``measure`` while monitoring `conditions`; print, store and return every measurement that it yields.

    Args:
        benchmark: Name in the file of records.
        measure: Generator of measurements, called with the settings for this device.
        settings: Settings given by the user.
        results: See `run`.
        json: See `run`.

    Raises:
        RequestError: See `run`.
    """
    load(results_path(benchmark, results))  # fail before measuring if records cannot be stored
    measurements, records = [], []
    device_settings, monitor = settings.for_this_device(), ConditionMonitor()
    for measurement in measure(device_settings):
        measurements.append(measurement)
        records.append(compare_and_keep(benchmark, measurement, results, monitor.conditions()))
    if json is not None:
        write_json(json, records)
    if records:
        print(f"kept in {results_path(benchmark, results)}")
    return measurements


__all__ = ["BENCHMARKS", "Measurement", "Settings", "keep_records", "run"]
