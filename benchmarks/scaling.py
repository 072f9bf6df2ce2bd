"""Scaling of training over the devices of one machine: a table, and records.

    python benchmarks/scaling.py [--devices 2 4 8] [--json FILE] [--quick]

For each number of devices N, compared with one device of the same machine:

    seeds          N seeds on N devices; iterations with the host reading their metrics, and the evaluations of a run
    weak 2048, 512 one learner: a batch of 2048 (512) transitions and the same number of environments on each device
    strong         one learner: a batch of 2048 (512) and the environments of one device divided among N
    all-reduce     the mean of as many numbers as an update averages, alone
    resume         a checkpoint of N devices, restored on one device and on others: parameters, optimisers and replay must be
                   bit-equal; training continues on one
    processes      seeds and weak 2048 on the maximum number of devices again, by two processes with half of the devices each

All programs are compiled beforehand into the compilation cache by parallel processes, because tracing is Python and sequential
within a process. ``--quick`` uses small images and few updates, to test the script: on a CPU with
XLA_FLAGS=--xla_force_host_platform_device_count=2.
"""

import argparse
import dataclasses
import functools
import json
import math
import os
import re
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from jaxrl_vis import preset
from jaxrl_vis.bench.conditions import ConditionMonitor
from jaxrl_vis.bench.record import Measurement, to_record, write_json
from jaxrl_vis.config import Config
from jaxrl_vis.host import distributed
from jaxrl_vis.host.devices import enable_compilation_cache
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis.learner.parallel.sharding import make_layout
from jaxrl_vis.learner.parallel.shards import DATA
from jaxrl_vis.learner.train_step import make_train_step
from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.run.storage.arrays import named_leaves
from jaxrl_vis.run.storage.checkpoint import FULL, Checkpoints

QUICK = {
    "image_size": 16,
    "pixels": "depth",
    "updates_per_iteration": 2,
    "eval_episodes": 8,
    "encoder_filters": (8, 8),
    "latent_size": 16,
    "hidden_sizes": (32,),
}
REDUCTIONS = 100  # per program, so that the launch overhead does not count
BATCHES, SMALL_BATCHES = (2048, 512), (32, 16)


class Timed:
    """Configuration that is compiled and timed.

    Args:
        config: The configuration.
        env: The environment.
        evaluates: Include evaluations in the timing.
    """

    def __init__(self, config: Config, env: Any, evaluates: bool):
        self.config, self.env, self.evaluates = config, env, evaluates
        self.loop: Any = None

    @functools.cached_property
    def programs(self) -> Programs:
        """Programs, created on first use: a process of two has no programs for one device."""
        return Programs(self.config, make_train_step(self.env, self.config))

    def run(self, cycles: int) -> list[float]:
        """Return the mean time of an iteration (s) in each of ``cycles`` cycles, after a first one that is not counted.

        A cycle consists of the iterations between two evaluations. As in a run, the host reads the metrics of each iteration
        during the next one, and those of a cycle's last iteration during the evaluation, which it then waits for.

        Raises:
            FloatingPointError: A metric is not finite.
        """
        programs, count = self.programs, self.config.run.eval_interval
        loop = programs.init(programs.run_keys) if self.loop is None else self.loop
        seconds = []
        for cycle in range(cycles + 1):
            start, waiting = time.perf_counter(), []
            for _ in range(count):
                loop, metrics = programs.train_iteration(loop)
                waiting.append(programs.pending(metrics))
                if len(waiting) > 1:
                    waiting.pop(0).read()
            if self.evaluates:
                waiting.append(programs.pending(programs.evaluate(loop.train)[0]))
            for pending in waiting:
                if not all(np.isfinite(values).all() for values in pending.read().values()):
                    raise FloatingPointError("training gave numbers that are not finite")
            jax.block_until_ready(loop.train)
            if cycle:
                seconds.append((time.perf_counter() - start) / count)
        self.loop = loop
        return seconds

    def compile(self) -> None:
        """Compile the programs, or load them from the compilation cache."""
        self.programs.compiled("init")
        self.programs.training_programs()
        if self.evaluates:
            self.programs.evaluation_programs()


def compile_all(everything: list[Timed]) -> float:
    """Fill the compilation cache by parallel processes, one per configuration, and read it; return the time, s.

    Raises:
        SystemExit: One of the processes failed, after printing its error.
    """
    start = time.perf_counter()
    children = [
        subprocess.Popen([sys.executable, *sys.argv, "--compile-only", str(number)]) for number in range(len(everything))
    ]
    failed = [str(number) for number, child in enumerate(children) if child.wait()]
    if failed:
        raise SystemExit(f"these of {len(children)} configurations were not compiled: {', '.join(failed)}")
    for timed in everything:
        timed.compile()
    return time.perf_counter() - start


def all_reduce_seconds(numbers: int, devices: int) -> float:
    """Return the time of the mean of ``numbers`` float32 numbers over all devices, s."""
    layout = make_layout(preset("fast", devices=devices, num_envs=devices, batch_size=devices, eval_episodes=devices))

    def reduce_many(values: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, REDUCTIONS, lambda _, values: jax.lax.pmean(values * 1.0001, DATA), values)

    everywhere = PartitionSpec()
    jitted = layout.spread(reduce_many, (everywhere,), everywhere, jax.jit)
    values = layout.put(jnp.ones(numbers), everywhere)
    jax.block_until_ready(jitted(values))
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        jax.block_until_ready(jitted(values))
        seconds.append((time.perf_counter() - start) / REDUCTIONS)
    return statistics.median(seconds)


def leaf_bytes(tree: Any) -> dict[str, bytes]:
    """Return the bytes of all leaves of a loop state, by name."""
    plain = {
        name: jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        for name, leaf in named_leaves(tree).items()
    }
    return {name: np.asarray(leaf).tobytes() for name, leaf in plain.items()}


def check_resume(saved: Timed, others: list[Config], env: Any, single: Timed) -> list[str]:
    """Save a loop state, restore it for other numbers of devices, and compare all bytes; return a line for each.

    Raises:
        AssertionError: Restored arrays differ.
    """
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        checkpoints = Checkpoints(Path(folder))
        start = time.perf_counter()
        checkpoints.save_full(1, saved.loop, {})
        took, expected = time.perf_counter() - start, leaf_bytes(saved.loop)
        lines.append(f"saved on {saved.config.run.devices} devices in {took:.1f} s, {len(expected)} arrays")
        for config in others:
            programs = single.programs if config.run.devices == 1 else Programs(config, make_train_step(env, config))
            restored = checkpoints.restore_for_resume(programs.shapes)
            assert restored is not None and restored.loop is not None and restored.tier == FULL
            differing = [name for name, value in leaf_bytes(restored.loop).items() if value != expected[name]]
            if differing:
                raise AssertionError(f"restored on {config.run.devices} devices, these differ: {', '.join(differing[:5])}")
            lines.append(f"restored on {config.run.devices}: all bit-equal")
            if config.run.devices == 1:
                single.loop = restored.loop
                single.run(1)
                lines[-1] += ", and trained on"
        checkpoints.close()
    return lines


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Training on several devices, and its reference on one.

    Attributes:
        kind: seeds, weak or strong.
        timed: Training on several devices.
        reference: Training on one device.
    """

    kind: str
    timed: Timed
    reference: Timed


def make_comparisons(base: Config, env: Any, numbers: list[int], batches: tuple[int, ...], seeds: int) -> list[Comparison]:
    """Create all configurations to be measured, for ``numbers`` of devices and ``seeds`` per device."""
    one_of = {batch: Timed(base.replace(batch_size=batch), env, False) for batch in batches}
    one_seeds, comparisons = Timed(base.replace(seeds=seeds), env, True), []
    for count in numbers:
        comparisons.append(Comparison("seeds", Timed(base.replace(seeds=seeds * count, devices=count), env, True), one_seeds))
        for batch, one in one_of.items():
            sizes = {"batch_size": batch, "num_envs": base.run.num_envs, "replay_transitions": base.run.replay_transitions}
            weak = base.replace(devices=count, **{name: size * count for name, size in sizes.items()})
            strong = base.replace(devices=count, batch_size=batch)
            comparisons += [
                Comparison("weak", Timed(weak, env, False), one),
                Comparison("strong", Timed(strong, env, False), one),
            ]
    return comparisons


def compare(
    kind: str, config: Config, single: list[float], seconds: list[float], ideal_speed_up: int
) -> tuple[str, Measurement]:
    """Compare a configuration with its reference; return a line of the table, and the record.

    Args:
        kind: seeds, weak, strong or processes.
        config: The configuration.
        single: Times of an iteration of the reference, s.
        seconds: Times of an iteration of the configuration, s.
        ideal_speed_up: Speed-up at an efficiency of one.
    """
    before, after = statistics.median(single), statistics.median(seconds)
    speedup = before / after * (1 if kind == "strong" else ideal_speed_up)
    spread = max((max(cycles) - min(cycles)) / statistics.median(cycles) for cycles in (single, seconds))
    line = (
        f"{kind:10}{config.run.devices:8}{config.run.seeds:7}{config.run.batch_size:8}{config.run.num_envs:6}"
        f"{1e3 * before:11,.1f} ms"
        f"{1e3 * after:11,.1f} ms{speedup:10.3f}{speedup / ideal_speed_up:12.1%}{spread:9.1%}"
    )
    names = ("env", "preset", "image_size", "pixels", "num_envs", "batch_size", "seeds", "devices", "updates_per_iteration")
    compared = "one_process_ms" if kind == "processes" else "one_device_ms"
    details = {compared: 1e3 * before, "ms": 1e3 * after, "efficiency": speedup / ideal_speed_up, "spread": spread}
    details = {name: round(value, 4) for name, value in details.items()} | {"repeats": len(seconds)}
    described = {name: config.value(name) for name in names}
    return line, Measurement(f"scaling/{kind}", round(speedup, 4), "x one device", described, details)


def measure_all_reduce(comparison: Comparison) -> tuple[str, Measurement]:
    """Measure the time of an update's all-reduce; return a line, and the record."""
    train, count = comparison.timed.programs.shapes.train, comparison.timed.config.run.devices
    numbers = sum(math.prod(leaf.shape[1:]) for leaf in jax.tree.leaves((train.agent.actor, train.agent.critic)))
    seconds = all_reduce_seconds(numbers, count)
    updates = comparison.timed.config.run.updates_per_iteration
    line = (
        f"all-reduce of {numbers:,} float32 over {count} devices: {1e6 * seconds:.1f} us, "
        f"{1e3 * seconds * updates:.1f} ms in the {updates} updates of an iteration"
    )
    described = {"devices": count, "float32": numbers}
    return line, Measurement("scaling/all_reduce", round(1 / seconds, 1), "all-reduces/s", described)


def measure_in_processes(
    comparisons: list[Comparison], positions: list[int], times: list[list[float]]
) -> list[tuple[str, Measurement]]:
    """Time the configurations again in two processes, each with half the devices; return the table's lines, and the records.

    Args:
        comparisons: Configurations to be repeated, all on the same number of devices.
        positions: Index of each among all configurations.
        times: For each configuration, the times of an iteration in one process, s.

    Raises:
        SystemExit: A process failed.
    """
    with socket.socket() as free:
        free.bind(("localhost", 0))
        place = ["--coordinator", f"localhost:{free.getsockname()[1]}", "--positions", *map(str, positions)]
    half = comparisons[0].timed.config.run.devices // 2
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", ",".join(map(str, range(2 * half)))).split(",")
    children = []
    for index in range(2):
        variables = dict(os.environ, CUDA_VISIBLE_DEVICES=",".join(visible[index * half : (index + 1) * half]))
        if "XLA_FLAGS" in variables:  # simulated devices of a CPU
            variables["XLA_FLAGS"] = re.sub(r"(device_count=)\d+", rf"\g<1>{half}", variables["XLA_FLAGS"])
        command = [sys.executable, *sys.argv, *place, "--process-id", str(index)]
        children.append(subprocess.Popen(command, env=variables, stdout=subprocess.PIPE, text=True))
    printed = [child.communicate()[0] for child in children]
    if any(child.returncode for child in children):
        raise SystemExit(f"two processes ended with {', '.join(str(child.returncode) for child in children)}")
    results = []
    for comparison, one, two in zip(comparisons, times, json.loads(printed[0].splitlines()[-1]), strict=True):
        line, measurement = compare("processes", comparison.timed.config, one, two, 1)
        kind = f"scaling/processes_{comparison.kind}"
        results.append((line, dataclasses.replace(measurement, name=kind, unit="x one process")))
    return results


def measure_as_process(timed: list[Timed], cycles: int) -> None:
    """Act as one of two processes: compile and time each configuration, and print the times of an iteration (s) as JSON."""
    seconds = []
    for configuration in timed:
        configuration.compile()
        distributed.sync_processes("compiled")
        seconds.append(configuration.run(cycles))
        configuration.loop = None
    print(json.dumps(seconds), flush=True)


def write_records(file: Path | None, monitor: ConditionMonitor, measurements: list[Measurement]) -> None:
    """Write all measurements so far, if a file is given."""
    if file is not None:
        conditions = monitor.conditions()
        write_json(file, [to_record(measurement, conditions) for measurement in measurements])
        print(f"records: {file}", flush=True)


HEAD = (
    f"{'what':10}{'devices':>8}{'seeds':>7}{'batch':>8}{'envs':>6}{'compared to':>14}{'itself':>14}"
    f"{'speed-up':>10}{'efficiency':>12}{'spread':>9}"
)


def main() -> None:
    """Measure, print a table, and store the records."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", type=int, nargs="+", help="numbers of devices; 2, 4 and 8 if there are so many")
    parser.add_argument("--env", default="VisualFetchReach")
    parser.add_argument("--cycles", type=int, default=6, help="timed cycles of two iterations, and an evaluation for seeds")
    parser.add_argument("--seeds-per-device", type=int, default=1)
    parser.add_argument("--json", type=Path, help="also write the records here")
    parser.add_argument("--quick", action="store_true", help="small, to see that it works")
    parser.add_argument("--positions", type=int, nargs="+", help=argparse.SUPPRESS)  # for one of two processes
    parser.add_argument("--coordinator", help=argparse.SUPPRESS)
    parser.add_argument("--process-id", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--compile-only", type=int, metavar="N", help="fill the compile cache for the N-th configuration")
    options = parser.parse_args()
    # Compiling processes share the devices' memory with this one.
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    enable_compilation_cache()
    if options.coordinator:
        distributed.start(distributed.Rank(options.coordinator, 2, options.process_id))
    began, there = time.perf_counter(), len(jax.devices())
    numbers = [count for count in options.devices or (2, 4, 8) if 1 < count <= there]
    if not numbers:
        raise SystemExit(f"there is only {there} device")
    envs = math.ceil((8 if options.quick else 100) / math.lcm(*numbers)) * math.lcm(*numbers)
    base = preset("fast", env=options.env, num_envs=envs, replay_transitions=100_000)
    base = base.replace(**QUICK, replay_transitions=50 * envs) if options.quick else base
    env = make_env(base)
    comparisons = make_comparisons(base, env, numbers, SMALL_BATCHES if options.quick else BATCHES, options.seeds_per_device)
    alone = list({id(pair.reference): pair.reference for pair in comparisons}.values())
    everything = [*alone, *(pair.timed for pair in comparisons)]
    if options.compile_only is not None:
        everything[options.compile_only].compile()
        return
    if options.positions is not None:
        measure_as_process([everything[position] for position in options.positions], options.cycles)
        return
    monitor = ConditionMonitor()
    lines, measurements, times = [], [], {}

    def keep(line: str, measurement: Measurement | None = None) -> None:
        lines.append(line)
        measurements.extend([] if measurement is None else [measurement])
        print(line, flush=True)

    print(f"compiled in {compile_all(everything):.0f} s", flush=True)
    for one in alone:
        times[id(one)] = one.run(options.cycles)
        one.loop = None  # makes room
    keep(HEAD)
    for pair in comparisons:
        times[id(pair)] = pair.timed.run(options.cycles)
        ideal = pair.timed.config.run.devices
        keep(*compare(pair.kind, pair.timed.config, times[id(pair.reference)], times[id(pair)], ideal))
        is_last = (
            pair is [other for other in comparisons if other.timed.config.run.devices == pair.timed.config.run.devices][-1]
        )
        if is_last:  # one learner, of the smallest batch
            keep(*measure_all_reduce(pair))
            counts = (1, *(count for count in numbers if count < pair.timed.config.run.devices))
            for line in check_resume(
                pair.timed, [pair.timed.config.replace(devices=count) for count in counts], env, pair.reference
            ):
                keep(line)
            pair.reference.loop = None
        pair.timed.loop = None
    write_records(options.json, monitor, measurements)
    if numbers[-1] % 2 == 0:
        again = [
            pair for pair in comparisons if pair.timed.config.run.devices == numbers[-1] and pair.kind in ("seeds", "weak")
        ][:2]
        positions = [len(alone) + comparisons.index(pair) for pair in again]
        for line, measurement in measure_in_processes(again, positions, [times[id(pair)] for pair in again]):
            keep(line, measurement)
    took = time.perf_counter() - began
    print(
        f"\n{options.env}, preset fast, {base.environment.image_size}x{base.environment.image_size} "
        f"{base.environment.pixels}, on {there} x "
        f"{jax.devices()[0].device_kind}, JAX {jax.__version__}, {took:.0f} s\n"
    )
    print("\n".join(lines))
    write_records(options.json, monitor, measurements)


if __name__ == "__main__":
    main()
