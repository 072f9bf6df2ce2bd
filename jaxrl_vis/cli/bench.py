"""``jaxrl-vis bench``."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal, get_args

import tyro

from jaxrl_vis.cli.checks import check_counts, check_env
from jaxrl_vis.cli.parsing import ByPlaceToo
from jaxrl_vis.config import Pixels
from jaxrl_vis.devices import check_devices, claim_memory, count_devices
from jaxrl_vis.errors import RequestError
from jaxrl_vis.methods import AuxTaskName, WeightingName
from jaxrl_vis.report.outputs import check_writable

Benchmark = Literal["render", "physics", "env", "update", "train"]
Peer = Literal["mujoco", "warp", "playground", "torch"]

_BENCHMARK_OF: dict[str, Benchmark] = {"playground": "physics", "torch": "update"}  # of all other peers: render


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure this machine, keep a record, and print the change since the last record where the two can be compared."""

    benchmark: Annotated[Benchmark | None, tyro.conf.Positional] = None
    """What to measure: images, physics, both with resets, gradient steps, or whole training iterations."""
    check: bool = False
    """Measure nothing: list records whose code has changed since, and rows of the README that have no record."""
    tables: bool = False
    """Measure nothing: write the tables of the README from the records."""
    env: Annotated[str, ByPlaceToo()] = "VisualFetchReach"
    """The environment; module:Name is one of your own."""
    preset: Literal["paper", "fast", "cpu", "debug"] | None = None
    """Whose networks and gradient steps (update, train); fast on accelerators and cpu on a CPU if not given."""
    envs: tuple[int, ...] = ()
    """Environments (or images) side by side, one measurement each (all but update, which has none); sizes that suit the device
    if not given."""
    image_size: int | None = None
    """Height and width of images; 64 on accelerators and 32 on a CPU if not given. render measures 64 and 100, or 32 and 64,
    unless this is another one."""
    pixels: Pixels | None = None
    """Channels; rgbd on accelerators and depth on a CPU if not given. render measures several."""
    batch_size: int | None = None
    """Transitions in a gradient step (update, train); the preset's if not given."""
    seeds: int = 1
    """Learners side by side in one program (update, train)."""
    devices: str | None = None
    """How many devices to use, or all; one device with its share of the work is measured beside them (train)."""
    data_devices: int | None = None
    """How many devices share each learner; all of them if there is one seed, else one (train)."""
    repeats: int = 5
    """Timed repeats; the median counts."""
    aux_tasks: tuple[AuxTaskName, ...] = ()
    """Auxiliary tasks in the gradient steps (update, train)."""
    weighting: WeightingName = "none"
    """How their losses are weighted (update, train)."""
    peer: Peer | None = None
    """Measure another side by side: a renderer on the same poses (render: mujoco, warp), MuJoCo Playground's FingerTurn
    (physics: playground), or the same gradient steps in PyTorch (update: torch)."""
    scene: str | None = None
    """finger, fetch_reach, primitives or the path of an MJCF file: draw this in the place of an environment; all three for a
    peer if not given, but for primitives on a CPU (render)."""
    json: Path | None = None
    """Also write this run's records here."""
    results: Path | None = None
    """Folder of kept records; jaxrl-vis/bench in your cache folder if not given. The README quotes benchmarks/results, which
    --check and --tables read."""


def run(options: Bench) -> int:
    """Runs one benchmark, or looks after the records; 1 where one of these is stale or missing."""
    if options.check or options.tables:
        return _look_after_records(options)
    if options.benchmark is None:
        raise RequestError(f"no benchmark given; choose one of {', '.join(get_args(Benchmark))}, or --check or --tables")
    for option, benchmark in (("scene", "render"), ("peer", _BENCHMARK_OF.get(options.peer or "", "render"))):
        value = getattr(options, option)
        if value is not None and options.benchmark != benchmark:
            raise RequestError(f"--{option} {value} goes with `bench {benchmark}` only")
    if options.seeds != 1 and options.benchmark not in ("update", "train"):
        raise RequestError("--seeds goes with `bench update` and `bench train` only")
    if options.seeds != 1 and options.peer == "torch":
        raise RequestError("--peer torch learns with one seed: leave out --seeds")
    if (options.weighting != "none" or options.aux_tasks) and (options.benchmark not in ("update", "train") or options.peer):
        raise RequestError("--weighting and --aux-tasks go with `bench update` and `bench train` only, without a peer")
    for option in ("preset", "batch_size"):
        if getattr(options, option) is not None and options.benchmark not in ("update", "train"):
            raise RequestError(f"--{option.replace('_', '-')} goes with `bench update` and `bench train` only")
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
    del settings["check"], settings["tables"]
    settings["devices"] = 1 if options.devices is None else count_devices(options.devices)
    bench.run(**settings)
    return 0


def _look_after_records(options: Bench) -> int:
    for field in dataclasses.fields(options):
        if field.name not in ("check", "tables", "results") and getattr(options, field.name) != field.default:
            given = options.benchmark or f"--{field.name.replace('_', '-')}"
            raise RequestError(f"--check and --tables measure nothing: leave out {given}")
    from jaxrl_vis import provenance
    from jaxrl_vis.bench import check, record, tables

    if options.tables:
        check_writable(check.README)
        changed = tables.write_tables(check.README, options.results or record.results_folder())
        print(f"{check.README}: {'written' if changed else 'unchanged'}")
    complaints = check.check(options.results, check.README) if options.check else []
    if options.check:
        good = "nothing that could be looked at is wrong"
        if provenance.is_checkout() and check.README.exists():
            good = "every record is of today's code, and every row has one"
        print("\n".join(complaints) or good)
    return 1 if complaints else 0
