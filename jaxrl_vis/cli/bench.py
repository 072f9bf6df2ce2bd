"""Command ``jaxrl-vis bench``: measure the speed of rendering, physics, environments, updates and training."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal, get_args

import tyro

from jaxrl_vis.cli.checks import check_counts, check_env
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.config import Pixels
from jaxrl_vis.config.methods import AuxTaskName, WeightingName
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices, claim_memory, parse_device_count
from jaxrl_vis.report.outputs import check_writable

Benchmark = Literal["render", "physics", "env", "update", "train"]


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure this machine, store a record, and print the change since the last comparable record."""

    benchmark: Annotated[Benchmark | None, tyro.conf.Positional] = None
    """Quantity to measure: images, physics, both with resets, gradient steps, or whole training iterations."""
    env: Annotated[str, AlsoPositional()] = "VisualFetchReach"
    """Environment; module:Name for a custom one; unused with --scene."""
    preset: Literal["paper", "fast", "cpu", "debug"] | None = None
    """Preset of the networks and gradient steps (update, train); fast on accelerators and cpu on a CPU if not given."""
    envs: tuple[int, ...] = ()
    """Batch sizes in environments (or images), one measurement each (not used by update). If not given: sizes suitable for the
    device; for train, the preset's."""
    image_size: int | None = None
    """Height and width of images (not used by physics). If not given: 64 on accelerators and 32 on a CPU; for render, 64 and
    100, or 32 and 64."""
    pixels: Pixels | None = None
    """Channels of images (env, update, train); rgbd on accelerators and depth on a CPU if not given. render measures several
    instead."""
    batch_size: int | None = None
    """Transitions in a gradient step (update, train); the preset's if not given."""
    seeds: int = 1
    """Learners in one program (update, train)."""
    devices: str | None = None
    """Number of devices, or all; one if not given. With several, one device with its fraction of the work is also measured
    (train)."""
    data_devices: int | None = None
    """Number of devices that share each learner; all of them if there is one seed, else one (train)."""
    repeats: int = 5
    """Maximum number of timed repeats; the median is reported."""
    aux_tasks: tuple[AuxTaskName, ...] = ()
    """Auxiliary tasks in the gradient steps (update, train)."""
    weighting: WeightingName = "none"
    """Weighting of the auxiliary losses (update, train)."""
    scene: str | None = None
    """finger, fetch_reach, primitives, clutter, fetch_mesh, shadow_hand, aloha or the path of an MJCF file: render this
    instead of an environment (render)."""
    json: Path | None = None
    """Additional file for the records of this run."""
    results: Path | None = None
    """Folder of stored records; jaxrl-vis/bench in your cache folder if not given."""


def run(options: Bench) -> int:
    """Run one benchmark."""
    if options.benchmark is None:
        raise RequestError(f"no benchmark given; choose one of {', '.join(get_args(Benchmark))}")
    if options.scene is not None and options.benchmark != "render":
        raise RequestError(f"--scene {options.scene} goes with `bench render` only")
    if options.seeds != 1 and options.benchmark not in ("update", "train"):
        raise RequestError("--seeds goes with `bench update` and `bench train` only")
    if (options.weighting != "none" or options.aux_tasks) and options.benchmark not in ("update", "train"):
        raise RequestError("--weighting and --aux-tasks go with `bench update` and `bench train` only")
    if (options.preset is not None or options.batch_size is not None) and options.benchmark not in ("update", "train"):
        raise RequestError("--preset and --batch-size go with `bench update` and `bench train` only")
    if (options.devices is not None or options.data_devices is not None) and options.benchmark != "train":
        raise RequestError("--devices and --data-devices go with `bench train` only")
    check_counts(
        seeds=options.seeds,
        repeats=options.repeats,
        image_size=options.image_size,
        batch_size=options.batch_size,
        data_devices=options.data_devices,
    )
    for count in options.envs:
        check_counts(envs=count)
    check_env(options.env)
    if options.json is not None:
        check_writable(options.json, "--json")
    if options.benchmark == "train":
        claim_memory()
    from jaxrl_vis import bench
    from jaxrl_vis.bench.record import user_folder

    check_devices()
    check_writable(options.results or user_folder(), "--results", folder=True)
    settings = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    settings["devices"] = 1 if options.devices is None else parse_device_count(options.devices)
    bench.run(**settings)
    return 0
