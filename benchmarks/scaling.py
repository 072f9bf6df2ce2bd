"""How training scales over the devices of one machine, in one go: a table, and records.

    python benchmarks/scaling.py [--devices 2 4 8] [--json FILE] [--quick]

For each number of devices N, beside one device of the same machine:

    seeds          N seeds on N devices; iterations with the host reading their metrics, and the evaluations of a run
    weak 2048, 512 one learner: a batch of 2048 (512) transitions and as many environments on each device
    strong         one learner: a batch of 2048 (512) and the environments of one device divided among N
    all-reduce     the mean of as many numbers as an update averages, alone
    resume         what N devices saved, restored on one device and on others: parameters, optimisers and replay bit-equal, and
                   trained further on one

Everything that one number of devices needs is traced first and compiled side by side. ``--quick`` takes small images and few
updates, to see that it works: on a CPU with XLA_FLAGS=--xla_force_host_platform_device_count=2.
"""

import argparse
import concurrent.futures
import math
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from jaxrl_vis import preset
from jaxrl_vis.bench.conditions import Watch
from jaxrl_vis.bench.record import Measurement, to_record, write_json
from jaxrl_vis.config import Config
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis.learner.sharding import make_layout
from jaxrl_vis.learner.shards import DATA
from jaxrl_vis.learner.train_step import make_train_step
from jaxrl_vis.run.checkpoint import FULL, Checkpoints, named_leaves
from jaxrl_vis.run.programs import Programs, enable_compilation_cache

QUICK = {
    "image_size": 16,
    "pixels": "depth",
    "updates_per_iteration": 2,
    "eval_episodes": 8,
    "encoder_filters": (8, 8),
    "latent_size": 16,
    "hidden_sizes": (32,),
}
REDUCTIONS = 100  # in one program, so that the time of its start does not count
BATCHES = (2048, 512)


class Timed:
    """One configuration, compiled and trained for a while.

    Args:
        config: What is trained.
        env: The environment.
        evaluates: Whether evaluations are measured, too.
    """

    def __init__(self, config: Config, env: Any, evaluates: bool):
        self.config, self.evaluates = config, evaluates
        self.programs = Programs(config, make_train_step(env, config))
        self.names = ("init", "train_iteration", *(("evaluate",) if evaluates else ()))
        self.loop: Any = None
        self.compile_s = 0.0

    def run(self, cycles: int) -> list[float]:
        """Seconds of an iteration in each of several cycles; one cycle goes before.

        A cycle is what lies between two evaluations. The host reads the metrics of each iteration during the next one, and at
        the end of a cycle those of the last one, as in a run.
        """
        programs, count = self.programs, self.config.eval_interval
        loop = programs.init(programs.run_keys) if self.loop is None else self.loop
        seconds = []
        for cycle in range(cycles + 1):
            start, before = time.perf_counter(), None
            for _ in range(count):
                loop, metrics = programs.train_iteration(loop)
                if before is not None:
                    jax.device_get(before)
                before = metrics
            found = jax.device_get(before)
            if not all(np.isfinite(values).all() for values in found.values()):
                raise FloatingPointError("training gave numbers that are not finite")
            if self.evaluates:
                jax.device_get(programs.evaluate(loop.train)[0])
            jax.block_until_ready(loop.train)
            if cycle:
                seconds.append((time.perf_counter() - start) / count)
        self.loop = loop
        return seconds


def compile_all(everything: dict[str, Timed]) -> float:
    """Traces one by one, compiles side by side; the seconds it took."""
    start = time.perf_counter()
    with concurrent.futures.ThreadPoolExecutor(16) as pool:
        futures = []
        for timed in everything.values():
            for name in timed.names:
                lowered = timed.programs._lower(name)
                futures.append((timed, name, pool.submit(lowered.compile)))
        for timed, name, future in futures:
            timed.programs._compiled[name] = future.result()
    return time.perf_counter() - start


def all_reduce_seconds(numbers: int, devices: int) -> float:
    """Seconds of the mean of so many float32 numbers over all devices."""
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


def words(tree: Any) -> dict[str, bytes]:
    """The bytes of all leaves of a learner or a replay, by name."""
    plain = {
        name: jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        for name, leaf in named_leaves(tree).items()
    }
    return {name: np.asarray(leaf).tobytes() for name, leaf in plain.items()}


def check_resume(saved: Timed, others: list[Config], env: Any, single: Timed) -> list[str]:
    """Saves a loop state, restores it for other numbers of devices, and compares all bytes; a line for each."""
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        checkpoints = Checkpoints(Path(folder))
        start = time.perf_counter()
        checkpoints.save_full(1, saved.loop, {})
        took, expected = time.perf_counter() - start, words(saved.loop)
        lines.append(f"saved on {saved.config.devices} devices in {took:.1f} s, {len(expected)} arrays")
        for config in others:
            programs = single.programs if config.devices == 1 else Programs(config, make_train_step(env, config))
            restored = checkpoints.restore_for_resume(programs.shapes)
            assert restored is not None and restored.loop is not None and restored.tier == FULL
            differing = [name for name, value in words(restored.loop).items() if value != expected[name]]
            if differing:
                raise AssertionError(f"restored on {config.devices} devices, these differ: {', '.join(differing[:5])}")
            lines.append(f"restored on {config.devices}: all bit-equal")
            if config.devices == 1:
                single.loop = restored.loop
                single.run(1)
                lines[-1] += ", and trained on"
        checkpoints.close()
    return lines


def table(rows: list[dict[str, Any]]) -> str:
    """The figures, one line each."""
    head = f"{'what':16}{'devices':>8}{'batch':>8}{'one device':>14}{'all':>14}{'speed-up':>10}{'efficiency':>12}{'spread':>9}"
    lines = [head, "-" * len(head)]
    for row in rows:
        times = "".join(f"{1e3 * row[name]:11,.1f} ms" for name in ("one_s", "all_s"))
        lines.append(
            f"{row['what']:16}{row['devices']:8}{row['batch']:8}{times}{row['speedup']:10.3f}"
            f"{row['speedup'] / row['devices']:12.1%}{row['spread']:9.1%}"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", type=int, nargs="+", help="numbers of devices; 2, 4 and 8 if there are so many")
    parser.add_argument("--env", default="VisualFetchReach")
    parser.add_argument("--cycles", type=int, default=6, help="timed cycles of two iterations and an evaluation")
    parser.add_argument("--seeds-per-device", type=int, default=1)
    parser.add_argument("--json", type=Path, help="also write the records here")
    parser.add_argument("--quick", action="store_true", help="small, to see that it works")
    options = parser.parse_args()
    enable_compilation_cache()
    there = len(jax.devices())
    numbers = [count for count in options.devices or (2, 4, 8) if count <= there]
    if not numbers:
        raise SystemExit(f"there is only {there} device")
    batches = (32, 16) if options.quick else BATCHES
    envs = math.ceil((8 if options.quick else 100) / max(numbers)) * max(numbers)
    changes = {"env": options.env, "num_envs": envs, "replay_transitions": 200_000}
    changes |= {**QUICK, "replay_transitions": 50 * envs} if options.quick else {}
    base = preset("fast", **changes)
    env, watch, began = make_env(base), Watch(), time.perf_counter()
    rows, notes, records = [], [], []

    def note(line: str) -> None:
        notes.append(line)
        print(line, flush=True)

    many = options.seeds_per_device
    single = {"seeds": Timed(base.replace(seeds=many), env, True)}
    single |= {f"one {batch}": Timed(base.replace(batch_size=batch), env, False) for batch in batches}
    note(f"one device: compiled in {compile_all(single):.0f} s")
    of_one = {name: timed.run(options.cycles) for name, timed in single.items()}
    for timed in single.values():
        timed.loop = None  # makes room
    for count in numbers:
        wide = {"seeds": Timed(base.replace(seeds=many * count, devices=count), env, True)}
        for batch in batches:
            weak = {
                "batch_size": batch * count,
                "num_envs": envs * count,
                "replay_transitions": base.replay_transitions * count,
            }
            wide[f"weak {batch}"] = Timed(base.replace(devices=count, **weak), env, False)
            wide[f"strong {batch}"] = Timed(base.replace(devices=count, batch_size=batch), env, False)
        note(f"{count} devices: compiled in {compile_all(wide):.0f} s")
        for name, timed in wide.items():
            what, _, batch = name.partition(" ")
            one, seconds = of_one[f"one {batch}" if batch else "seeds"], timed.run(options.cycles)
            middle, of_all = statistics.median(one), statistics.median(seconds)
            speedup = middle / of_all * (1 if what == "strong" else count)
            spread = max((max(each) - min(each)) / statistics.median(each) for each in (one, seconds))
            size = timed.config.batch_size
            rows.append(
                {"what": name, "devices": count, "batch": size, "one_s": middle, "all_s": of_all}
                | {"speedup": speedup, "spread": spread}
            )
            config = timed.config
            described = {name: getattr(config, name) for name in ("env", "preset", "image_size", "pixels", "num_envs")}
            described |= {"kind": what, "batch_size": size, "seeds": config.seeds, "devices": count}
            details = {"one_device_ms": 1e3 * middle, "ms": 1e3 * of_all, "efficiency": speedup / count, "spread": spread}
            details = {key: round(value, 4) for key, value in details.items()}
            updates = config.updates_per_iteration
            records.append(
                to_record(
                    Measurement(
                        f"scaling/{what}", round(speedup, 4), "x one device", described | {"updates": updates}, details
                    ),
                    watch.conditions(),
                )
            )
            print(table(rows[-1:]).splitlines()[-1], flush=True)
            if name != f"strong {batches[-1]}":
                timed.loop = None
        numbers_reduced = sum(
            math.prod(leaf.shape[1:])
            for part in ("actor", "critic")
            for leaf in jax.tree.leaves(getattr(timed.programs.shapes.train, part))
        )
        seconds = all_reduce_seconds(numbers_reduced, count)
        shown = f"{numbers_reduced:,} float32 over {count} devices: {1e6 * seconds:.1f} us; an iteration has {updates}"
        note(f"all-reduce of {shown}")
        described = {"devices": count, "float32": numbers_reduced}
        records.append(
            to_record(Measurement("scaling/all_reduce", 1 / seconds, "all-reduces/s", described), watch.conditions())
        )
        last = wide[f"strong {batches[-1]}"]
        smaller = [last.config.replace(devices=other) for other in (1, *(each for each in numbers if each < count))]
        for line in check_resume(last, smaller, env, single[f"one {batches[-1]}"]):
            note(line)
        last.loop = single[f"one {batches[-1]}"].loop = None
    print()
    print(
        f"{options.env}, preset fast, {base.image_size}x{base.image_size} {base.pixels}, {envs} environments, on {there} x "
        f"{jax.devices()[0].device_kind}; JAX {jax.__version__}; {time.perf_counter() - began:.0f} s"
    )
    print(table(rows))
    print("\n".join(notes))
    if options.json is not None:
        write_json(options.json, records)
        print(f"records: {options.json}")


if __name__ == "__main__":
    main()
