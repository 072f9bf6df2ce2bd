"""Command line of a peer: its options, with the checks of `jaxrl-vis bench`."""

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from jaxrl_vis import bench
from jaxrl_vis.bench.record import user_folder
from jaxrl_vis.bench.scenes import models
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis.cli.checks import check_counts, check_env
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices
from jaxrl_vis.report.outputs import check_writable

_OPTIONS: dict[str, dict[str, Any]] = {
    "env": {"help": "environment (VisualFetchReach if not given)"},
    "preset": {"choices": ("paper", "fast", "cpu", "debug"), "help": "preset of the networks and gradient steps"},
    "scene": {"help": f"{', '.join(models.SCENES)} (all if not given), {', '.join(models.MESH_SCENES)} or an MJCF file"},
    "envs": {"type": int, "nargs": "+", "help": "batch sizes, with one measurement for each"},
    "image_size": {"type": int, "help": "height and width of images"},
    "pixels": {"choices": ("rgbd", "rgb", "depth"), "help": "channels of images"},
    "batch_size": {"type": int, "help": "transitions per gradient step"},
}


def run(
    benchmark: str,
    measure: Callable[[Settings], Iterator[bench.Measurement]],
    description: str | None,
    options: tuple[str, ...],
    arguments: list[str] | None = None,
) -> int:
    """Parse the command line, measure, and store the records of both sides.

    Args:
        benchmark: Name in the file of records.
        measure: Generator of our measurements and the peer's.
        description: Text of ``--help``.
        options: Fields of `Settings` that the peer reads.
        arguments: Command line; None for that of the process.

    Returns:
        Exit status: 0, or 2 for an invalid request, which is reported in one line.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in options:
        parser.add_argument(f"--{name.replace('_', '-')}", **_OPTIONS[name])
    parser.add_argument("--repeats", type=int, default=5, help="maximum number of timed repeats; the median counts")
    parser.add_argument("--json", type=Path, help="additional file for the records of this run")
    parser.add_argument("--results", type=Path, help="folder of stored records; jaxrl-vis/bench in your cache if not given")
    values = vars(parser.parse_args(arguments))
    results, json = values.pop("results"), values.pop("json")
    settings = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items() if value is not None}
    try:
        check_counts(**{name: settings[name] for name in ("repeats", "image_size", "batch_size") if name in settings})
        for count in settings.get("envs", ()):
            check_counts(envs=count)
        check_env(settings.get("env", Settings.env))
        if json is not None:
            check_writable(json, "--json")
        check_devices()
        check_writable(results or user_folder(), "--results", folder=True)
        bench.keep_records(benchmark, measure, Settings(**settings), results, json)
    except RequestError as error:
        print(error, file=sys.stderr)
        return 2
    return 0
